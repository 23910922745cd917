"""Files of strangers: a sentence at once, never a program, a wait, a full memory, or a file beside theirs."""

import os
import resource
from pathlib import Path

import av
import cv2
import numpy as np
import pyarrow
import pytest
from pyarrow import parquet

from rover_lib.onboard.car.car import read_car
from rover_lib.onboard.drive.flight_log import read_log
from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.stage import read_stage
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint
from rover_lib.workshop.int8.observe import Calibration
from rover_lib.workshop.recordings.episodes import load_recordings
from rover_lib.workshop.untrusted import check_encoded, check_inside, check_table, check_video, limited_memory
from tests.helpers import hostile

SIZE = (54, 96)
POSTSCRIPT = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 96 54\nshowpage\n"
PICTURE = cv2.imencode(".png", hostile.scene(size=SIZE[::-1]))[1].tobytes()
ICON = b"\0\0\1\0\1\0\0\0\0\0\1\0\x20\0" + len(PICTURE).to_bytes(4, "little") + b"\x16\0\0\0" + PICTURE


@pytest.mark.parametrize("encoded", [POSTSCRIPT, ICON], ids=["PostScript", "ICO"])
def test_only_png_and_jpeg_are_decoded(encoded):
    assert "neither PNG nor JPEG" in check_encoded(encoded, SIZE)


def test_a_picture_is_whole_in_colours_and_of_the_size_that_the_dataset_says():
    jpeg = hostile.jpeg(hostile.scene(size=SIZE[::-1]))
    assert not check_encoded(PICTURE, SIZE) and not check_encoded(jpeg, SIZE)
    grey = cv2.imencode(".png", hostile.scene(size=SIZE[::-1])[..., 0])[1].tobytes()
    wrong = [b"", grey, PICTURE[:-20], PICTURE[:200] + b"x" + PICTURE[201:], hostile.cut(jpeg)]
    wrong += [hostile.claims(hostile.WHOLE, *size) for size in ((640, 54), (65_000, 65_000))]
    assert all(check_encoded(data, SIZE) for data in wrong)


def video(path, codec, size, packets=()):
    """An MP4 of one frame, or of these packets."""
    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream(codec, rate=20)
        stream.height, stream.width = size
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        frame = av.VideoFrame.from_ndarray(np.zeros((*size, 3), np.uint8))
        made = packets or [*stream.encode(frame), *stream.encode()]
        for packet in made:
            if isinstance(packet, bytes):
                packet = av.Packet(packet)
                packet.stream, packet.pts, packet.dts = stream, 0, 0
            container.mux(packet)
    return path


def test_a_video_is_an_mp4_of_its_cameras_size(tmp_path):
    check_video(video(tmp_path / "right.mp4", "libx264", SIZE), SIZE)
    larger = video(tmp_path / "larger.mp4", "libx264", (540, 960))
    bomb = video(tmp_path / "bomb.mp4", "mjpeg", SIZE, [hostile.grey(16_000)])
    playlist = tmp_path / "playlist.mp4"
    playlist.write_text("#EXTM3U\n#EXTINF:1,\nfile:///etc/passwd\n")
    for path in (larger, bomb, playlist):
        with pytest.raises(EpisodeError, match=path.name):
            check_video(path, SIZE)


def test_a_table_has_no_more_rows_than_its_bytes_can_hold(tmp_path):
    path, rows = tmp_path / "bomb.parquet", 10_000_000
    parquet.write_table(pyarrow.table({"index": np.zeros(rows, np.int64)}), path)
    with pytest.raises(EpisodeError, match="its footer says 10000000 rows"):
        check_table(path)
    parquet.write_table(pyarrow.table({"index": np.arange(1000)}), path)
    assert check_table(path) == ["index"]


@pytest.mark.slow
def test_memory_is_limited_within_and_as_before_afterwards():
    before = resource.getrlimit(resource.RLIMIT_DATA)
    with pytest.raises(MemoryError), limited_memory():
        np.ones(600_000_000, np.uint8)
    with limited_memory(300_000_000):
        np.ones(600_000_000, np.uint8)
    assert resource.getrlimit(resource.RLIMIT_DATA) == before


def test_only_files_in_the_folder_or_in_the_hubs_cache_are_read(tmp_path):
    root, blobs = tmp_path / "snapshots/0123", tmp_path / "blobs"
    for folder in (root, blobs, tmp_path / "other"):
        folder.mkdir(parents=True)
        (folder / "file").touch()
    (root / "in_hub").symlink_to(blobs / "file")
    (root / "folder").symlink_to(blobs)
    (root / "elsewhere").symlink_to(tmp_path / "other/file")
    for name in ("file", "in_hub"):
        check_inside(root, root / name)
    for name in ("folder", "elsewhere", "x/../../../other/file"):
        with pytest.raises(EpisodeError, match="leads out"):
            check_inside(root, root / name)


def with_catalog(tub: Path) -> Path:
    (tub / "catalog_0.catalog").touch()
    return tub


READERS = {
    "run.json": lambda path: read_stage(path, "run"),
    "car.yml": read_car,
    "flight.log": read_log,
    "episode_data.json": lambda path: load_recordings(path.parent, 8),
    "best_model.pth": load_checkpoint,
    "calibration.pt": Calibration.load,
    "manifest.json": lambda path: load_recordings(with_catalog(path.parent)),
}


def without_end(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(1 << 40)


THINGS = {"a pipe": os.mkfifo, "a device": lambda path: path.symlink_to("/dev/zero"), "a terabyte": without_end}


@pytest.mark.parametrize("name", READERS)
def test_a_sentence_at_once(tmp_path, name):
    for thing, make in THINGS.items():
        path = tmp_path / thing / name
        path.parent.mkdir(parents=True)
        make(path)
        said = hostile.outcome_of(READERS[name], path)
        assert said.startswith("said "), f"{thing} as {name}: {said}"


def test_a_car_that_refers_to_itself_many_times(tmp_path):
    lines = ["a0: &a0 [x, x]", *(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 12))]
    (tmp_path / "car.yml").write_text("\n".join([*lines, "steering: *a11"]))
    assert hostile.outcome_of(read_car, tmp_path / "car.yml").startswith("said ")


SMALL_VALUES = {
    "episode_data.json": b"[" + b'{"":0},' * 400_000 + b"0]",
    "control_data.csv": b"a,b,c,d\n" + b"1\n" * 10_000_000,
    "manifest.json": b'{"paths": [' + b"0," * 4_000_000 + b"0]}",
    "catalog_0.catalog": b"1\n" * 4_000_000,
}


@pytest.mark.parametrize("name", SMALL_VALUES)
def test_what_takes_many_times_its_size(tmp_path, name):
    (tmp_path / "manifest.json").write_text('{"paths": ["catalog_0.catalog"]}')
    (tmp_path / "episode_data.json").touch()
    (tmp_path / name).write_bytes(SMALL_VALUES[name])
    assert hostile.outcome_of(load_recordings, tmp_path, most_bytes=50_000_000).startswith("said ")

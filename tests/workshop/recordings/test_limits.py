"""What a stranger's dataset may not do to a decoder: start a program, take gigabytes, or leave its folder."""

import resource

import av
import cv2
import hostile
import numpy as np
import pyarrow
import pytest
from pyarrow import parquet

from rover_lib.onboard.errors import EpisodeError
from rover_lib.workshop.recordings.limits import (
    check_encoded,
    check_inside,
    check_table,
    check_video,
    limited_memory,
)

SIZE = (54, 96)
POSTSCRIPT = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 96 54\nshowpage\n"
PICTURE = cv2.imencode(".png", hostile.scene(size=SIZE[::-1]))[1].tobytes()
ICON = b"\0\0\1\0\1\0\0\0\0\0\1\0\x20\0" + len(PICTURE).to_bytes(4, "little") + b"\x16\0\0\0" + PICTURE


@pytest.mark.parametrize("encoded", [POSTSCRIPT, ICON, b"", None], ids=["PostScript", "ICO", "nothing", "a path"])
def test_only_png_and_jpeg_are_decoded(encoded):
    with pytest.raises(EpisodeError, match="neither PNG nor JPEG"):
        check_encoded("x", {"bytes": encoded, "path": "/dev/zero"}, SIZE)


def test_a_picture_has_the_size_that_the_dataset_says():
    for picture in (PICTURE, hostile.jpeg(hostile.scene(size=SIZE[::-1]))):
        check_encoded("x", {"bytes": picture}, SIZE)
    for claimed in (hostile.claims(hostile.WHOLE, 640, 54), hostile.claims(hostile.WHOLE, 65_000, 65_000)):
        with pytest.raises(EpisodeError):
            check_encoded("x", {"bytes": claimed}, SIZE)


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

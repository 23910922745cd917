"""The newest frame: of folders, videos, streams through a FIFO, and of what stops or changes."""

import os
import threading
import time

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rover_lib.onboard import camera as c
from rover_lib.onboard.camera import Camera, CameraError


def jpeg(value: int, size=(64, 36)) -> bytes:
    image = np.full((size[1], size[0], 3), value, np.uint8)
    image[0, 0] = (value + 40) % 256
    return cv2.imencode(".jpg", image)[1].tobytes()


@pytest.fixture
def fifo(tmp_path):
    path = tmp_path / "camera"
    os.mkfifo(path)
    return path


class Writer:
    """The other end of a FIFO, opened as soon as somebody reads."""

    def __init__(self, path):
        self._path, self.fd = path, None

    def write(self, data: bytes):
        if self.fd is None:
            self.fd = os.open(self._path, os.O_WRONLY)
        while data:
            data = data[os.write(self.fd, data) :]

    def close(self):
        if self.fd is not None:
            os.close(self.fd)
            self.fd = None


@pytest.fixture
def writer(fifo):
    writer = Writer(fifo)
    yield writer
    writer.close()


@pytest.fixture
def camera(fifo, writer):
    first = threading.Thread(target=writer.write, args=(jpeg(100),))
    first.start()
    with Camera(fifo) as camera:
        first.join()
        yield camera


def test_only_the_newest_is_kept(camera, writer):
    assert camera.latest().number == 1
    for number, value in enumerate((110, 120, 130), 1):
        writer.write(jpeg(value))
        frame = camera.wait(number, 1.0)
    assert frame.image[20, 20, 0] == pytest.approx(130, abs=2)
    assert camera.latest() is frame
    assert 0 <= time.monotonic() - frame.captured_s < 1
    assert camera.wait(frame.number, 0.05) is None


def test_of_frames_that_wait_the_last_is_taken(camera, writer):
    writer.write(b"".join(jpeg(v) for v in (10, 20, 30, 40)))
    frame = camera.wait(1, 1.0)
    while (later := camera.wait(frame.number, 0.2)) is not None:
        frame = later
    assert frame.image[20, 20, 0] == pytest.approx(40, abs=2)


def test_a_frame_in_pieces(camera, writer):
    data = jpeg(77)
    for i in range(0, len(data), 100):
        writer.write(data[i : i + 100])
    assert camera.wait(1, 1.0).image[20, 20, 0] == pytest.approx(77, abs=2)


def test_the_same_frame_again_is_counted(camera, writer):
    for repeats in (1, 2, 3):
        writer.write(jpeg(100))
        assert camera.wait(repeats, 1.0).repeats == repeats
    writer.write(jpeg(101))
    frame = camera.wait(4, 1.0)
    assert frame.repeats == 0
    assert frame.mean == pytest.approx(101, abs=3)


def test_an_unplugged_camera(camera, writer):
    writer.close()
    with pytest.raises(CameraError, match="ended after 1 frames; is the camera unplugged"):
        camera.wait(1, 2.0)
    with pytest.raises(CameraError):
        camera.latest()


def test_another_size(camera, writer):
    writer.write(jpeg(100, (32, 36)))
    with pytest.raises(CameraError, match="changed from 64x36 to 32x36"):
        camera.wait(1, 2.0)


def test_what_is_no_stream_of_jpegs(camera, writer, monkeypatch):
    monkeypatch.setattr(c, "JPEG_MOST", 10_000)
    writer.write(bytes(20_000))
    with pytest.raises(CameraError, match="no JPEG in"):
        camera.wait(1, 2.0)


def test_no_frame_at_all(fifo, monkeypatch):
    monkeypatch.setattr(c, "FIRST_FRAME_S", 0.2)
    with pytest.raises(CameraError, match=r"no frame within 0\.2 s"), Camera(fifo):
        pass


@pytest.mark.parametrize("source", ["63", "/dev/video63", "no/such/folder"])
def test_no_such_camera(source):
    with pytest.raises(CameraError, match="no such camera"):
        Camera(source).open()


def test_a_folder_and_its_end(tmp_path):
    (tmp_path / "frames").mkdir()
    for i in range(3):
        (tmp_path / "frames" / f"frame_{i:06d}.jpg").write_bytes(jpeg(50 + i))
    with Camera(tmp_path, rate_hz=50) as camera:
        numbers = []
        with pytest.raises(CameraError, match="ended after 3 frames"):
            while True:
                numbers.append(camera.wait(max(numbers, default=0), 1.0).number)
    assert 1 <= len(numbers) <= 3
    assert numbers == sorted(set(numbers))


def test_an_empty_folder(tmp_path):
    with pytest.raises(CameraError, match="no pictures"):
        Camera(tmp_path).open()


def test_a_video(tmp_path):
    path = tmp_path / "drive.avi"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 50, (64, 36))
    assert video.isOpened()
    for i in range(5):
        video.write(np.full((36, 64, 3), 20 * i, np.uint8))
    video.release()
    with Camera(path) as camera:
        assert camera.wait(3, 1.0).image.shape == (36, 64, 3)
        assert 20 < camera.rate_hz < 80
    (tmp_path / "no.avi").write_bytes(b"nothing")
    with pytest.raises(CameraError, match="no video"):
        Camera(tmp_path / "no.avi").open()


def test_a_file_of_jpegs(tmp_path):
    (tmp_path / "drive.mjpeg").write_bytes(b"".join(jpeg(v) for v in (10, 20, 30)))
    with Camera(tmp_path / "drive.mjpeg", rate_hz=100) as camera, pytest.raises(CameraError, match="after 3 frames"):
        camera.wait(3, 1.0)


def test_a_reader_that_breaks(fifo, monkeypatch):
    def broken(*_):
        yield np.zeros((4, 4, 3), np.uint8), None
        time.sleep(0.1)
        raise RuntimeError("the driver is gone")

    monkeypatch.setattr(c, "_fifo", broken)
    with Camera(fifo) as camera, pytest.raises(CameraError, match="the driver is gone"):
        camera.wait(1, 1.0)


@pytest.mark.parametrize("own", ["now", "another clock's", "the future"])
def test_the_cameras_own_time_counts_if_it_can_be(fifo, monkeypatch, own):
    given_s = {"now": time.monotonic() - 0.02, "another clock's": 1.0, "the future": time.monotonic() + 60}[own]

    def stamped(*_):
        yield np.zeros((4, 4, 3), np.uint8), given_s
        time.sleep(0.5)

    monkeypatch.setattr(c, "_fifo", stamped)
    with Camera(fifo) as camera:
        captured_s = camera.latest().captured_s
        assert (captured_s == given_s) == (own == "now")
        assert abs(time.monotonic() - captured_s) < 0.5


@given(st.binary(max_size=400), st.lists(st.integers(1, 60), max_size=20))
def test_wild_streams_give_whole_jpegs_or_nothing(data, cuts):
    stream = data + jpeg(50) + data + jpeg(60) + data
    pieces, at = [], 0
    for cut in [*cuts, len(stream)]:
        pieces.append(stream[at : at + cut])
        at += cut
    pieces.append(stream[at:])
    whole = list(c._split(iter(pieces)))
    assert all(w.startswith(b"\xff\xd8") and w.endswith(b"\xff\xd9") for w in whole)
    if b"\xff" not in data:
        assert len(whole) == 2

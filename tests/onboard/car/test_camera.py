"""The newest frame: from folders, films and streams through a FIFO, also when these stop or change."""

import os
import threading
import time

import cv2
import hostile
import numpy as np
import pytest
import recorded
from hypothesis import given
from hypothesis import strategies as st

from rover_lib.onboard.car import camera as c
from rover_lib.onboard.car.camera import Camera, CameraError
from rover_lib.onboard.car.picture import decode_jpeg


def jpeg(value: int, size=(64, 36)) -> bytes:
    return hostile.jpeg(np.full((size[1], size[0], 3), value, np.uint8))


@pytest.fixture
def fifo(tmp_path):
    path = tmp_path / "camera"
    os.mkfifo(path)
    return path


class Writer:
    """The other end of a FIFO. The first write opens it, and waits until somebody reads."""

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


def test_the_same_frame_again_is_counted(camera, writer):
    for repeats in (1, 2, 3):
        writer.write(jpeg(100))
        assert camera.wait(repeats, 1.0).repeats == repeats
    writer.write(jpeg(101))
    frame = camera.wait(4, 1.0)
    assert frame.repeats == 0
    assert frame.mean == pytest.approx(101, abs=3) and frame.contrast == 0


def test_an_unplugged_camera(camera, writer):
    writer.close()
    with pytest.raises(CameraError, match="ended after 1 frames; is the camera unplugged"):
        camera.wait(1, 2.0)
    with pytest.raises(CameraError):
        camera.latest()


def test_what_cannot_be_read_is_said(tmp_path):
    (tmp_path / "drive.mp4").touch()
    for source, message in (("63", "no such camera"), (tmp_path, "no pictures"), (tmp_path / "drive.mp4", "ffmpeg")):
        with pytest.raises(CameraError, match=message):
            Camera(source).open()


def test_pictures_of_another_form_are_refused(readings):
    readings.read([*live(5), jpeg(100, (32, 36))])
    assert "changed from 160x90 to 32x36" in readings.ended
    small = Readings()
    small.read([jpeg(100, (40, 20))])
    assert "too small" in small.ended


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


def test_a_film_begins_when_it_is_told_to():
    """Until then its pictures repeat, so that arming may take its time; then each comes once, from the first on."""
    begun, pictures = threading.Event(), [b"a", b"b", b"c"]
    reader = c._pace(lambda: iter(pictures), 1000, threading.Event(), begun)
    assert [next(reader)[0] for _ in range(7)] == [b"a", b"b", b"c", b"a", b"b", b"c", b"a"]
    begun.set()
    assert [picture for picture, _ in reader] == pictures
    assert list(c._pace(lambda: iter(()), 1000, threading.Event(), threading.Event())) == []


@pytest.mark.parametrize(("at", "axis"), [(0, 0), (0.5, 1), (0.95, 0)])
def test_a_camera_that_is_frozen_but_for_a_strip_is_frozen(at, axis):
    """A strip of 5 % lies in one or two rows or columns of the blocks that are compared; it drove on."""
    rng, camera = np.random.default_rng(0), Camera("frozen")
    picture = rng.integers(0, 255, (360, 640, 3), np.uint8)
    size = picture.shape[axis]
    strip = slice(int(at * size), int(at * size) + size // 20)
    for _ in range(4):
        part = picture[strip] if axis == 0 else picture[:, strip]
        part[:] = rng.integers(0, 255, part.shape, np.uint8)
        camera.add(picture.copy(), 0.0, None)
    assert camera.latest().repeats == 3


def test_no_picture_of_a_real_drive_counts_as_frozen():
    """The most equal ones share a fiftieth of their blocks."""
    for episode in sorted(recorded.real_recordings().glob("episode_*")):
        camera = Camera("recorded")
        for jpeg in sorted((episode / "frames").glob("*.jpg")):
            camera.add(decode_jpeg(jpeg.read_bytes()), 0.0, None)
            assert camera.latest().repeats == 0


def test_a_film_that_begins_again_is_no_frozen_camera():
    rng = np.random.default_rng(0)
    pictures = [rng.integers(0, 255, (36, 64, 3), np.uint8) for _ in range(6)]
    camera = Camera("film", held=True)

    def repeats() -> list[int]:
        shown = []
        for picture in pictures:
            camera.add(picture, 0.0, None)
            shown.append(camera.latest().repeats)
        return shown

    assert repeats() == [0] * 6
    assert repeats() == [1, 2, 3, 4, 5, 6]  # these do no harm: nobody drives with it yet
    camera.begin()
    assert repeats() == [0] * 6
    assert repeats() == [1, 2, 3, 4, 5, 6]


# ---- what is no frame, on a virtual clock


class Clock:
    """A machine's monotonic clock and its wall clock."""

    def __init__(self):
        self.now_s, self.wall_ahead_s = 5000.0, 1.7e9

    def __call__(self):
        return self.now_s

    def wall(self):
        return self.now_s + self.wall_ahead_s


class Readings:
    """A camera that is read without a thread: the frames that it gives, and the error that ends it."""

    def __init__(self):
        self.clock = Clock()
        self.camera = Camera("camera", clock=self.clock, wall_clock=self.clock.wall)

    def read(self, pictures, stamp=lambda now_s, i: None):
        """Read at 30 Hz until it fails. Returns (number, repeats, age in s) of the newest frame after each picture."""
        newest = []

        def reader():
            for i, picture in enumerate(pictures):
                self.clock.now_s += 1 / 30
                yield picture, stamp(self.clock.now_s, i)
                if frame := self.camera._frame:
                    newest.append((frame.number, frame.repeats, self.clock.now_s - frame.captured_s))

        self.camera._read(reader())
        return newest

    @property
    def ended(self):
        with pytest.raises(CameraError) as failure:
            self.camera.latest()
        return str(failure.value)


@pytest.fixture
def readings():
    return Readings()


def live(count, seed=0):
    """Return pictures of a still scene with a sensor's noise."""
    rng = np.random.default_rng(seed)
    scene = hostile.scene(size=(160, 90))
    return [hostile.jpeg(cv2.add(scene, rng.integers(0, 3, scene.shape, np.uint8))) for _ in range(count)]


@pytest.mark.parametrize("ring", [1, 3, 31])
def test_a_ring_of_old_pictures_shows_nothing_new(readings, ring):
    newest = readings.read(live(50) + live(50)[50 - ring :] * 40)
    repeats = [repeats for _, repeats, _ in newest]
    assert repeats[:50] == [0] * 50
    assert repeats[50:90] == list(range(1, 41))


def test_damaged_pictures_are_left_out_and_four_in_a_row_are_a_fault(readings):
    good = live(20)
    damaged = [hostile.cut(picture) for picture in good]
    newest = readings.read([*good[:5], *damaged[5:8], *good[8:12], *damaged[12:]])
    assert len(newest) == 15  # the fourth of them ends it, 0.13 s after the last good one
    assert newest[7][0] == 5 and newest[11][0] == 9
    assert "4 pictures in a row were no frames: a JPEG is damaged or cut short" in readings.ended


LATE_S = 0.02
CLOCKS = {
    "monotonic": lambda now_s, i: now_s - LATE_S,
    "wall": lambda now_s, i: now_s + 1.7e9 - LATE_S,
    "no": lambda now_s, i: 1.0,
}


@pytest.mark.parametrize("kind", CLOCKS)
def test_the_clock_of_a_cameras_time_stamps_is_found(readings, kind):
    newest = readings.read(live(10), CLOCKS[kind])
    assert readings.camera.time_stamps == kind
    assert [number for number, _, _ in newest] == [1, 2, 3, 4, 5, 6]  # the first five only decide the clock
    assert all(age_s == pytest.approx(0.0 if kind == "no" else LATE_S, abs=1e-5) for _, _, age_s in newest)


@pytest.mark.parametrize(("kind", "late_s"), [("monotonic", 1.5), ("wall", 30.0), ("wall", -1.0)])
def test_stamps_that_become_old_are_a_fault(readings, kind, late_s):
    newest = readings.read(live(30), lambda now_s, i: CLOCKS[kind](now_s, i) - (late_s if i >= 20 else 0))
    assert newest[-1][0] == 16 and len(newest) == 19
    assert "time stamp" in readings.ended
    still = Readings()
    newest = still.read(live(30), lambda now_s, i: min(now_s, 5000 + 20 / 30))
    assert newest[-1][0] == 16 and len(newest) == 19 and "the same again" in still.ended


@pytest.mark.parametrize("stamp", [lambda now_s, i: now_s - 1.5, lambda now_s, i: now_s - 30, lambda now_s, i: 4999.0])
def test_stamps_that_were_never_of_now_are_no_frames(readings, stamp):
    assert readings.read(live(30), stamp) == []
    assert readings.camera._refusal.what == "a frame's time stamp is not of now"


def test_the_wall_clock_may_be_set(readings):
    def stamp(now_s, i):
        if i == 12:
            readings.clock.wall_ahead_s += 3600  # the clock is set while this frame is on its way
            return now_s - 3600 + readings.clock.wall_ahead_s - 3600
        return readings.clock.wall() - 0.02

    newest = readings.read(live(20), stamp)
    assert newest[-1][0] == 15 and readings.camera.time_stamps == "wall"


def test_a_camera_whose_pictures_are_none_says_why(fifo, writer, monkeypatch):
    monkeypatch.setattr(c, "FIRST_FRAME_S", 0.3)
    feeding = threading.Thread(target=writer.write, args=(hostile.cut(hostile.WHOLE),))
    feeding.start()
    with pytest.raises(CameraError, match=r"no frame within 0\.3 s: a JPEG is damaged or cut short"), Camera(fifo):
        pass
    feeding.join()


class Device:
    """The part of OpenCV's V4L2 device that is used here."""

    def __init__(self, fourcc, picture):
        self.fourcc, self.picture, self.converts = fourcc, picture, True

    def __call__(self, source, backend):
        return self

    def isOpened(self):
        return True

    def set(self, what, value):
        if what == cv2.CAP_PROP_CONVERT_RGB:
            self.converts = bool(value)
        return True

    def get(self, what):
        return {cv2.CAP_PROP_FOURCC: self.fourcc, cv2.CAP_PROP_POS_MSEC: 2500.0}[what]

    def read(self):
        return True, cv2.imdecode(np.frombuffer(self.picture, np.uint8), 1) if self.converts else self.picture

    def release(self):
        pass


@pytest.mark.parametrize("fourcc", ["MJPG", "YUYV"])
def test_jpegs_of_a_device_are_decoded_here_and_others_by_opencv(monkeypatch, fourcc):
    """OpenCV gives a device's JPEG as (1, bytes) uint8 if told not to convert it."""
    device = Device(cv2.VideoWriter.fourcc(*fourcc), np.frombuffer(hostile.WHOLE, np.uint8)[None])
    monkeypatch.setattr(cv2, "VideoCapture", device)
    picture, stamp_s = next(c._v4l2("/dev/video0", (640, 360), 30))
    assert (picture == hostile.WHOLE) if fourcc == "MJPG" else picture.shape == (360, 640, 3)
    assert stamp_s == 2.5


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

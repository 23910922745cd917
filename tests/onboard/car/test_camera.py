"""The newest frame: from streams and devices, also when these stop, change or repeat themselves."""

import os
from unittest.mock import Mock, call

import cv2
import numpy as np
import pytest

from rover_lib.onboard.car import camera as c
from rover_lib.onboard.car.camera import Camera, CameraError
from rover_lib.onboard.car.picture import decode_jpeg
from tests.helpers import hostile, recorded

SIZE = 160, 90


def jpeg(value: int, size=(64, 36)) -> bytes:
    return hostile.jpeg(np.full((size[1], size[0], 3), value, np.uint8))


def live(count):
    """Return pictures of a still scene with a sensor's noise."""
    rng, scene = np.random.default_rng(0), hostile.scene(size=SIZE)
    return [hostile.jpeg(cv2.add(scene, rng.integers(0, 3, scene.shape, np.uint8))) for _ in range(count)]


def test_of_a_stream_only_the_newest_is_kept_until_it_ends(tmp_path):
    os.mkfifo(tmp_path / "camera")
    fd = os.open(tmp_path / "camera", os.O_RDWR)
    os.write(fd, b"rubbish" + jpeg(100))
    with Camera(tmp_path / "camera") as camera:
        for number, value in enumerate((110, 120, 130), 1):
            os.write(fd, jpeg(value)[:300])
            os.write(fd, jpeg(value)[300:])
            frame = camera.wait(number, 1.0)
            assert frame.image[20, 20, 0] == pytest.approx(value, abs=2)
        assert camera.latest() is frame and camera.wait(frame.number, 0.05) is None
        os.close(fd)
        with pytest.raises(CameraError, match="ended after 4 frames; is the camera unplugged"):
            camera.wait(4, 2.0)


def test_what_cannot_be_read_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(c, "FIRST_FRAME_S", 0.3)
    os.mkfifo(tmp_path / "cut")
    fd = os.open(tmp_path / "cut", os.O_RDWR)
    os.write(fd, hostile.cut(jpeg(100)))
    for source, message in (
        ("63", "no such camera"),
        (tmp_path, "neither a camera nor"),
        (tmp_path / "cut", r"no frame within 0\.3 s: a JPEG is damaged or cut short"),
    ):
        with pytest.raises(CameraError, match=message):
            Camera(source).open()
    os.close(fd)


SHED = """
import numpy as np

class Shed:
    def read(self, source, size, rate_hz, closing):
        while not closing.wait(1 / rate_hz):
            yield np.full((size[1], size[0], 3), len(source), np.uint8), None
"""


def test_a_kind_of_camera_of_another_package_is_found_by_its_name(tmp_path, monkeypatch):
    about = tmp_path / "shed-1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Name: shed\nVersion: 1\n")
    (about / "entry_points.txt").write_text("[rover_lib.cameras]\nshed = shed:Shed\n")
    (tmp_path / "shed.py").write_text(SHED)
    monkeypatch.syspath_prepend(tmp_path)
    with Camera("shed:7", size=SIZE) as camera:
        image = camera.wait(0, 1.0).image
    assert image.shape == (90, 160, 3) and (image == len("shed:7")).all()


def test_a_camera_that_is_frozen_but_for_a_strip_is_frozen():
    """A strip of 5 % lies in one or two rows or columns of the blocks that are compared; it drove on."""
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 255, (360, 640, 3), np.uint8)
    for strip in (picture[:18], picture[:, 320:352]):
        camera = Camera("frozen")
        for _ in range(4):
            strip[:] = rng.integers(0, 255, strip.shape, np.uint8)
            camera.add(picture.copy(), 0.0, None)
        assert camera.latest().repeats == 3


def test_no_picture_of_a_real_drive_counts_as_frozen():
    for episode in sorted(recorded.real_recordings().glob("episode_*")):
        camera = Camera("recorded")
        for jpeg in sorted((episode / "frames").glob("*.jpg")):
            camera.add(decode_jpeg(jpeg.read_bytes()), 0.0, None)
            assert camera.latest().repeats == 0


class Readings:
    """A camera that is read without a thread: the frames that it gives, and the error that ends it."""

    def __init__(self):
        self.now_s = 5000.0
        self.camera = Camera("camera", clock=lambda: self.now_s)

    def read(self, pictures, stamp=lambda now_s, i: None):
        """Read at 30 Hz until it fails. Returns (number, repeats, age in s) of the newest frame after each picture."""
        newest = []

        def reader():
            for i, picture in enumerate(pictures):
                self.now_s += 1 / 30
                yield picture, stamp(self.now_s, i)
                if frame := self.camera._frame:
                    newest.append((frame.number, frame.repeats, self.now_s - frame.captured_s))

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


def test_pictures_of_another_form_are_refused(readings):
    readings.read([*live(5), jpeg(100, (32, 36))])
    assert "changed from 160x90 to 32x36" in readings.ended
    small = Readings()
    small.read([jpeg(100, (40, 20))])
    assert "too small" in small.ended


@pytest.mark.parametrize("ring", [1, 31])
def test_a_ring_of_old_pictures_shows_nothing_new(readings, ring):
    newest = readings.read(live(50) + live(50)[50 - ring :] * 40)
    assert [repeats for _, repeats, _ in newest][:90] == [0] * 50 + list(range(1, 41))


def test_damaged_pictures_are_left_out_and_four_in_a_row_are_a_fault(readings):
    good = live(20)
    damaged = [hostile.cut(picture) for picture in good]
    newest = readings.read([*good[:5], *damaged[5:8], *good[8:12], *damaged[12:]])
    assert len(newest) == 15  # the fourth of them ends it, 0.13 s after the last good one
    assert newest[7][0] == 5 and newest[11][0] == 9
    assert "4 pictures in a row were no frames: a JPEG is damaged or cut short" in readings.ended


@pytest.mark.parametrize(
    ("stamp", "kind", "age_s"),
    [(lambda now_s, i: now_s - 0.02, "monotonic", 0.02), (lambda now_s, i: now_s + 1.7e9, "no", 0)],
)
def test_a_frame_is_as_old_as_its_time_stamp_if_that_is_the_machines(readings, stamp, kind, age_s):
    newest = readings.read(live(10), stamp)
    assert readings.camera.time_stamps == kind and len(newest) == 10
    assert all(age == pytest.approx(age_s, abs=1e-5) for _, _, age in newest)


@pytest.mark.parametrize(
    ("stamp", "found"), [(lambda now_s: now_s - 1.5, "1.50 s ago"), (lambda now_s: 5000 + 20 / 30, "the same again")]
)
def test_stamps_that_become_old_are_a_fault_and_those_that_always_were_no_frames(readings, stamp, found):
    newest = readings.read(live(30), lambda now_s, i: now_s if i < 20 else stamp(now_s))
    assert newest[-1][0] == 20 and len(newest) == 23
    assert "time stamp" in readings.ended and found in readings.ended
    assert Readings().read(live(30), lambda now_s, i: stamp(now_s) - 2) == []


@pytest.mark.parametrize("fourcc", ["MJPG", "YUYV"])
def test_jpegs_of_a_device_are_decoded_here_and_others_by_opencv(monkeypatch, fourcc):
    """OpenCV gives a device's JPEG as (1, bytes) uint8 if told not to convert it."""
    is_jpeg, given = fourcc == "MJPG", hostile.scene()
    if is_jpeg:
        given = np.frombuffer(hostile.WHOLE, np.uint8)[None]
    device = Mock(read=lambda: (True, given))
    device.get = {cv2.CAP_PROP_FOURCC: cv2.VideoWriter.fourcc(*fourcc), cv2.CAP_PROP_POS_MSEC: 2500.0}.get
    monkeypatch.setattr(cv2, "VideoCapture", lambda source, backend: device)
    picture, stamp_s = next(c._v4l2("/dev/video0", (640, 360), 30))
    assert (call(cv2.CAP_PROP_CONVERT_RGB, 0) in device.set.mock_calls) == is_jpeg
    assert picture == hostile.WHOLE if is_jpeg else picture is given
    assert stamp_s == 2.5

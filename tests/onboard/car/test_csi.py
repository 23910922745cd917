"""A Raspberry Pi camera through rpicam-vid: against a stand-in that speaks its protocol, as no machine here has one."""

import os
import time

import cv2
import numpy as np
import pytest
import rpicam_vid
from hypothesis import given
from hypothesis import strategies as st

from rover_lib.onboard.car.camera import Camera, CameraError
from rover_lib.onboard.car.csi import command, is_csi, newest_jpeg

SIZE = 96, 64


@pytest.fixture
def csi(tmp_path, monkeypatch):
    """Make a stand-in on PATH, with a fault; return Camera for it."""
    rng = np.random.default_rng(0)
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for i in range(40):
        cv2.imwrite(str(pictures / f"{i:03}.jpg"), rng.integers(0, 256, (SIZE[1], SIZE[0], 3), np.uint8))
    monkeypatch.setenv("PATH", str(rpicam_vid.install(tmp_path)), prepend=os.pathsep)
    monkeypatch.setenv("ROVER_CSI", str(pictures))

    def make(fault=""):
        monkeypatch.setenv("ROVER_CSI_FAULT", fault)
        return Camera("csi", size=SIZE, rate_hz=60.0)

    return make


def test_the_command_has_size_rate_and_exposure(monkeypatch):
    line = command("csi:1,shutter=8000,gain=4.5", (640, 360), 30.0, "/proc/self/fd/7")
    assert line[:3] == ["rpicam-vid", "--nopreview", "--flush"]
    options = "camera=1 width=640 height=360 framerate=30.0 shutter=8000 gain=4.5 exposure=sport timeout=0"
    assert {f"--{option}" for option in options.split()} <= set(line) and "--metadata=/proc/self/fd/7" in line
    assert "--camera=0" in command("csi,exposure=normal", (640, 360), 30.0, "7")
    for wrong in ("csi:x", "csi:", "csi,output=/etc/passwd", "csi,gain=1 --output=x", "csi,gain"):
        assert is_csi(wrong)
        with pytest.raises(CameraError, match="not understood"):
            command(wrong, (640, 360), 30.0, "7")
    monkeypatch.setenv("PATH", "")
    with pytest.raises(CameraError, match="rpicam-apps"):
        Camera("csi").open()


def test_frames_have_the_sensors_time_stamps(csi):
    with csi() as camera:
        frame = camera.latest()
        for _ in range(20):
            before, frame = frame, camera.wait(frame.number, 1.0)
            age_s = time.monotonic() - frame.captured_s
            assert 0.004 < age_s < 0.3
            assert before.captured_s < frame.captured_s
        assert camera.time_stamps == "monotonic"
        assert frame.image.shape == (SIZE[1], SIZE[0], 3) and frame.jpeg is not None and frame.repeats == 0


@pytest.mark.parametrize(
    ("fault", "sentence"),
    [
        ("gone", "rpicam-vid has ended: ERROR: .* no cameras available"),
        ("silent", "no frame within"),
        ("die 20", "rpicam-vid has ended: ERROR: .* failed to write"),
        ("freeze 20", "no new frame came for 1"),
        ("lose 20", "no new frame came for 1"),  # else each later picture waits for ever
    ],
)
def test_what_goes_wrong_is_said(csi, monkeypatch, fault, sentence):
    monkeypatch.setattr("rover_lib.onboard.car.camera.FIRST_FRAME_S", 2.0)
    with pytest.raises(CameraError, match=sentence), csi(fault) as camera:
        while True:
            camera.wait(camera.frames, 0.1)


@given(st.binary(max_size=400), st.lists(st.integers(1, 60), max_size=20))
def test_wild_streams_give_whole_jpegs_or_nothing(data, cuts):
    wanted = b"\xff\xd8\xff good \xff\xd9", b"\xff\xd8\xff too \xff\xd9"
    stream, pending, found = data + wanted[0] + data + wanted[1] + data, bytearray(), []
    for cut in [*cuts, len(stream)]:
        pending += stream[:cut]
        stream = stream[cut:]
        found.append(newest_jpeg(pending)[0])
    assert all(jpeg.startswith(b"\xff\xd8\xff") and jpeg.endswith(b"\xff\xd9") for jpeg in found if jpeg)
    if b"\xff" not in data:
        assert wanted[1] in found

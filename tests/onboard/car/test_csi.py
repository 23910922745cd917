"""A Raspberry Pi camera through rpicam-vid: against a stand-in that takes its options, as no machine here has one."""

import os
import sys

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rover_lib.onboard.car.camera import Camera, CameraError
from rover_lib.onboard.car.csi import command, cut_newest

SIZE = 96, 64
# The options are those of rpicam-apps' core/options.cpp and core/video_options.hpp. A fault comes after 20 pictures.
STAND_IN = f"""#!{sys.executable}
import argparse, itertools, pathlib, sys, time
parser = argparse.ArgumentParser("rpicam-vid", allow_abbrev=False)
for name in ("nopreview", "flush"):
    parser.add_argument("--" + name, action="store_true", required=True)
for name in ("camera", "width", "height", "shutter", "gain", "ev", "exposure", "awb", "rotation", "framerate"):
    parser.add_argument("--" + name)
for name, value in {{"timeout": "0", "codec": "mjpeg", "output": "-", "verbose": "0", "quality": "90"}}.items():
    parser.add_argument("--" + name, choices=[value], required=True)
here = pathlib.Path(__file__).parent
rate_hz, fault = float(parser.parse_args().framerate), (here / "fault").read_text()
if fault == "gone":
    sys.exit("ERROR: *** no cameras available ***")
for n, path in enumerate(itertools.cycle(sorted(here.glob("*.jpg")))):
    time.sleep(1 / rate_hz)
    if fault == "die" and n == 20:
        sys.exit("ERROR: *** failed to write output bytes ***")
    if not (fault == "silent" or (fault == "freeze" and n >= 20)):
        sys.stdout.buffer.write(path.read_bytes())
        sys.stdout.buffer.flush()
"""


@pytest.fixture
def csi(tmp_path, monkeypatch):
    """Make a stand-in on PATH, with a fault; return Camera for it."""
    rng = np.random.default_rng(0)
    for i in range(40):
        cv2.imwrite(str(tmp_path / f"{i:03}.jpg"), rng.integers(0, 256, (SIZE[1], SIZE[0], 3), np.uint8))
    program = tmp_path / "rpicam-vid"
    program.write_text(STAND_IN)
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)

    def make(fault):
        (tmp_path / "fault").write_text(fault)
        return Camera("csi", size=SIZE, rate_hz=60.0)

    return make


def test_the_command_has_size_rate_and_exposure(monkeypatch):
    line = command("csi:1,shutter=8000,gain=4.5", (640, 360), 30.0)
    assert line[:3] == ["rpicam-vid", "--nopreview", "--flush"]
    options = "camera=1 width=640 height=360 framerate=30.0 shutter=8000 gain=4.5 exposure=sport timeout=0"
    assert {f"--{option}" for option in options.split()} <= set(line)
    assert {"--camera=0", "--exposure=normal"} <= set(command("csi,exposure=normal", (640, 360), 30.0))
    for wrong in ("csi:x", "csi:", "csi,output=/etc/passwd", "csi,gain=1 --output=x", "csi,gain"):
        with pytest.raises(CameraError, match="not understood"):
            command(wrong, (640, 360), 30.0)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(CameraError, match="rpicam-apps"):
        Camera("csi").open()


@pytest.mark.parametrize(
    ("fault", "sentence"),
    [
        ("gone", "rpicam-vid has ended: ERROR: .* no cameras available"),
        ("silent", "no frame within"),
        ("die", "rpicam-vid has ended: ERROR: .* failed to write"),
        ("freeze", "no new frame came for 1"),
    ],
)
def test_what_goes_wrong_is_said(csi, monkeypatch, fault, sentence):
    monkeypatch.setattr("rover_lib.onboard.car.camera.FIRST_FRAME_S", 2.0)
    with pytest.raises(CameraError, match=sentence), csi(fault) as camera:
        assert camera.latest().image.shape == (SIZE[1], SIZE[0], 3)
        while True:
            camera.wait(camera.frames, 0.1)


@given(st.binary(max_size=400), st.lists(st.integers(1, 60), max_size=20))
def test_wild_streams_give_whole_jpegs_or_nothing(data, cuts):
    wanted = b"\xff\xd8\xff good \xff\xd9", b"\xff\xd8\xff too \xff\xd9"
    stream, pending, found = data + wanted[0] + data + wanted[1] + data, bytearray(), []
    for cut in [*cuts, len(stream)]:
        pending += stream[:cut]
        stream = stream[cut:]
        found.append(cut_newest(pending))
    assert all(jpeg.startswith(b"\xff\xd8\xff") and jpeg.endswith(b"\xff\xd9") for jpeg in found if jpeg)
    if b"\xff" not in data:
        assert wanted[1] in found

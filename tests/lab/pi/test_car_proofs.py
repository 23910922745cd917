"""What stands in for a camera and a gamepad on an emulated Pi, and what is made of the pins, without a Pi."""

import subprocess
import sys
from functools import partial
from types import SimpleNamespace

import pytest

from balloon_world.simulated_arduino import PinEvent
from lab.driving.pins import NEUTRAL_US
from lab.driving.virtual_gamepad import VirtualGamepad
from lab.pi import car_proofs
from rover_lib.onboard.car.gamepad import list_gamepads

OPENS = """
from pathlib import Path
from rover_lib.onboard.car import gamepad
print(gamepad.open_gamepad(lambda: gamepad.list_gamepads(Path("dev"), Path("sys"))).sticks() is None)
"""


def test_fifos_pass_for_the_kernels_gamepad(tmp_path):
    (tmp_path / "dev").mkdir()
    with VirtualGamepad(tmp_path):
        car_proofs.describe_gamepad(tmp_path / "sys")
        for fifo, event in (("pad", "event0"), ("motion", "event1")):
            (tmp_path / "dev" / event).symlink_to(tmp_path / fifo)
        (found,) = list_gamepads(tmp_path / "dev", tmp_path / "sys")
        assert (found.name, found.pad.name, found.motion.name) == ("stand-in", "event0", "event1")
        run = partial(subprocess.run, cwd=tmp_path, capture_output=True, text=True)
        assert "Inappropriate ioctl" in run([sys.executable, "-c", OPENS]).stderr
        assert run([sys.executable, "-c", car_proofs.ANSWERS + OPENS]).stdout == "True\n"


def test_the_package_has_what_apt_wants(tmp_path):
    (tmp_path / "etc/apt/sources.list.d").mkdir(parents=True)
    car_proofs.offer_camera(SimpleNamespace(bench=tmp_path, root=tmp_path))
    about = dict(line.split(": ") for line in (tmp_path / "debs/Packages").read_text().splitlines())
    deb = tmp_path / "debs" / about["Filename"]
    assert int(about["Size"]) == deb.stat().st_size
    subprocess.run(["dpkg-deb", "--extract", deb, tmp_path / "there"], check=True)
    assert "ROVER_CSI=/srv/bench/camera" in (tmp_path / "there/usr/bin/rpicam-vid").read_text()
    alone = [sys.executable, "-I", tmp_path / "there/usr/share/stand_in.py", "--help"]
    assert "--metadata-format" in subprocess.run(alone, capture_output=True, text=True, check=True).stdout


CUT, LINE = PinEvent(1.0, "reset", "", 0, 0), PinEvent(1.7, "line", "", 0, 0)


def pulses(at_s: float, **us: float) -> list[PinEvent]:
    return [PinEvent(at_s, "pulse", pin, each, 1016.0) for pin, each in us.items()]


@pytest.mark.parametrize("before, events, holds", [
    ([], [*pulses(0.9, throttle=209), CUT, *pulses(1.8, **NEUTRAL_US)], True),
    (pulses(0.5, **NEUTRAL_US), [CUT, *pulses(1.8, **NEUTRAL_US)], False),
    ([], [CUT, LINE, *pulses(1.8, **NEUTRAL_US)], False),
    ([], [CUT, *pulses(1.8, throttle=NEUTRAL_US["throttle"])], False),
    ([], pulses(1.8, **NEUTRAL_US), False),
])  # fmt: skip
def test_neutral_counts_only_from_power_on_and_untold(before, events, holds):
    row = car_proofs.neutral_row(before, events)
    assert row.holds == holds and row.found["from_ms"] == [800] * len(row.found["from_ms"])

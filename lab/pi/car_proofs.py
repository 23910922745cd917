"""Prove a Pi camera, a gamepad and the neutral from power-on with the real drive service, on an emulated Pi.

    offer_camera(pi)                        # before it boots: provisioning with VARIABLES finds rpicam-apps-lite there
    rows = camera_rows(pi, pins)            # rover_camera=csi; the service is stopped before and after
    rows += gamepad_rows(pi)                # rover_gamepad=true; then the Arduino's power is cut

This machine's kernel has neither a camera nor a gamepad. The package is made here, of the fault bench's stand-in for
rpicam-vid. The gamepad is two FIFOs with the kernel's group for such devices; sysfs names them, and the service's
Python has the answers to two ioctls that a FIFO has none for. All else is as on a Pi: groups, unit, sandbox, service,
link, firmware.
"""

import contextlib
import hashlib
import os
import re
import shlex
import shutil
import signal
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

from balloon_world.simulated_arduino import PinEvent
from lab.arduino.emulator import NICE, EmulatedArduino
from lab.driving import rpicam_vid
from lab.driving.pins import NEUTRAL_US, STEP_US
from lab.driving.virtual_gamepad import FULL, VirtualGamepad
from lab.pi.container import BENCH, CAMERA, Container
from lab.pi.emulation import EmulationError, wait_for
from lab.pi.pulses import READ_S, Pins, stopped
from lab.pi.report import Row
from lab.pi.service_proofs import arm, probe, show, unit_for
from rover_lib.onboard.car.gamepad import BTN_L1, SENSORS, STEERING, THROTTLE
from rover_lib.onboard.drive.service import UNIT, WAITING
from rover_lib.workshop.run_program import run

PACKAGE = "rpicam-apps-lite"  # of Raspberry Pi OS, which Debian lacks
CONTROL = f"Package: {PACKAGE}\nVersion: 0~stand-in\nArchitecture: all\nMaintainer: rover\nDescription: stand-in\n"
VARIABLES = {"rover_camera": "csi", "rover_gamepad": True}  # what provisioning needs for all rows
STOPPED_MS = 200.0  # from what ends a drive to throttle off
AT_SPEED_S = 1.0
ATTEMPTS = 3  # how often a drive is tried if it ends by itself, because this machine is too busy for it
SIDE_S, GESTURE_S = 0.4, 60.0
BEHIND_S = 0.1  # more than the emulated Arduino's clock, by which events are dated, may be behind this machine's
POWER_ON_S = 3.0  # how long the pins are watched; the emulated Arduino has no boot loader then
GAMEPAD_CAR = Path(__file__).parents[1] / "cars" / "gamepad.yml"
NODE = "/dev/input/event9"  # as evdev names and numbers them; nobody has plugged this one in
LOOK = f'echo "PROBED $(head -c1 {NODE} 2>&1)"'
# What the service's Python does first: FIFOs answer no ioctl.
ANSWERS = f"""
import array, types
from rover_lib.onboard.car import gamepad
def ioctl(fd, request, given):
    if request != gamepad.EVIOCSCLOCKID:
        given[1:3] = array.array("i", [-{FULL}, {FULL}])
gamepad.fcntl = types.SimpleNamespace(ioctl=ioctl)
"""
DEVICES = "/sys/fs/cgroup/devices"  # of cgroup v1: systemd-nspawn mounts it read-only, so that all devices are allowed
PLUG = f"""mkdir -p /dev/input /run/systemd/system/{UNIT}.d
mknod -m 660 {NODE} c 13 73
ln -s {BENCH}/pad /dev/input/event0; ln -s {BENCH}/motion /dev/input/event1
chmod 660 {BENCH}/pad {BENCH}/motion
chown root:input {NODE} {BENCH}/pad {BENCH}/motion
mount --bind {BENCH}/sys /sys/class/input
printf '[Service]\\nEnvironment=PYTHONPATH={BENCH} ROVER_CAR={BENCH}/car.yml\\n' > /run/systemd/system/{UNIT}.d/car.conf
! [ -e {DEVICES} ] || mount -o remount,bind,rw {DEVICES}
systemctl daemon-reexec
"""


def offer_camera(pi: Container) -> None:
    """Give a Pi that has not yet booted a source of packages with PACKAGE, which is a stand-in."""
    debs = pi.bench / "debs"
    debs.mkdir()
    deb = debs / f"{PACKAGE}.deb"
    program = f'#!/bin/sh\nROVER_CSI={CAMERA} exec python3 -I /usr/share/stand_in.py "$@"\n'
    with tempfile.TemporaryDirectory() as tree:
        for path, text in {
            "DEBIAN/control": CONTROL,
            f"usr/bin/{rpicam_vid.PROGRAM}": program,
            "usr/share/stand_in.py": Path(rpicam_vid.__file__).read_text(),
        }.items():
            Path(tree, path).parent.mkdir(parents=True)
            Path(tree, path).write_text(text)
            Path(tree, path).chmod(0o755)
        Path(tree).chmod(0o755)
        run("dpkg-deb", "--build", "--root-owner-group", tree, deb, error=EmulationError)
    content = deb.read_bytes()
    about = f"Filename: ./{deb.name}\nSize: {len(content)}\nSHA256: {hashlib.sha256(content).hexdigest()}\n"
    (debs / "Packages").write_text(CONTROL + about)
    (pi.root / "etc/apt/sources.list.d/stand-in.list").write_text(f"deb [trusted=yes] file:{BENCH}/debs ./\n")


def camera_rows(pi: Container, pins: Pins) -> list[Row]:
    """Return the rows about what provisioning installs for a Pi camera, and a drive whose rpicam-vid is killed."""
    package = pi.inside("dpkg-query", "--show", "--showformat=${Status}", PACKAGE, check=False).stdout
    unit = (pi.root / "etc/systemd/system" / UNIT).read_text()
    wanted = ["DeviceAllow=char-media rw", "DeviceAllow=char-dma_heap rw", "Groups=video", '--camera "csi"']
    found = [package, *(words for words in wanted if words in unit)]
    rows = [Row("rover_camera=csi, installed", ", ".join(wanted), found, found == ["install ok installed", *wanted])]
    with _driving(pi, pins) as armed_s:
        camera = pi.pid_of(int(pi.inside("pgrep", "--newest", "--full", "stand_in.py").stdout))
        kill = partial(os.kill, camera, signal.SIGKILL)
        return [*rows, _stops(pi, pins, armed_s, "stand-in for rpicam-vid killed", "rpicam-vid has ended", kill)]


def gamepad_rows(pi: Container) -> list[Row]:
    """Return the rows about the kernel's input devices, a drive whose gamepad is pulled out, and a power cut after it.

    They have an Arduino of their own, which keeps no car yet and stays plugged in.
    """
    with (
        VirtualGamepad(pi.bench) as pad,
        EmulatedArduino(human="gamepad", eeprom=b"", nice=NICE) as board,
        Pins(board) as pins,
    ):
        at_s = time.monotonic()
        describe_gamepad(pi.bench / "sys")
        shutil.copy(GAMEPAD_CAR, pi.bench / "car.yml")
        (pi.bench / "sitecustomize.py").write_text(ANSWERS)
        (pi.bench / "arduino").unlink()
        pi.plug(board.port)
        pi.inside("sh", "-ec", PLUG)
        rows = [_devices(pi)]
        before = [e for e in pins.since(at_s) if e.kind == "pulse"]
        with _driving(pi, pins, pad) as armed_s:
            rows += [_stops(pi, pins, armed_s, "gamepad of FIFOs pulled out", "the gamepad .* is gone", pad.unplug)]
        at_s = time.monotonic()
        time.sleep(BEHIND_S)
        board.power()
        time.sleep(POWER_ON_S)
        return [*rows, neutral_row(before, pins.since(at_s))]


def neutral_row(before: Sequence[PinEvent], events: Sequence[PinEvent]) -> Row:
    """Return the row about a board whose power was cut once, and whose port nobody opens.

    before: its pulses from before it was told of its car. events: all around the cut.
    """
    cuts_s = [e.monotonic_s for e in events if e.kind == "reset"]
    after = [e for e in events if e.kind == "pulse" and e.monotonic_s > max(cuts_s, default=0.0)]
    pulses = {pin: [e for e in after if e.pin == pin] for pin in NEUTRAL_US}
    off_us = [max((abs(e.pulse_us - NEUTRAL_US[pin]) for e in each), default=None) for pin, each in pulses.items()]
    found = {
        "pulses before the first drive": len(before),
        "cuts": len(cuts_s),
        "lines": sum(e.kind == "line" for e in events),
        "pulses": {pin: len(each) for pin, each in pulses.items()},
        "from_ms": [round((each[0].monotonic_s - cuts_s[-1]) * 1e3) for each in pulses.values() if each and cuts_s],
        "us off neutral": [us and round(us, 2) for us in off_us],
    }
    told_nothing = not before and len(cuts_s) == 1 and not found["lines"]
    holds = told_nothing and all(us is not None and us <= STEP_US for us in off_us)
    return Row("Arduino's power cut after a drive, its port closed", "its car's neutral on both pins", found, holds)


def describe_gamepad(sys: Path) -> None:
    """Make a folder that says of a VirtualGamepad, as event0 and event1, what sysfs says of a gamepad."""
    pad = f"{1 << STEERING | 1 << THROTTLE:x}", f"{1 << BTN_L1 % 64:x} 0 0 0 0", "0"
    for event, about in {"event0": pad, "event1": ("0", "0", f"{SENSORS:x}")}.items():
        device = sys / event / "device"
        (device / "capabilities").mkdir(parents=True)
        (device / "device").symlink_to("../..")
        names = "capabilities/abs", "capabilities/key", "properties", "name"
        for name, text in zip(names, (*about, "stand-in"), strict=True):
            (device / name).write_text(text)


def _devices(pi: Container) -> Row:
    """Return the row about what the unit lets the service open. Who may open NODE is told that there is no device."""
    unit = unit_for((pi.root / "etc/systemd/system" / UNIT).read_text(), f"/bin/sh -c {shlex.quote(LOOK)}")
    units = {"No such device": unit, "Operation not permitted": unit.replace("DeviceAllow=char-input r\n", "")}
    found = [probe(pi, "rover-probe.service", text) for text in units.values()]
    holds = all(map(str.__contains__, found, units))
    return Row(f"{NODE} in the service; without the unit's line for it", ", ".join(units), found, holds)


def _stops(pi: Container, pins: Pins, armed_s: float, what: str, said: str, break_it: Callable[[], object]) -> Row:
    at_s = time.monotonic()
    break_it()
    time.sleep(1 + READ_S)
    found = stopped(pins.since(armed_s), at_s)
    why = re.search(said, pi.inside("journalctl", f"--unit={UNIT}", "--output=cat", "--lines=40").stdout)
    in_time = found["after_ms"] is not None and found["after_ms"] <= STOPPED_MS
    holds = found["drove"] and found["neutral"] and in_time and why is not None
    return Row(what, f"throttle off within {STOPPED_MS:g} ms, '{said}'", found | {"said": why and why[0]}, holds)


def _gesture(pi: Container, pad: VirtualGamepad) -> bool:
    """Press L1 and make the gesture, as slowly as an emulated Pi needs it; return whether nothing is missing then."""
    pad.hold(False)
    pad.hold(True)
    pad.wiggle(SIDE_S)
    return WAITING in show(pi, "StatusText")["StatusText"]


@contextlib.contextmanager
def _driving(pi: Container, pins: Pins, pad: VirtualGamepad | None = None) -> Iterator[float]:
    """Start the service, and stop it afterwards; give when the car that drives now was asked for (monotonic seconds).

    pad: whoever holds it makes the gesture; without one, the Arduino's human does.
    """
    try:
        for left in reversed(range(ATTEMPTS)):
            pi.inside("systemctl", "reset-failed", UNIT, check=False)
            pi.inside("systemctl", "restart", UNIT)
            if pad:
                wait_for(partial(_gesture, pi, pad), GESTURE_S)
            with contextlib.ExitStack() if left == 0 else contextlib.suppress(EmulationError):
                armed_s = arm(pi, pins)
                time.sleep(AT_SPEED_S)
                if show(pi, "StatusText")["StatusText"].startswith("driving"):
                    break
        yield armed_s
    finally:
        pi.inside("systemctl", "stop", UNIT)

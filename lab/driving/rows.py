"""The faults that docs/safety.md names: what happens to a car at speed, and what must become of it, in virtual time.

    row = run_row(all_rows()["camera frozen"])        # as in results/lab/faults.json

The rows are in stories.yml; what happens in them alone, and how they are judged, is here. Twelve of these names, and
some that only a real process can have, are on the pins of an emulated Arduino too (on_pins.py).
"""

import contextlib
import functools
import itertools
import os
import re
import signal
import socket
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from balloon_world.simulated_arduino import PinEvent
from lab.driving.invariants import Run, broken
from lab.driving.pins import CONTINUES, DEFAULT, HUMAN, REFUSED, STOPPED, Command, Gates, Observation, judge, row_of
from lab.driving.stories import TOLD, Happen, Happening, Stage, Story, drive_story, during, read_stories, told
from lab.driving.virtual import STUCK, Killed, Seen
from lab.driving.virtual_host import scenery
from rover_lib.onboard.artifact.manifest import Artifact, seen_size
from rover_lib.onboard.car.camera import Camera
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.servo_link import frame
from rover_lib.onboard.drive.watch import stop_on_signals
from rover_lib.onboard.errors import CameraError, DriveFault, PolicyError, RoverError

AT_MS = 3000  # of a fault, when the car has been at speed for a while
END_MS, WIGGLE_MS, AGAIN_MS, STOP_MS = 5200, 5600, 7000, 8400  # the drive's end, and then another without the fault
WATCH_MS = 1000
GAMEPAD_MS = 1000
EXIT_CODES = {STOPPED: 3, HUMAN: 4, CONTINUES: None, REFUSED: 1}
LOST_SIGNAL = "transmitter's signal was lost"
H = Happening


@dataclass(frozen=True)
class FaultRow:
    """One fault, and what is expected of the car.

    message: a regular expression for the line that tells of the fault. exit_code: of the drive, None if it goes on;
    "usual": that of EXIT_CODES. at_ms, watch_ms: when it happens, and for how long the car is watched. until_limit:
    whether a car that `continues` is stopped by the plan's age. wiggled: whether a human made the gesture before. late:
    whether the drive is started 3.6 s later. human: the only one of car.yml's humans who has this fault; "": both.
    moved_us: the human's sticks, from rest, where `human` is expected.
    """

    name: str
    kind: str
    expected: str
    message: str
    happenings: tuple[Happening, ...]
    exit_code: int | str | None = "usual"
    at_ms: int = AT_MS
    watch_ms: int = WATCH_MS
    until_limit: bool = False
    wiggled: bool = True
    late: bool = False
    human: str = ""
    moved_us: Sequence[int] = (0, 0)

    def story(self, gamepad: bool = False) -> Story:
        """The fault, and after it another drive, which nothing happens to.

        gamepad: the human has one, which counts only while a link is open. So both drives begin later: by a policy that
        takes long for its first plan, while the human makes the gesture.
        """
        later_ms, wiggles_ms = (GAMEPAD_MS, AGAIN_MS + GAMEPAD_MS + 500) if gamepad else (0, WIGGLE_MS)
        happenings = [replace(h, at_ms=h.at_ms + later_ms * (h.at_ms > 2000)) for h in self.happenings]
        if self.expected != REFUSED:
            happenings.append(H(END_MS + later_ms, "the operator says stop"))
        happenings += [H(wiggles_ms, "the human wiggles the stick"), H(AGAIN_MS + later_ms, "the operator starts it")]
        if gamepad:
            happenings += [H(ms, "the policy is slow", 1800, 300) for ms in (1400, AGAIN_MS + later_ms - 100)]
            happenings += [H(2000, "the human wiggles the stick")] * self.wiggled
        longer_ms = STOP_MS + 2 * later_ms - 4800
        wiggled = self.wiggled and not gamepad
        return Story(tuple(happenings), wiggled, longer_ms=longer_ms, late=self.late, steady=True)


@functools.cache
def all_rows() -> dict[str, FaultRow]:
    """Read the faults of stories.yml, by their names."""
    rows = [FaultRow(happenings=told(row.pop("happens")), **row) for row in read_stories("rows")]
    return {row.name: row for row in rows}


def rows_of(car: Car) -> list[FaultRow]:
    """Return the rows that this car can have."""
    return [row for row in all_rows().values() if row.human in ("", car.human)]


def _told(what: str) -> Callable[[Happen], Happen]:
    def add(happen: Happen) -> Happen:
        TOLD[what] = happen
        return happen

    return add


# ---- what only these rows have


def _film(stage: Stage, h: Happening) -> None:
    stage.during(h, stage.world.lens, film=FILMS[h.what]())


def _jpegs() -> list[bytes]:
    return [cv2.imencode(".jpg", picture)[1].tobytes() for picture in scenery()]


def _bombs() -> list[bytes]:
    size = b"".join(n.to_bytes(2, "big") for n in scenery()[0].shape[:2])
    return [jpeg.replace(size, (16_000).to_bytes(2, "big") * 2, 1) for jpeg in _jpegs()]


def _flickering() -> list[np.ndarray]:
    shown = [np.full_like(scenery()[0], 128) for _ in range(40)]
    for i, picture in enumerate(shown):
        picture[50, 50] = 6 * i
    return shown


def _strips() -> list[np.ndarray]:
    return [np.vstack([scenery()[0][:-4], picture[-4:]]) for picture in scenery()]


def _grey() -> list[np.ndarray]:
    return list(np.random.default_rng(0).integers(120, 137, (40, *scenery()[0].shape), np.uint8))


FILMS: dict[str, Callable[[], Sequence[np.ndarray | bytes]]] = {
    "camera shows two old pictures": lambda: scenery()[:2],
    "pictures cut": lambda: [jpeg[: len(jpeg) * 2 // 3] + b"\xff\xd9" for jpeg in _jpegs()],
    "a picture that is a bomb": _bombs,
    "one pixel flickers": _flickering,
    "all but a strip is frozen": _strips,
    "camera sees grey": _grey,
    "camera changes its picture's size": lambda: [picture[::2, ::2] for picture in scenery()],
    "camera of another shape": lambda: [np.vstack([picture, picture[:24]]) for picture in scenery()],
}
TOLD |= dict.fromkeys(FILMS, _film)


@_told("rpicam-vid ends")
def _end_rpicam(stage: Stage, h: Happening) -> None:
    stage.running.eyes.unplug(CameraError("rpicam-vid has ended"))


@_told("the policy's process is killed")
def _kill_policy(stage: Stage, h: Happening) -> None:
    stage.running.planner._fail(PolicyError("the policy's process has ended (SIGKILL)"))


def _flipping(stage: Stage, share: float) -> Callable[[bytes], list[bytes]]:
    rng = stage.world.rng
    return lambda line: [bytes(b ^ (1 << rng.randrange(8)) if rng.random() < share else b for b in line)]


def _cutting(stage: Stage) -> Callable[[bytes], list[bytes]]:
    number = itertools.count(1)
    return lambda line: [line if next(number) % 3 else line[: len(line) // 2]]


def _by_lines(what: str, changing: Callable[[Stage], Callable[[bytes], list[bytes]]]) -> None:
    def change(stage: Stage, h: Happening) -> None:
        for wire in (stage.world.down, stage.world.up):
            stage.during(h, wire, change=changing(stage))

    TOLD[what] = change


def _other_firmware(line: bytes) -> list[bytes]:
    words = line.split(b"*")[0].decode(errors="replace").split(" ")
    return [frame(" ".join([*words[:2], "1.9.9", *words[3:]])) if words[0] == "<H" else line]


_by_lines("a bit of 30 % of the bytes", functools.partial(_flipping, share=0.3))
_by_lines("a bit of 1 % of the bytes", functools.partial(_flipping, share=0.01))
_by_lines("each third line", _cutting)
_by_lines("each line twice", lambda stage: lambda line: [line, line])
_by_lines("another firmware on the Arduino", lambda stage: _other_firmware)
_told("the Arduino's power is cut")(lambda stage, h: stage.world.reset("p"))
TOLD[f"the gamepad: {STUCK}"] = during("hand", pad=STUCK)


@_told("the host's clock is set")
def _set_clock(stage: Stage, h: Happening) -> None:
    stage.world.wall_step_s += h.amount


def _send_signals(stage: Stage, h: Happening) -> None:
    with stop_on_signals(stage.running.stopped, stage.running.log):
        for name in h.what.split(" and then "):
            signal.raise_signal(signal.Signals[name])


TOLD |= dict.fromkeys(("SIGTERM", "SIGINT", "SIGHUP", "SIGQUIT", "SIGTERM and then SIGINT"), _send_signals)


class _View:
    """A view's end of the feed, which reads nothing that the drive sends."""

    def __init__(self, place: str):
        self._listening = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._listening.bind(place)
        self._listening.listen()
        self._listening.setblocking(False)
        self._drive: socket.socket | None = None

    def send(self, *messages: bytes) -> None:
        with contextlib.suppress(OSError):  # the drive has not read the last, or has ended
            if not self._drive:
                self._drive, _ = self._listening.accept()
                self._drive.setblocking(False)
            for message in messages:
                self._drive.send(message)

    def close(self) -> None:
        self._listening.close()
        if self._drive:
            self._drive.close()


@_told("a view is open")
def _open_view(stage: Stage, h: Happening) -> None:
    stage.world.view = Path(stage.stack.enter_context(tempfile.TemporaryDirectory(prefix="rover-view-")), "view")
    stage.view = _View(str(stage.world.view))
    stage.stack.callback(stage.view.close)


_told("its page's button is pressed")(lambda stage, h: stage.view.send(b"stop 127.0.0.1"))
_told("the view is closed")(lambda stage, h: stage.view.close())


@_told("the view floods")
def _flood(stage: Stage, h: Happening) -> None:
    junk = b"start", b"stop", b"stop it", os.urandom(64), b"\0" * 4096
    stage.again_and_again(h, 1, lambda: stage.view.send(*junk))


def _open_damaged() -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "policy.pt")
        with zipfile.ZipFile(path, "w") as archive:
            for name in ("constants.pkl", "data.pkl", "extra/manifest.json", "extra/parity.npz"):
                archive.writestr(f"archive/{name}", bytes(range(256)))
            archive.writestr("archive/version", "3\n")
        path.write_bytes(path.read_bytes().replace(bytes(range(64)), bytes(64)))
        _read_manifest(path)


def _read_manifest(path: Path) -> None:
    with Artifact(path) as artifact:
        seen_size(artifact.manifest)


TOLD["no camera at the start"] = during("", opening=lambda: Camera("/dev/video-none").open())
TOLD["artifact damaged"] = during("", opening=_open_damaged)
TOLD["artifact gone"] = during("", opening=lambda: _read_manifest(Path("/nowhere/policy.pt")))


# ---- judging


def run_row(fault: FaultRow, car: Car = DEFAULT) -> dict[str, Any]:
    """Drive a fault's story with a car; return the row of metrics.faults."""
    gates = Gates.of_params(car)
    gamepad = car.human == "gamepad"
    later_ms = GAMEPAD_MS * gamepad
    seen = drive_story(fault.story(gamepad), car)
    human_us = car.numbers[2] + fault.moved_us[0], car.numbers[6] + fault.moved_us[1]
    refused = fault.expected == REFUSED
    at_ms, over_ms = (0, AGAIN_MS) if refused else (fault.at_ms + later_ms, END_MS + later_ms)
    watch_ms = 120 if gamepad and fault.expected == HUMAN else fault.watch_ms  # the drive ends, and with it his way
    watched = _observe(seen, car, at_ms, over_ms if refused else at_ms + watch_ms)
    verdict = judge(fault.expected, watched, gates, car, human_us=human_us, until_limit=fault.until_limit)
    code = next((_exit_code(error) for ms, error in seen.errors if ms < over_ms), None)
    wanted = EXIT_CODES[fault.expected] if fault.exit_code == "usual" else fault.exit_code
    if code != wanted:
        verdict.wrong.append(f"the drive ended with {code}, expected {wanted}")
    said = [text for ms, text in seen.log if ms >= at_ms] + [words for _, ms, words in seen.drives if words]
    message = fault.message + f"|{LOST_SIGNAL}" * (gamepad and fault.expected == STOPPED)  # its sticks stop, too
    line = next((text for text in said if re.search(message, text)), None) if message else "killed"
    if line is None:
        verdict.wrong.append(f"no line tells of it (wanted: {fault.message})")
    run = Run(seen)
    recovered = bool((run.autonomous & (run.throttle != car.numbers[6]))[AGAIN_MS:].any())
    if not recovered:
        verdict.wrong.append("the car was not driven again")
    if car == DEFAULT:  # the invariants' numbers are this car's
        verdict.wrong += broken(seen)
    method = ", ".join(dict.fromkeys(h.what for h in fault.happenings)) or "nothing happens"
    return row_of(fault, verdict, code, line, recovered, f"in virtual time: {method}")


def _observe(seen: Seen, car: Car, at_ms: int, end_ms: int) -> Observation:
    """Return what a pin's timer makes of the pins, as an emulated Arduino's events, from shortly before at_ms."""
    run = Run(seen)
    events = []
    for pin, period_us in (("steering", car.numbers[0]), ("throttle", car.numbers[4])):
        widths = getattr(run, pin)
        for at_us in range(max(0, at_ms - 400) * 1000, end_ms * 1000, period_us):
            if us := int(widths[at_us // 1000]):
                events.append(PinEvent(at_us / 1e6, "pulse", pin, float(us), float(period_us)))
    commands = [Command(c.at_ms / 1e3, c.steering_us, c.throttle_us) for c in seen.commands]
    return Observation(sorted(events, key=lambda e: e.end_s), commands, at_ms / 1e3, end_ms / 1e3)


def _exit_code(error: BaseException | None) -> int:
    """Return the exit code of `rover drive` for what ended it, as rover_lib/onboard/cli.py has it."""
    if error is None:
        return 0
    if isinstance(error, Killed):
        return -9
    if isinstance(error, RoverError) and not isinstance(error, DriveFault):
        return 0 if error.kind == "not armed" else 1
    return 4 if getattr(error, "kind", "") == "taken over" else 3

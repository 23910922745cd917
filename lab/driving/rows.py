"""The faults that docs/safety.md names: what happens to a car at speed, and what must become of it, in virtual time.

    row = run_row(ROWS["camera frozen"])        # as in results/lab/faults.json

To add a fault, add a row. Twelve of these names, and some that only a real process can have, are on the pins of an
emulated Arduino too (on_pins.py).
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
from lab.driving.pins import CONTINUES, HUMAN, REFUSED, STOPPED, Command, Gates, Observation, judge, row_of
from lab.driving.stories import LONGER_MS as NEVER_MS
from lab.driving.stories import TOLD, Happening, Stage, Story, drive_story, during
from lab.driving.virtual import GONE, SILENT, STUCK, Killed, Seen
from lab.driving.virtual_host import scenery
from rover_lib.onboard.artifact.manifest import Artifact, seen_size
from rover_lib.onboard.car.camera import Camera
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.servo_link import frame
from rover_lib.onboard.drive.service import NotArmed
from rover_lib.onboard.drive.watch import stop_on_signals
from rover_lib.onboard.errors import CameraError, DriveFault, PolicyError, RoverError, TakenOver

AT_MS = 3000  # of a fault, when the car has been at speed for a while
END_MS, WIGGLE_MS, AGAIN_MS, STOP_MS = 5200, 5600, 7000, 8400  # the drive's end, and then another without the fault
WATCH_MS = 1000
GAMEPAD_MS = 1000
EXIT_CODES = {STOPPED: 3, HUMAN: 4, CONTINUES: None, REFUSED: 1}
H = Happening


@dataclass(frozen=True)
class FaultRow:
    """One fault, and what is expected of the car.

    message: a regular expression for the line that tells of the fault. exit_code: of the drive, None if it goes on.
    at_ms, watch_ms: when it happens, and for how long the car is watched. until_limit: whether a car that `continues`
    is stopped by the plan's age. wiggled: whether a human made the gesture before. late: whether the drive is started
    3.6 s later. human: the only one of car.yml's humans who has this fault; "": both. moved_us: the human's sticks,
    from rest, where `human` is expected.
    """

    kind: str
    name: str
    expected: str
    message: str
    happenings: tuple[Happening, ...]
    exit_code: int | None
    at_ms: int = AT_MS
    watch_ms: int = WATCH_MS
    until_limit: bool = False
    wiggled: bool = True
    late: bool = False
    human: str = ""
    moved_us: tuple[int, int] = (0, 0)

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


ROWS: dict[str, FaultRow] = {}


def _row(kind: str, name: str, expected: str, message: str, *happenings: Happening, **more: Any) -> None:
    more.setdefault("exit_code", EXIT_CODES[expected])
    ROWS[name] = FaultRow(kind, name, expected, message, happenings, **more)


def _told(what: str) -> Callable[[Callable], Callable]:
    def add(happen: Callable[[Stage, Happening], object]) -> Callable:
        TOLD[what] = happen  # type: ignore[assignment]
        return happen

    return add


# ---- what only these rows have


def _film(what: str, make: Callable[[], Sequence[np.ndarray | bytes]]) -> str:
    made = functools.cache(make)
    TOLD[what] = lambda stage, h: stage.during(h, stage.world.lens, film=made())
    return what


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


_told("rpicam-vid ends")(
    lambda stage, h: stage.process and stage.process.eyes.unplug(CameraError("rpicam-vid has ended"))
)


@_told("the policy's process is killed")
def _kill_policy(stage: Stage, h: Happening) -> None:
    if stage.process:
        stage.process.planner._fail(PolicyError("the policy's process has ended (SIGKILL)"))


def _flipping(stage: Stage, share: float) -> Callable[[bytes], list[bytes]]:
    rng = stage.world.rng
    return lambda line: [bytes(b ^ (1 << rng.randrange(8)) if rng.random() < share else b for b in line)]


def _cutting(stage: Stage) -> Callable[[bytes], list[bytes]]:
    number = itertools.count(1)
    return lambda line: [line if next(number) % 3 else line[: len(line) // 2]]


def _by_lines(what: str, changing: Callable[[Stage], Callable[[bytes], list[bytes]]], *wires: str) -> str:
    def change(stage: Stage, h: Happening) -> None:
        for wire in wires or ("down", "up"):
            stage.during(h, getattr(stage.world, wire), change=changing(stage))

    TOLD[what] = change
    return what


def _other_firmware(line: bytes) -> list[bytes]:
    words = line.split(b"*")[0].decode(errors="replace").split(" ")
    return [frame(" ".join([*words[:2], "1.9.9", *words[3:]])) if words[0] == "<H" else line]


_told("the Arduino's power is cut")(lambda stage, h: stage.world.reset("p"))
for _fault in (GONE, SILENT, STUCK):
    TOLD[f"the gamepad: {_fault}"] = during("hand", pad=_fault)


@_told("the host's clock is set")
def _set_clock(stage: Stage, h: Happening) -> None:
    stage.world.wall_step_s += h.amount


def _by_signals(name: str, *numbers: int) -> None:
    @_told(name)
    def send(stage: Stage, h: Happening) -> None:
        if process := stage.process:
            with stop_on_signals(process.until.stop, process.log):  # type: ignore[arg-type]
                for number in numbers:
                    signal.raise_signal(number)

    message = f"{signal.Signals(numbers[0]).name}: stopping"
    _row("operator", name, STOPPED, message, H(AT_MS, name), exit_code=0)


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


def _opening(what: str, opening: Callable[[], object]) -> str:
    TOLD[what] = lambda stage, h: stage.during(h, stage.world, opening=opening)
    return what


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


# ---- the camera

_perceived = functools.partial(_row, "perception")
_FILM = functools.partial(H, AT_MS, for_ms=WATCH_MS)
_GONE = functools.partial(H, 0, for_ms=4800)  # since before the drive
_BLANK = "picture is black|nothing is on the camera"

_perceived("camera unplugged", STOPPED, "is the camera unplugged", H(AT_MS, "the camera is unplugged"))
_perceived("camera frozen", STOPPED, "the camera is frozen", _FILM("the camera freezes"))
_perceived("camera frozen before the drive", REFUSED, "the camera is frozen", _GONE("the camera freezes"))
for _name, _message, _make in (
    ("camera shows two old pictures", "the camera is frozen", lambda: scenery()[:2]),
    (
        "pictures cut",
        "were no frames: a JPEG is damaged",
        lambda: [j[: len(j) * 2 // 3] + b"\xff\xd9" for j in _jpegs()],
    ),
    ("a picture that is a bomb", "were no frames: a JPEG would take too much", _bombs),
    ("one pixel flickers", "the camera is frozen", _flickering),
    ("all but a strip is frozen", "the camera is frozen", _strips),
    ("camera sees grey", "nothing is on the camera's picture", _grey),
    ("camera changes its picture's size", "the picture changed from", lambda: [p[::2, ::2] for p in scenery()]),
):
    _perceived(_name, STOPPED, _message, _FILM(_film(_name, _make)))
_perceived("camera black", STOPPED, _BLANK, _FILM("the camera is black"))
_perceived("camera black at the start", REFUSED, _BLANK, _GONE("the camera is black"))
_tall = _film("camera of another shape", lambda: [np.vstack([p, p[:24]]) for p in scenery()])
_perceived(_tall, REFUSED, "they would be squeezed", _GONE(_tall))
_none = _opening("no camera at the start", lambda: Camera("/dev/video-none").open())
_perceived(_none, REFUSED, "no such camera", _GONE(_none))
_late = H(AT_MS, "the camera gives no more frames", for_ms=300), H(AT_MS + 300, "frames come late", 120, 1200)
_perceived("frames late", CONTINUES, "no new frame", *_late, watch_ms=1800)
_perceived("rpicam-vid killed", STOPPED, "rpicam-vid has ended", H(AT_MS, "rpicam-vid ends"))
for _name in ("camera gives no more frames", "rpicam-vid stopped"):
    _silent = H(AT_MS, "the camera gives no more frames", for_ms=2000)
    _perceived(_name, CONTINUES, "no new frame came", _silent, watch_ms=2000, until_limit=True, exit_code=3)

# ---- the policy

_planned = functools.partial(_row, "policy")
for _name, _does, _message in (
    ("inference raises", "raise", "told to fail"),
    ("inference returns NaN", "nan", "NaN or Inf|not finite"),
    ("inference returns out of range", "wild", "outside the range"),
):
    _planned(_name, STOPPED, _message, H(AT_MS, f"the policy's answer: {_does}", for_ms=300))
    if _does != "wild":
        _planned(f"{_name} at the start", REFUSED, _message, _GONE(f"the policy's answer: {_does}"))
_planned("inference process killed", STOPPED, r"has ended \(SIGKILL\)", H(AT_MS, "the policy's process is killed"))
_planned("inference hangs for 300 ms", CONTINUES, "the policy took", H(AT_MS, "the policy is slow", 420, 100))
for _name in ("inference hangs", "inference process stopped"):
    _hung = H(AT_MS, "the policy is slow", NEVER_MS, 1000)
    _planned(_name, CONTINUES, "policy has not answered", _hung, watch_ms=2000, until_limit=True, exit_code=3)
_damaged = _opening("artifact damaged", _open_damaged)
_planned(_damaged, REFUSED, "copy the file again", _GONE(_damaged))
_absent = _opening("artifact gone", lambda: _read_manifest(Path("/nowhere/policy.pt")))
_planned(_absent, REFUSED, "not found", _GONE(_absent))

# ---- the link

_carried = functools.partial(_row, "link")
BEHIND = "has not answered for|the link is behind|no valid command for 150 ms"
_carried("serial unplugged", STOPPED, "is it still plugged in", _FILM("the cable is unplugged"))
_carried("serial stuck", STOPPED, "took no data", _FILM("the port is stuck"))
_carried("serial silent from the host", STOPPED, BEHIND, _FILM("to the Arduino: lost_pct", 100))
_carried("serial silent to the host", STOPPED, BEHIND, _FILM("from the Arduino: lost_pct", 100))
# A link that falls behind is judged from when it is 150 ms late, which takes 0.6 s.
_carried(
    "link falls behind",
    STOPPED,
    BEHIND,
    H(2450, "to the Arduino: further and further behind", 25, 1600),
    human="receiver",
)
_carried("answers fall behind", STOPPED, BEHIND, H(2750, "from the Arduino: further and further behind", 50, 1500))
_noise = _by_lines("a bit of 30 % of the bytes", functools.partial(_flipping, share=0.3))
_carried("noise on the line", STOPPED, BEHIND, _FILM(_noise))
_bits = _by_lines("a bit of 1 % of the bytes", functools.partial(_flipping, share=0.01))


def _spoilt(name: str, *happenings: Happening, human: str = "") -> None:
    _carried(name, CONTINUES, "the link", *happenings, watch_ms=2000, human=human)


_LONG = functools.partial(H, AT_MS, for_ms=2000)
# A gamepad's sticks go the same way, and are lost when 150 ms of them are.
_spoilt("bit flips at 1 % of bytes", _LONG(_bits), human="receiver")
_dropped = [_LONG(f"{which} the Arduino: lost_pct", 30) for which in ("to", "from")]
_spoilt("lines dropped at 30 %", *_dropped, human="receiver")
_spoilt("line cut in half", _LONG(_by_lines("each third line", _cutting)), human="receiver")
_spoilt("each line twice", _LONG(_by_lines("each line twice", lambda stage: lambda line: [line, line])))
_spoilt("old line replayed", H(AT_MS, "old lines come again", 50, 1000))
_foreign = [H(AT_MS + 300 * i, "another program writes to the port", i, 400) for i in range(5)]
_spoilt("another program writes to the port", *_foreign)
_carried("no Arduino at the start", REFUSED, "cannot be opened", _GONE("the cable is unplugged"))
_other = _by_lines("another firmware on the Arduino", lambda stage: _other_firmware, "up")
_carried(_other, REFUSED, "make flash|make -C firmware flash", _GONE(_other))

# ---- the Arduino itself

for _name, _what in (
    ("Arduino reset", "the Arduino is reset"),
    ("Arduino's power cut", "the Arduino's power is cut"),
    ("Arduino loop hung", "the Arduino's loop hangs"),
):
    _row(
        "firmware", _name, STOPPED, f"was reset|{BEHIND}", H(AT_MS, _what)
    )  # which first: how long its boot loader runs

# ---- the human, with transmitter and receiver or with a gamepad

_received = functools.partial(_row, "receiver")
LOST_SIGNAL, NO_GESTURE = "transmitter's signal was lost", "nobody has just wiggled"
_received("receiver lost", STOPPED, LOST_SIGNAL, _FILM("the transmitter is off"))
for _wire in ("throttle", "steering"):
    _off = _FILM(f"the receiver's {_wire} wire is off")
    _received(f"receiver's {_wire} channel lost", STOPPED, LOST_SIGNAL, _off, human="receiver")
_presets = H(AT_MS, "the receiver sends presets", 400, 1500)
_received("receiver comes back with presets", STOPPED, LOST_SIGNAL, _presets, human="receiver")
_presets = H(0, "the receiver sends presets", 400, 4800)
_received("receiver begins with presets", REFUSED, "is not at rest", _presets, wiggled=False, human="receiver")
_received("no transmitter at the start", REFUSED, "gives no signal", _GONE("the transmitter is off"))
_received("nobody wiggles the stick", REFUSED, NO_GESTURE, wiggled=False)
_slow = H(100, "the human steers to both sides, seconds apart", 3400)
_received("a gesture that takes too long", REFUSED, NO_GESTURE, _slow, wiggled=False, late=True, human="receiver")
_held = [
    H(ms, "the human steers", us, for_ms) for ms, us, for_ms in ((100, 290, 190), (300, -290, 190), (500, 290, 4300))
]
_received("a gesture whose stick is held at a side", REFUSED, NO_GESTURE, *_held, wiggled=False, human="receiver")
_steers = _FILM("the human steers", 144)
_received("human takes over by steering", HUMAN, "the human took over", _steers, moved_us=(144, 0), watch_ms=900)
# The human's throttle passes only after it has been at rest, as a receiver without its transmitter looks the same.
_received("human takes over by throttle", HUMAN, "the human took over", _FILM("the human pulls the throttle", 220))
for _name, _fault in (("pulled out", GONE), ("out of reach", SILENT)):
    _received(f"gamepad {_name}", STOPPED, LOST_SIGNAL, _FILM(f"the gamepad: {_fault}"), human="gamepad")
_stuck = _GONE(f"the gamepad: {STUCK}")
_received("gamepad whose L1 is stuck", REFUSED, "gives no signal", _stuck, wiggled=False, human="gamepad")

# ---- the process that drives, and its machine

_hosted = functools.partial(_row, "host")
_hosted("exception in the loop", STOPPED, "raised in the loop", H(AT_MS, "an exception in the loop"))
_stopped = H(AT_MS, "the process is stopped", for_ms=1000)
_hosted("host process stopped", STOPPED, "no valid command for 150 ms|said nothing for", _stopped, watch_ms=1300)
_stutter = H(AT_MS, "the process stutters", 110, 1200)
_paused = "paused again and again|had no time for its ticks"
_hosted("host process stopped again and again", STOPPED, _paused, _stutter, watch_ms=1500)
_short = H(AT_MS, "the process is stopped", for_ms=100)
_hosted("host process stopped for 100 ms", CONTINUES, "missed [23] ticks", _short, human="receiver")
for _hours in (1, -1):
    _set = H(AT_MS, "the host's clock is set", 3600 * _hours)
    _said = re.escape(f"clock was set by {3600 * _hours:+d} s")
    _hosted(f"clock stepped by {_hours:+d} h", CONTINUES, _said, _set, watch_ms=1600)

# ---- the operator, and the view

for _number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT):
    _by_signals(_number.name, _number)
_by_signals("SIGTERM and then SIGINT", signal.SIGTERM, signal.SIGINT)
for _name in ("SIGKILL", "SIGUSR1"):  # its next start tells of it, which an emulated Arduino's row shows
    _row("operator", _name, STOPPED, "", H(AT_MS, "the process is killed"), exit_code=-9)

_viewed = functools.partial(_row, "view")
_open = H(0, "a view is open")
_button = H(AT_MS, "its page's button is pressed")
_viewed("stopped from a page", STOPPED, r"stopped from the view \(127", _open, _button, exit_code=0)
_viewed("view killed", CONTINUES, "the view is gone", _open, H(AT_MS, "the view is closed"))
_viewed("view hangs", CONTINUES, "the view is gone", _open, H(AT_MS + 900, "the view is closed"))
_flooded = H(AT_MS, "the view floods", for_ms=800), H(AT_MS + 900, "the view is closed")
_viewed("view flooded", CONTINUES, "the view is gone", _open, *_flooded)


# ---- judging


def rows_of(car: Car) -> list[FaultRow]:
    """Return the rows that this car can have."""
    return [row for row in ROWS.values() if row.human in ("", car.human)]


def run_row(fault: FaultRow, car: Car | None = None) -> dict[str, Any]:
    """Drive a fault's story with a car, the default one if None; return the row of metrics.faults."""
    car = car or Car()
    gates = Gates.of_params(car)
    gamepad = car.human == "gamepad"
    later_ms = GAMEPAD_MS * gamepad
    seen = drive_story(fault.story(gamepad), car)
    human_us = tuple(neutral + us for neutral, us in zip((car.numbers[2], car.numbers[6]), fault.moved_us, strict=True))
    refused = fault.expected == REFUSED
    at_ms, over_ms = (0, AGAIN_MS) if refused else (fault.at_ms + later_ms, END_MS + later_ms)
    watch_ms = 120 if gamepad and fault.expected == HUMAN else fault.watch_ms  # the drive ends, and with it his way
    watched = _observe(seen, car, at_ms, over_ms if refused else at_ms + watch_ms)
    verdict = judge(fault.expected, watched, gates, human_us=human_us, until_limit=fault.until_limit, car=car)
    code = next((_exit_code(error) for ms, error in seen.errors if ms < over_ms), None)
    if code != fault.exit_code:
        verdict.wrong.append(f"the drive ended with {code}, expected {fault.exit_code}")
    said = [text for ms, text in seen.log if ms >= at_ms] + [words for _, ms, words in seen.drives if words]
    message = fault.message + f"|{LOST_SIGNAL}" * (gamepad and fault.expected == STOPPED)  # its sticks stop, too
    line = next((text for text in said if re.search(message, text)), None) if message else "killed"
    if line is None:
        verdict.wrong.append(f"no line tells of it (wanted: {fault.message})")
    run = Run(seen)
    recovered = bool((run.autonomous & (run.throttle != car.numbers[6]))[AGAIN_MS:].any())
    if not recovered:
        verdict.wrong.append("the car was not driven again")
    if car == Car():  # the invariants' numbers are this car's
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
    for kind, code in ((Killed, -9), (NotArmed, 0), (DriveFault, 3), (TakenOver, 4), (RoverError, 1)):
        if isinstance(error, kind):
            return code
    return 3

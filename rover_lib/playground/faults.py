"""Faults while the car drives at speed, judged by the pulses on its servo pins: `rover faults runs/faults.json`.

Everything is what drives the real car: `rover drive` as a process, pyserial, and the real firmware, in simavr and in
real time. Three things stand in for hardware. The camera is a FIFO of JPEGs, read by the same Camera class as a V4L2
device (which needs a kernel with v4l2loopback to be emulated). The cable is a pair of ptys with this program between
them, so that it can be cut, stuck and garbled. The transmitter's pulses are simavr's.

The policy is a small artifact that does what the corner of the picture tells it to: raise, hang, give NaN. So what
happens inside an inference comes in by the camera, and there is no hook for tests in what drives. Only what cannot
come from outside (an exception in the logger, the death of a thread) is done by this module inside the process of the
drive, on SIGUSR2, before `rover_lib.cli.main` is called.

A row's `expected` is `stopped` (neutral, until an explicit new start), `human` (the transmitter's pulses) or
`continues` (only what drive commanded, on time). All times are of the monotonic clock that simavr's pins, the cable
and this program share.
"""

import contextlib
import ctypes
import gc
import mmap
import os
import platform
import pty
import random
import re
import resource
import select
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import termios
import threading
import time
import tty
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from rover_lib.onboard.artifact import SCHEMA, save_artifact
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.params import params
from rover_lib.onboard.pwm import ARDUINO_STEP_US
from rover_lib.onboard.servo_link import frame
from rover_lib.onboard.stage import write_stage
from rover_lib.onboard.telemetry import LogError, read_log
from rover_lib.onboard.watch import SWITCH_S, schedule
from rover_lib.playground.arduino import CC, REPOSITORY, REST_US, Arduino, PinEvent, build, call
from rover_lib.playground.car import EMULATOR_NICE, CameraFeed

STOPPED, HUMAN, CONTINUES = "stopped", "human", "continues"
NEUTRAL_US = {"steering": 1456, "throttle": 120}
PERIOD_US = {"steering": 21316, "throttle": 1016}
TICK_US = {"steering": 0.5, "throttle": 4.0}  # of the pin's timer: all that its hardware can do
EDGE_US = 0.5  # an edge in simavr is known to 0.25 us
STEP_US = ARDUINO_STEP_US + EDGE_US  # of a pulse that the Arduino measured and made again
COMMAND_US = {"steering": 1.0, "throttle": 2.5}  # half a step of its timer, and an edge
STILL_VALID_S = 0.2  # the Arduino holds a command for 150 ms, and a steering pulse begins 21 ms later
BEFORE_S = 0.2  # so long it must have been driving before a fault
LAST_S = 0.2  # so much of the end must have pulses
AT_SPEED_S = 0.6  # from the first throttle to the fault
START_S = 30.0
END_S = 6.0
TRIES = 3  # of a row during which this machine had no time for the Arduino
SIZE = (160, 320)  # height and width of the camera's pictures
CHUNK, RATE_HZ = 32, 30.0
PLAN, OTHER_PLAN = (0.2, 0.15), (-0.3, 0.08)  # steering, throttle
DISK_BYTES = 512 * 1024
FUZZ_LINES = 1_000_000
PRIORITY = 3  # of real time, before rover drive: a real Arduino and a real cable do not wait for this machine

# What the picture's corner tells the policy: its red, green and blue are on or off.
PLAIN, RAISE, HANG, NAN, BEYOND, SLOW, OTHER = range(7)


class FaultError(RoverError):
    """A fault that cannot be injected or judged here."""


# ---- judging


@dataclass(frozen=True)
class Gates:
    """Of params.yml's section `faults`."""

    stopped_ms: float
    throttle_max_us: float
    takeover_ms: float
    rows: int
    stopped_rows: int
    bytes_us: float

    @classmethod
    def of_params(cls) -> "Gates":
        """Those of params.yml."""
        return cls(**params()["faults"])

    @property
    def stopped_s(self) -> float:
        return self.stopped_ms / 1e3


class Command(NamedTuple):
    """A drive's line that went into the cable, and when."""

    at_s: float
    steering_us: int
    throttle_us: int


@dataclass(frozen=True)
class Seen:
    """What a fault is judged by. events: of the pins, in order; commands: of the drive; from before at_s to end_s."""

    events: Sequence[PinEvent]
    commands: Sequence[Command]
    at_s: float
    end_s: float

    def pulses(self, pin: str, from_s: float | None = None, to_s: float | None = None) -> list[PinEvent]:
        """Of a pin, those that ended in a span of time [default: from the fault on]."""
        from_s = self.at_s if from_s is None else from_s
        to_s = self.end_s if to_s is None else to_s
        return [e for e in self.events if e.pin == pin and e.kind in ("pulse", "cut") and from_s < e.end_s <= to_s]

    def stalled_ms(self) -> float:
        """So long this machine had no time for the Arduino, or for who read its pins."""
        spoilt = [e for e in self.events if e.kind in ("stall", "lost") and self.at_s - BEFORE_S < e.monotonic_s]
        return sum(e.pulse_us / 1e3 if e.kind == "stall" else 1e9 for e in spoilt)


@dataclass
class Verdict:
    """figures: for the row. wrong: a sentence for each way in which it is not as expected."""

    figures: dict[str, Any]
    wrong: list[str]


def judge(
    expected: str, seen: Seen, gates: Gates, *, human_us: tuple[float, float] = REST_US, until_limit: bool = False
) -> Verdict:
    """What the pins did from the fault on, against what was expected.

    human_us: the transmitter's pulses. until_limit: of `continues`: a limit stops the car in the end.
    """
    throttle, steering = seen.pulses("throttle"), seen.pulses("steering")
    moving = [e.end_s for e in throttle if e.pulse_us > gates.throttle_max_us]
    late = [e.pulse_us for e in throttle if e.end_s > seen.at_s + gates.stopped_s]
    figures: dict[str, Any] = {
        "stopped_after_ms": round((max(moving) - seen.at_s) * 1e3, 1) if moving else 0.0,
        "max_throttle_us_after": round(max(late), 1) if late else None,
        "steering_us_after": round(steering[-1].pulse_us, 1) if steering else None,
    }
    wrong = []
    before = seen.pulses("throttle", seen.at_s - BEFORE_S, seen.at_s)
    if not before or min(e.pulse_us for e in before) <= gates.throttle_max_us:
        wrong.append(f"the car was not driving in the {BEFORE_S * 1e3:g} ms before the fault")
    for pin, period_us in PERIOD_US.items():
        found, wanted = len(seen.pulses(pin, seen.end_s - LAST_S)), LAST_S * 1e6 / period_us
        if found < wanted - 2:
            wrong.append(f"{found} {pin} pulses in the last {LAST_S * 1e3:g} ms, {wanted:.0f} are its rate")
    if expected == STOPPED:
        wrong += _not_stopped(seen, gates, figures, human_us)
    elif expected == HUMAN:
        wrong += _not_human(seen, gates, figures, human_us)
    else:
        wrong += _not_continued(seen, gates, figures, until_limit)
    return Verdict(figures, wrong)


def _not_stopped(seen: Seen, gates: Gates, figures: dict[str, Any], rest_us: tuple[float, float]) -> Iterator[str]:
    if figures["stopped_after_ms"] > gates.stopped_ms:
        yield f"throttle off {figures['stopped_after_ms']:g} ms after the fault, {gates.stopped_ms:g} are allowed"
    if (figures["max_throttle_us_after"] or 0) > gates.throttle_max_us:
        yield f"throttle at {figures['max_throttle_us_after']:g} us after it had to be off"
    # A reset leaves the Arduino in manual: then it is the resting stick's, as measured.
    since_s = seen.at_s + gates.stopped_s + PERIOD_US["steering"] * 1e-6
    widths = [e.pulse_us for e in seen.pulses("steering", since_s)]
    if off := [us for us in widths if min(abs(us - NEUTRAL_US["steering"]), abs(us - rest_us[0])) > STEP_US]:
        yield f"steering at {off[-1]:g} us, neutral is {NEUTRAL_US['steering']}"


def _not_human(seen: Seen, gates: Gates, figures: dict[str, Any], human_us: tuple[float, float]) -> Iterator[str]:
    took_ms = 0.0
    for pin, wanted_us in zip(PERIOD_US, human_us, strict=True):
        found = seen.pulses(pin)
        ours = [i for i, e in enumerate(found) if abs(e.pulse_us - wanted_us) > STEP_US]
        first = ours[-1] + 1 if ours else 0
        if first >= len(found):
            figures["takeover_ms"] = None
            yield f"{pin} was never the human's"
            return
        took_ms = max(took_ms, (found[first].end_s - seen.at_s) * 1e3)
    figures |= {"stopped_after_ms": None, "takeover_ms": round(took_ms, 1)}
    if took_ms > gates.takeover_ms:
        yield f"the human's pulses after {took_ms:.1f} ms, {gates.takeover_ms:g} are allowed"


def _not_continued(seen: Seen, gates: Gates, figures: dict[str, Any], until_limit: bool) -> Iterator[str]:
    if until_limit:
        yield from _not_limited(seen, gates, figures)
    stopped_s = seen.at_s + figures["stopped_after_ms"] / 1e3 + 1e-4 if until_limit else seen.end_s
    if not until_limit:
        figures["stopped_after_ms"] = None
    for pin, period_us in PERIOD_US.items():
        index = 1 if pin == "steering" else 2
        for e in seen.pulses(pin):
            recent = [c[index] for c in seen.commands if e.monotonic_s - STILL_VALID_S < c.at_s <= e.monotonic_s]
            if e.kind == "cut" or abs(e.period_us - period_us) > EDGE_US:
                yield f"a {pin} pulse out of time: {e.period_us:g} us after the one before, {period_us} is its period"
                return
            neutral = until_limit and e.end_s > stopped_s and abs(e.pulse_us - NEUTRAL_US[pin]) <= COMMAND_US[pin]
            if not neutral and min((abs(e.pulse_us - us) for us in recent), default=1e9) > COMMAND_US[pin]:
                yield f"{pin} at {e.pulse_us:g} us {(e.monotonic_s - seen.at_s) * 1e3:.0f} ms after the fault, which "\
                      f"was not commanded ({sorted(set(recent))})"  # fmt: skip
                return
    if not until_limit and min((e.pulse_us for e in seen.pulses("throttle")), default=0) <= gates.throttle_max_us:
        yield "the throttle went off"


def _not_limited(seen: Seen, gates: Gates, figures: dict[str, Any]) -> Iterator[str]:
    """Fading from params' fade_s on, off at its stop_s: ages of a plan, which is younger when the fault comes."""
    limits, throttle = params()["drive"], seen.pulses("throttle")
    fading = [e.end_s for e in throttle if e.pulse_us < throttle[0].pulse_us - 2 * ARDUINO_STEP_US]
    figures["fades_after_ms"] = round((fading[0] - seen.at_s) * 1e3, 1) if fading else None
    most_ms = limits["stop_s"] * 1e3 + gates.stopped_ms
    if not fading or abs(fading[0] - seen.at_s - limits["fade_s"]) > 0.15:
        yield f"the throttle fades after {figures['fades_after_ms']} ms, the limit is {limits['fade_s']:g} s"
    if not figures["fades_after_ms"] or not figures["fades_after_ms"] < figures["stopped_after_ms"] <= most_ms:
        yield f"throttle off after {figures['stopped_after_ms']:g} ms, {most_ms:g} are allowed"
    if throttle and throttle[-1].pulse_us > gates.throttle_max_us:
        yield "the car was never stopped"


# ---- the policy, and what tells it what to do


def make_artifact(path: Path) -> None:
    """An artifact with constant plans that obeys the corner of the picture, see PLAIN to OTHER."""
    import torch

    class Obedient(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.register_buffer("plan", torch.tensor([PLAN] * CHUNK)[None])
            self.register_buffer("other", torch.tensor([OTHER_PLAN] * CHUNK)[None])

        def forward(self, state, frame):
            corner = frame[4:12, 4:12].float().mean(dim=(0, 1)) > 127.0
            told = int(corner[0]) * 4 + int(corner[1]) * 2 + int(corner[2])
            plan = self.plan.clone()
            if told == 1:
                raise RuntimeError("told to fail by the picture")
            if told == 2 or told == 5:
                work_ns = 300000000 if told == 5 else 1 << 62
                start, rounds = torch.ops.prim.TimePoint(), 0
                while torch.ops.prim.TimePoint() - start < work_ns:
                    rounds += 1
                plan = plan + 0 * rounds
            if told == 3:
                plan = plan * float("nan")
            if told == 4:
                plan = plan * 0 + 5.0
            if told == 6:
                plan = self.other.clone()
            return plan

    height, width = 48, 96
    module = torch.jit.script(Obedient().eval())
    names = ["steering", "throttle"]
    manifest = {
        "schema": SCHEMA,
        "mode": "fp32",
        "scheme": "float",
        "engine": torch.backends.quantized.engine,
        "cameras": [{"name": "front", "height": height, "width": width}],
        "state_names": names,
        "action_names": names,
        "chunk": CHUNK,
        "rate_hz": RATE_HZ,
        "normalisation": "none",
        "checkpoint": {"sha256": "", "format": "made by rover faults"},
        "calibration": None,
        "weights_mb": 0.0,
        "gmac": 0.0,
        "parity": {"tolerance": dict.fromkeys(names, 1e-6), "reason": "constant"},
        "versions": {"torch": torch.__version__, "rover_lib": ""},
    }
    frames = np.zeros((1, height, width, 3), np.uint8)
    parity = {
        "state": np.zeros((1, 2), np.float32),
        "frame_front": frames,
        "chunk": np.full((1, CHUNK, 2), PLAN, np.float32),
    }
    save_artifact(path, module, manifest, parity)


def pictures(told: int, size: tuple[int, int] = SIZE, level: int = 100, count: int = 16) -> list[bytes]:
    """JPEGs with a sensor's noise, no two the same, whose corner tells the policy what to do. level: their grey."""
    rng = np.random.default_rng(told)
    height, width = size
    made = []
    for _ in range(count):
        picture = rng.integers(level, level + 12, (height, width, 3), np.uint8)
        on = [bool(told & bit) for bit in (1, 2, 4)]  # blue, green, red
        if level:
            picture[: height // 3, : width // 3] = np.where(on, 225, 25)
            picture[: height // 3, : width // 3] += rng.integers(0, 12, (height // 3, width // 3, 3), np.uint8)
        made.append(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes())
    return made


# ---- the cable

Change = Callable[[bytes], bytes]


def by_line(change: Change) -> Change:
    """A change of whole lines, as one of a stream."""
    pending = b""

    def pass_on(data: bytes) -> bytes:
        nonlocal pending
        *lines, pending = (pending + data).split(b"\n")
        return b"".join(change(line + b"\n") for line in lines)

    return pass_on


def flipping(rng: random.Random, share: float) -> Change:
    """Flips a bit of that share of the bytes."""
    return lambda data: bytes(b ^ (1 << rng.randrange(8)) if rng.random() < share else b for b in data)


def dropping(rng: random.Random, share: float) -> Change:
    """Drops that share of the lines."""
    return by_line(lambda line: b"" if rng.random() < share else line)


_DRIVE = re.compile(rb">D \d+ \d+ (\d+) (\d+)\*[0-9A-F]{8}")


class Cable:
    """A serial cable with this program in it. port: the host's end; opening it resets the Arduino, as DTR does.

    to_arduino, to_host: may be set; change what passes. commands: the drives that the host wrote, before any change.
    lines: its lines. not_ours: what others write to the port, and is no command of the drive.
    """

    def __init__(self, arduino_port: str):
        self._arduino_port = arduino_port
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        self.port = os.ttyname(slave)
        os.close(slave)  # so that POLLHUP tells whether somebody has the port open
        os.set_blocking(self._master, False)
        self.to_arduino: Change | None = None
        self.to_host: Change | None = None
        self.commands: list[Command] = []
        self.lines: list[bytes] = []
        self.not_ours: set[bytes] = set()
        self._injected: deque[bytes] = deque()
        self._pending = b""
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="cable", daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        """Both ends come to nothing."""
        self._closing.set()
        self._thread.join()

    def stick(self) -> None:
        """The port takes no more bytes: who writes waits."""
        port = os.open(self.port, os.O_RDWR | os.O_NOCTTY)
        termios.tcflow(port, termios.TCOOFF)
        os.close(port)

    def inject(self, data: bytes) -> None:
        """Bytes for the Arduino, as if the host had sent them."""
        self._injected.append(data)

    def _run(self) -> None:
        _go_first(threading.get_native_id())
        poller, arduino = select.poll(), -1
        poller.register(self._master, select.POLLIN)
        while not self._closing.is_set():
            said = dict(poller.poll(20))
            if said.get(self._master, 0) & select.POLLHUP:  # nobody has it open
                if arduino >= 0:
                    poller.unregister(arduino)
                    os.close(arduino)
                    arduino = -1
                self._closing.wait(0.005)
                continue
            if arduino < 0:
                arduino = os.open(self._arduino_port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
                poller.register(arduino, select.POLLIN)
                self._pending = b""
            if data := _read(self._master):
                self._note(data)
                _write(arduino, self.to_arduino(data) if self.to_arduino else data)
            while self._injected:
                _write(arduino, self._injected.popleft())
            if data := _read(arduino):
                _write(self._master, self.to_host(data) if self.to_host else data)
        for fd in (self._master, arduino):
            if fd >= 0:
                os.close(fd)

    def _note(self, data: bytes) -> None:
        now = time.monotonic()
        *lines, self._pending = (self._pending + data).split(b"\n")
        for line in lines:
            line = line[max(0, line.rfind(b">")) :]
            if line in self.not_ours:
                continue
            self.lines.append(line + b"\n")
            if (found := _DRIVE.fullmatch(line)) and frame(line.split(b"*")[0].decode()) == line + b"\n":
                self.commands.append(Command(now, int(found[1]), int(found[2])))


@contextlib.contextmanager
def _going_first() -> Iterator[None]:
    """This program's other threads too: the cable waits for whoever holds the interpreter."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    gc.collect()
    gc.freeze()  # in a large program, as pytest's, looking through all would keep the cable waiting
    with contextlib.suppress(OSError):
        schedule(os.SCHED_RR | os.SCHED_RESET_ON_FORK, PRIORITY)
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            schedule(os.SCHED_OTHER, 0)
        gc.unfreeze()
        sys.setswitchinterval(before)


def _go_first(pid: int) -> None:
    with contextlib.suppress(OSError):  # this user may not: then rows are repeated now and then
        os.sched_setscheduler(pid, os.SCHED_RR, os.sched_param(PRIORITY))


def _read(fd: int) -> bytes:
    with contextlib.suppress(OSError):  # nothing there, or the other end is gone
        return os.read(fd, 4096)
    return b""


def _write(fd: int, data: bytes) -> None:
    with contextlib.suppress(OSError):  # what nobody takes is lost, as on a wire
        os.write(fd, data)


# ---- inside the process of a drive


def _end_this_thread() -> None:
    ctypes.CDLL(None).syscall({"x86_64": 60, "aarch64": 93}[platform.machine()], 0)  # exit, of the thread alone


def _raise() -> None:
    raise RuntimeError("raised in the loop")


def _break_logger() -> None:
    from rover_lib.onboard import telemetry

    def broken(*_: Any) -> bytes:
        raise RuntimeError("raised in the logger")

    telemetry._sealed = telemetry._tick_line = broken


INSIDE = {"end the loop's thread": _end_this_thread, "raise in the loop": _raise, "raise in the logger": _break_logger}


def on_signal(what: str) -> None:
    """From now on SIGUSR2 does one of INSIDE, in the main thread, which is the loop's."""
    signal.signal(signal.SIGUSR2, lambda *_: INSIDE[what]())


# What stepping the system's clock does to a program, without stepping it for all the others.
CLOCK = """
#define _GNU_SOURCE
#include <fcntl.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>
static const volatile long long *step_s;
__attribute__((constructor)) static void load(void) {
    step_s = mmap(0, sizeof *step_s, PROT_READ, MAP_SHARED, open(getenv("CLOCK_STEP"), O_RDONLY), 0);
}
int clock_gettime(clockid_t id, struct timespec *t) {
    int failed = (int)syscall(SYS_clock_gettime, id, t);
    if (id == CLOCK_REALTIME || id == CLOCK_REALTIME_COARSE) t->tv_sec += *step_s;
    return failed;
}
int gettimeofday(struct timeval *t, void *zone) {
    struct timespec now;
    (void)zone;
    clock_gettime(CLOCK_REALTIME, &now);
    t->tv_sec = now.tv_sec;
    t->tv_usec = now.tv_nsec / 1000;
    return 0;
}
time_t time(time_t *t) {
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (t) *t = now.tv_sec;
    return now.tv_sec;
}
"""


# ---- the bench


class Process:
    """A `rover` command. arguments: its own. run: how it is started, `rover` itself if empty. env: more of that."""

    def __init__(
        self, bench: "Bench", arguments: Sequence[Any], run: Sequence[str] = (), env: dict[str, str] | None = None
    ):
        self._errors = (bench.folder / "errors").open("w+b")
        run = run or (sys.executable, "-m", "rover_lib.cli")
        self.process = subprocess.Popen(
            [*run, *map(str, arguments)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
            env=os.environ | (env or {}),
            start_new_session=True,
        )
        self.pid = self.process.pid

    @property
    def running(self) -> bool:
        return self.process.poll() is None

    def wait(self, seconds: float) -> int | None:
        """Its exit code; None if it has not ended by then."""
        try:
            return self.process.wait(seconds)
        except subprocess.TimeoutExpired:
            return None

    def until(self, says: str) -> None:
        """Waits until it says that on stderr. Raises FaultError if that does not come."""
        end = time.monotonic() + START_S
        while not any(says in line for line in self.stderr()):
            if not self.running or time.monotonic() > end:
                raise FaultError(f"{self.process.args[3:5]} did not say {says!r} but {self.stderr()[-2:]}; try by hand")
            time.sleep(0.02)

    def must_end(self, seconds: float) -> None:
        """Waits until it ends. Raises FaultError if it does not, or not well."""
        if (code := self.wait(seconds)) != 0:
            raise FaultError(f"{self.process.args[3:5]} ended with {code} and said {self.stderr()[-2:]}; try by hand")

    def close(self) -> None:
        """SIGTERM, and if that does not help, SIGKILL."""
        if self.running:
            with contextlib.suppress(ProcessLookupError):
                self.process.send_signal(signal.SIGCONT)
                self.process.terminate()
            if self.wait(END_S) is None:
                self.process.kill()
                self.process.wait()
        self._errors.close()

    def stderr(self) -> list[str]:
        """The lines of its stderr."""
        return Path(self._errors.name).read_text(errors="replace").splitlines()


class Drive(Process):
    """`rover drive` with the bench's artifact, camera and cable.

    start: one of INSIDE; 'clock', bench.step_clock sets its clock; 'disk', its log is on bench.disk; '' none of them.
    """

    def __init__(self, bench: "Bench", start: str):
        self.start = start
        self._marked = 0
        self.log = bench.disk / "flight.log" if start == "disk" else bench.folder / "flight.log"
        run, env = [], {}
        if start in INSIDE:
            code = f"from {__name__} import on_signal; on_signal({start!r}); from rover_lib.cli import main; main()"
            run = [sys.executable, "-c", code]
        if start == "clock":
            env = {"LD_PRELOAD": str(bench.clock_library()), "CLOCK_STEP": str(bench.clock)}
        options = ["--hz", RATE_HZ, "--threads", 1, "--log", self.log]
        super().__init__(bench, ["drive", bench.artifact, *bench.devices(), *options], run, env)

    def children(self) -> list[int]:
        """Its processes: the policy's."""
        found = []
        for status in Path("/proc").glob("[0-9]*/stat"):
            with contextlib.suppress(OSError):
                if int(status.read_text().rpartition(")")[2].split()[1]) == self.pid:
                    found.append(int(status.parent.name))
        return found

    def said(self, since_s: float | None = None) -> list[str]:
        """What it says since a time [default: its start], in its flight log and then on stderr, as far as marked."""
        events = []
        with contextlib.suppress(LogError):
            flight = read_log(self.log)
            start_s = flight.header.get("start_monotonic_s", 0.0)
            events = [str(e) for e in flight.events if since_s is None or start_s + e.t_s >= since_s]
        return events + self.stderr()[0 if since_s is None else self._marked :]

    def mark(self) -> None:
        """What it said on stderr until now is from before the fault."""
        self._marked = len(self.stderr())


class Bench:
    """Arduino, camera, cable, and the drive that uses them; a context manager."""

    def __init__(self) -> None:
        self._stack = contextlib.ExitStack()
        self.undo = contextlib.ExitStack()  # of the fault
        self.folder = Path(tempfile.mkdtemp(prefix="rover-faults-"))
        self._stack.callback(shutil.rmtree, self.folder, ignore_errors=True)
        self.disk = self.folder / "disk"
        self.disk.mkdir()
        self._stack.callback(self._make_disk())
        self.clock = self.folder / "clock"
        self.clock.write_bytes(bytes(8))
        self.artifact = self.folder / "policy.pt"
        make_artifact(self.artifact)
        self.camera = self.folder / "camera"
        self.events: list[PinEvent] = []
        self.rng = random.Random(0)
        self._pictures = {told: pictures(told) for told in range(7)}
        self.drive: Drive | None = None
        try:
            self.arduino = self._stack.enter_context(Arduino(transmitter=REST_US, nice=EMULATOR_NICE))
            _go_first(self.arduino.pid)
            self.cable = Cable(self.arduino.port)
            self.feed = CameraFeed(self.camera, *self._pictures[PLAIN])
            self._stack.enter_context(_going_first())
        except BaseException:
            self._stack.close()
            raise
        self._stack.callback(lambda: (self.feed.close(), self.cable.unplug()))

    def __enter__(self) -> "Bench":
        return self

    def __exit__(self, *exc: object) -> None:
        self.undo.close()
        self.end_drive()
        self._stack.close()

    def wait(self, seconds: float) -> None:
        """Lets time pass, and reads the pins."""
        end = time.monotonic() + seconds
        while True:
            self.events += self.arduino.pulses()
            if (left := end - time.monotonic()) <= 0:
                return
            time.sleep(min(left, 0.1))

    def devices(self) -> list[str]:
        """Options of a `rover` command."""
        return ["--camera", str(self.camera), "--port", self.cable.port]

    def show(self, told: int) -> None:
        """What the camera sees from its next frame on."""
        self.feed.show(*self._pictures[told])

    def at_speed(self, start: str = "") -> Drive:
        """A drive that was started like that, and has been driving for a while. The one that is on, if it fits."""
        if self.drive is None or not self.drive.running or self.drive.start != start:
            self.restart(start)
        else:
            self.wait(AT_SPEED_S)
        return self.drive

    def calm(self) -> None:
        """No more faults, as far as a drive that goes on notices."""
        self.undo.close()
        self.cable.to_arduino = self.cable.to_host = None
        self.feed.late_s = 0.0
        self.show(PLAIN)
        self.arduino.transmitter(*REST_US)

    def restart(self, start: str = "") -> None:
        """A new drive, from the start until it has been driving for a while."""
        self.end_drive()
        self.repair()
        self.drive = Drive(self, start)
        begin, moving_s = time.monotonic(), None
        while moving_s is None or time.monotonic() - moving_s < AT_SPEED_S:
            self.wait(0.02)
            if moving_s is None and self.cable.commands:
                first_s = self.cable.commands[0].at_s
                pulses = (e for e in self.events[-2000:] if e.pin == "throttle" and e.monotonic_s > first_s)
                moving_s = next((e.end_s for e in pulses if e.pulse_us > 124), None)
            if not self.drive.running or time.monotonic() - begin > START_S:
                said = " | ".join(self.drive.stderr()[-3:])
                raise FaultError(f"rover drive did not start within {START_S:g} s (it said: {said}); drive it by hand")

    def repair(self) -> None:
        """Whatever was broken is as before."""
        self.calm()
        self.feed.close()
        self.feed = CameraFeed(self.camera, *self._pictures[PLAIN])
        self.cable.unplug()
        self.cable = Cable(self.arduino.port)

    def end_drive(self) -> None:
        if self.drive:
            self.drive.close()
            self.drive = None

    def signal(self, number: int) -> None:
        self.drive.process.send_signal(number)

    def step_clock(self, seconds: int) -> None:
        """Steps the system's clock, as a drive that was started with 'clock' sees it."""
        with self.clock.open("r+b") as file, mmap.mmap(file.fileno(), 8) as step:
            struct.pack_into("q", step, 0, struct.unpack_from("q", step)[0] + seconds)

    def _make_disk(self) -> Callable[[], object]:
        """A small disk of its own at `disk`, where that is allowed; how to get rid of it."""
        mount = ["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "tmpfs", str(self.disk)]
        own = os.geteuid() == 0 and subprocess.run(mount, capture_output=True).returncode == 0
        self.disk_is = "a small tmpfs is filled" if own else "RLIMIT_FSIZE by prlimit, as this user may mount no disk"
        self._own_disk = own
        return lambda: own and subprocess.run(["umount", "--lazy", self.disk], check=True)

    def fill_disk(self) -> None:
        """Until undone, rover drive can write no more to its files on `disk`."""
        if self._own_disk:
            filling = self.disk / "filling"
            self.undo.callback(filling.unlink)
            with filling.open("wb", buffering=0) as file, contextlib.suppress(OSError):
                while file.write(bytes(4096)):
                    pass
        else:
            most = resource.prlimit(self.drive.pid, resource.RLIMIT_FSIZE, (4096, resource.RLIM_INFINITY))
            self.undo.callback(resource.prlimit, self.drive.pid, resource.RLIMIT_FSIZE, most)

    def clock_library(self) -> Path:
        """For LD_PRELOAD."""
        library = self.folder / "clock.so"
        if not library.exists():
            source = self.folder / "clock.c"
            source.write_text(CLOCK)
            call(*CC, "-shared", "-fPIC", "-o", library, source)
        return library


# ---- the faults


@dataclass(frozen=True)
class Fault:
    """One row. inject: makes it happen, waits if it takes time, and returns when it happened (None: when called).

    says: a regular expression of the line that tells of it, in the flight log or on stderr; of the drive after it if
    later. how: it is injected. watch_s: so long it is watched after inject. exit_code: of the drive, None: it goes on.
    start: of the drive, see Drive. limits: what makes a `continues` stop after all. human_us: of `human`.
    """

    name: str
    expected: str
    inject: Callable[[Bench], float | None]
    says: str
    how: str
    exit_code: int | None
    watch_s: float = 1.0
    start: str = ""
    later: bool = False
    limits: str = ""
    until_limit: bool = False
    human_us: tuple[float, float] = REST_US


FAULTS: list[Fault] = []


def _fault(name: str, expected: str, says: str, how: str, **more: Any) -> Callable[[Callable], Callable]:
    more.setdefault("exit_code", {STOPPED: 3, HUMAN: 4, CONTINUES: None}[expected])

    def add(inject: Callable[[Bench], float | None]) -> Callable[[Bench], float | None]:
        FAULTS.append(Fault(name, expected, inject, says, how, **more))
        return inject

    return add


def _sees(name: str, told: int, says: str) -> None:
    _fault(name, STOPPED, says, "the picture tells the policy to")(lambda bench: bench.show(told))


def _signals(name: str, number: int, says: str, **more: Any) -> None:
    _fault(name, STOPPED, says, "a signal from outside", **more)(lambda bench: bench.signal(number))


@_fault("camera unplugged", STOPPED, "is the camera unplugged", "the FIFO's writer closes it")
def _unplug_camera(bench: Bench) -> None:
    bench.feed.close()


@_fault("camera frozen", STOPPED, "the camera is frozen", "the same JPEG again and again")
def _freeze(bench: Bench) -> None:
    bench.feed.freeze()


@_fault("camera black", STOPPED, "picture is black", "black pictures, with a sensor's noise")
def _blacken(bench: Bench) -> None:
    bench.feed.show(*pictures(PLAIN, level=0))


@_fault("camera changes its picture's size", STOPPED, "the picture changed from", "pictures of 160x80")
def _resize(bench: Bench) -> None:
    bench.feed.show(*pictures(PLAIN, size=(80, 160)))


_sees("inference raises", RAISE, "told to fail by the picture")
_sees("inference returns NaN", NAN, "NaN or Inf|not finite")
_sees("inference returns out of range", BEYOND, "outside the range")


@_fault("inference process killed", STOPPED, r"process ended \(SIGKILL\)", "SIGKILL to the child of rover drive")
def _kill_inference(bench: Bench) -> None:
    for pid in bench.drive.children():
        os.kill(pid, signal.SIGKILL)


@_fault(
    "loop thread killed",
    STOPPED,
    "the loop has not ticked",
    "the loop's thread leaves by exit(2), in the process",
    start="end the loop's thread",
)
def _kill_loop(bench: Bench) -> None:
    bench.signal(signal.SIGUSR2)


@_fault(
    "exception in the loop",
    STOPPED,
    "raised in the loop",
    "raised by a signal's handler, wherever the loop is",
    start="raise in the loop",
)
def _raise_in_loop(bench: Bench) -> None:
    bench.signal(signal.SIGUSR2)


@_fault("host process stopped", STOPPED, "no valid command for 150 ms|said nothing for", "SIGSTOP, after 1 s SIGCONT")
def _pause_process(bench: Bench) -> float:
    at_s = time.monotonic()
    bench.signal(signal.SIGSTOP)
    bench.wait(1.0)
    bench.signal(signal.SIGCONT)
    return at_s


_signals("SIGTERM", signal.SIGTERM, "SIGTERM: stopping", exit_code=0)
_signals("SIGINT", signal.SIGINT, "SIGINT: stopping", exit_code=0)
_signals("SIGHUP", signal.SIGHUP, "SIGHUP: stopping", exit_code=0)
_signals("SIGKILL", signal.SIGKILL, "the drive before this one", exit_code=-signal.SIGKILL, later=True)


@_fault("serial unplugged", STOPPED, "is it still plugged in", "both ends of the pty behind the port are closed")
def _unplug_serial(bench: Bench) -> None:
    bench.cable.unplug()


@_fault("serial stuck", STOPPED, "took no data", "the port's output is suspended: writes block")
def _stick(bench: Bench) -> None:
    bench.cable.stick()


@_fault(
    "serial silent from the host", STOPPED, "no valid command for 150 ms", "the line to the Arduino carries nothing"
)
def _silence(bench: Bench) -> None:
    bench.cable.to_arduino = lambda data: b""


@_fault("Arduino reset", STOPPED, r"was reset \(reset pin\)", "the reset button")
def _reset(bench: Bench) -> None:
    bench.arduino.reset()


@_fault("Arduino loop hung", STOPPED, r"was reset \(watchdog\)", "an endless loop in place of the firmware's")
def _hang(bench: Bench) -> None:
    bench.arduino.hang()


@_fault("receiver lost", STOPPED, "transmitter's signal was lost", "no pulses on the receiver's pins")
def _lose_receiver(bench: Bench) -> None:
    bench.arduino.transmitter(0, 0)


@_fault("receiver's throttle channel lost", STOPPED, "transmitter's signal was lost", "no pulses on that pin")
def _lose_throttle(bench: Bench) -> None:
    bench.arduino.transmitter(REST_US[0], 0)


def _takes_over(name: str, steering_us: float, throttle_us: float) -> None:
    human_us = (steering_us, throttle_us)
    _fault(name, HUMAN, "the human took over", f"the transmitter sends {human_us}", human_us=human_us)(
        lambda bench: bench.arduino.transmitter(*human_us)
    )


_takes_over("human takes over by steering", 1600, 140)
_takes_over("human takes over by throttle", 1470, 200)


@_fault(
    "frames late",
    CONTINUES,
    "no new frame",
    "none for 300 ms, then each 120 ms late",
    watch_s=0.1,
    limits="as 'camera gives no more frames', when none comes for longer than that",
)
def _frames_late(bench: Bench) -> float:
    at_s = time.monotonic()
    bench.feed.pause()
    bench.wait(0.3)
    bench.feed.late_s = 0.12
    bench.show(PLAIN)
    bench.wait(1.5)
    bench.feed.late_s = 0.0
    return at_s


@_fault(
    "inference hangs for 300 ms",
    CONTINUES,
    "the policy took",
    "the picture tells the policy to",
    limits="as 'inference hangs', when it is longer",
)
def _slow_inference(bench: Bench) -> float:
    at_s = time.monotonic()
    bench.show(SLOW)
    bench.wait(0.05)
    bench.show(PLAIN)
    bench.wait(0.5)
    return at_s


@_fault(
    "artifact swapped on disk",
    CONTINUES,
    "changed on disk",
    "another file is renamed onto it",
    watch_s=1.6,
    limits="none: the loaded policy drives on; the next start checks the new file",
)
def _swap(bench: Bench) -> None:
    kept, other = bench.folder / "kept.pt", bench.folder / "other.pt"
    os.link(bench.artifact, kept)
    bench.undo.callback(kept.replace, bench.artifact)
    other.write_bytes(b"no artifact")
    other.replace(bench.artifact)


COMMANDS_LOST = "the Arduino stops the car 150 ms after the last command that came through, in 5 commands' time"


@_fault(
    "bit flips at 1 % of bytes",
    CONTINUES,
    "the link",
    "a bit of 1 % of the bytes, in both directions",
    watch_s=2.0,
    limits=COMMANDS_LOST,
)
def _flip(bench: Bench) -> None:
    bench.cable.to_arduino = flipping(bench.rng, 0.01)
    bench.cable.to_host = flipping(random.Random(bench.rng.random()), 0.01)


@_fault(
    "lines dropped at 30 %",
    CONTINUES,
    "the link",
    "30 % of the lines, in both directions",
    watch_s=2.0,
    limits=COMMANDS_LOST,
)
def _drop(bench: Bench) -> None:
    bench.cable.to_arduino = dropping(bench.rng, 0.3)
    bench.cable.to_host = dropping(random.Random(bench.rng.random()), 0.3)


@_fault(
    "old line replayed",
    CONTINUES,
    "the link",
    "after other plans: the lines that asked for them, one every 20 ms",
    limits="none: an old sequence moves no pin and renews nothing",
)
def _replay(bench: Bench) -> float:
    first = len(bench.cable.lines)
    bench.show(OTHER)
    bench.wait(0.8)
    old = bench.cable.lines[first + 10 :]
    bench.show(PLAIN)
    bench.wait(0.8)
    at_s = time.monotonic()
    for line in old[-50:]:
        bench.cable.inject(line)
        bench.wait(0.02)
    return at_s


@_fault(
    "line cut in half",
    CONTINUES,
    "the link",
    "every third line, in both directions",
    watch_s=2.0,
    limits=COMMANDS_LOST,
)
def _cut(bench: Bench) -> None:
    def cutting() -> Change:
        number = 0

        def cut(line: bytes) -> bytes:
            nonlocal number
            number += 1
            return line if number % 3 else line[: len(line) // 2]

        return by_line(cut)

    bench.cable.to_arduino, bench.cable.to_host = cutting(), cutting()


@_fault(
    "another program writes to the port",
    CONTINUES,
    "the link",
    "rubbish, a modem manager's questions, and whole lines for another start of the Arduino, one every 15 ms",
    limits="none by what it writes; what it reads is lost to rover drive: 0.5 s without a status stop the car",
)
def _intrude(bench: Bench) -> float:
    whole = [frame(f">D 0 {n} 2000 700") for n in range(1, 20)] + [frame(">A 0 1"), frame(">N 0 2")]
    bench.cable.not_ours |= {line[:-1] for line in whole}
    at_s = time.monotonic()
    with open(bench.cable.port, "wb", buffering=0) as port:  # noqa: PTH123  # a device
        for _ in range(60):
            what = bench.rng.choice([b"AT\r", b"AT+GCAP\r", bench.rng.randbytes(20), bench.rng.choice(whole)])
            port.write(what)
            bench.wait(0.015)
    return at_s


@_fault(
    "CPU starved",
    CONTINUES,
    "this machine is busy",
    "4 busy processes of ordinary priority",
    watch_s=3.0,
    limits="as 'inference hangs', when the policy gets so little that plans become too old",
)
def _starve(bench: Bench) -> None:
    for _ in range(4):
        busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
        bench.undo.callback(lambda busy=busy: (busy.kill(), busy.wait()))
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, busy.pid, 0)


@_fault(
    "disk full while logging",
    CONTINUES,
    "the flight log cannot be written",
    "",
    start="disk",
    watch_s=2.0,
    limits="none: it drives without a log, and says so once",
)
def _fill_disk(bench: Bench) -> None:
    bench.fill_disk()


for hours in (1, -1):
    _fault(
        f"clock stepped by {hours:+d} h",
        CONTINUES,
        re.escape(f"the system's clock was set by {hours * 3600:+d} s"),
        "a library under rover drive shifts the system's time; the machine's is left alone",
        start="clock",
        watch_s=1.6,
        limits="none: what drives asks the monotonic clock only",
    )(lambda bench, hours=hours: bench.step_clock(3600 * hours))


@_fault(
    "exception in the logger",
    CONTINUES,
    "raised in the logger",
    "each line of the flight log raises while it is made",
    start="raise in the logger",
    watch_s=2.0,
    limits="none: it drives without a log, and says so once",
)
def _fail_logger(bench: Bench) -> None:
    bench.signal(signal.SIGUSR2)


@_fault(
    "inference hangs",
    CONTINUES,
    "the policy has not answered",
    "the picture tells the policy to loop for ever",
    watch_s=2.0,
    until_limit=True,
    exit_code=3,
)
def _hang_inference(bench: Bench) -> None:
    bench.show(HANG)


@_fault(
    "camera gives no more frames",
    CONTINUES,
    "no new frame came",
    "the FIFO stays open, and nothing comes",
    watch_s=2.0,
    until_limit=True,
    exit_code=3,
)
def _no_frames(bench: Bench) -> None:
    bench.feed.pause()


# ---- a run


def run_fault(bench: Bench, fault: Fault, gates: Gates) -> dict[str, Any]:
    """Injects a fault into the drive that is at speed and judges it; a row of metrics.faults.

    Its `recovered`, and its `log_line` if that comes later, are None where the next start of a drive tells them.
    """
    attempts = 0
    while True:
        attempts += 1
        drive = bench.drive
        bench.rng.seed(fault.name)
        bench.events = bench.events[-2000:]
        drive.mark()
        called_s = time.monotonic()
        at_s = fault.inject(bench) or called_s
        bench.wait(fault.watch_s)
        end_s = time.monotonic()
        bench.wait(0.05)  # a pulse is known when it ends
        commands = [c for c in bench.cable.commands if at_s - 1 < c.at_s <= end_s]
        seen = Seen(bench.events, commands, at_s, end_s)
        code = drive.process.poll() if fault.exit_code is None else drive.wait(END_S)
        said = None if fault.later else _find(fault.says, drive, at_s)
        bench.calm()
        if not (stalled_ms := seen.stalled_ms()) or attempts == TRIES:
            break
        bench.at_speed(fault.start)
    verdict = judge(fault.expected, seen, gates, human_us=fault.human_us, until_limit=fault.until_limit)
    if code != fault.exit_code:
        verdict.wrong.append(f"rover drive ended with {code}, expected {fault.exit_code}")
    limits = fault.limits
    if fault.until_limit:
        fades, stops = verdict.figures["fades_after_ms"], verdict.figures["stopped_after_ms"]
        limits = f"the plan's age: the throttle fades from {fades} ms on, is off at {stops} ms, and drive ends"
    return {
        "fault": fault.name,
        "expected": fault.expected,
        **verdict.figures,
        "recovered": not verdict.wrong if fault.exit_code is None else None,
        "log_line": said,
        "exit_code": code,
        "injected": fault.how if fault.start != "disk" else bench.disk_is,
        "limits": limits,
        "attempts": attempts,
        "stalled_ms": round(stalled_ms, 1),
        "wrong": verdict.wrong,
    }


def _find(says: str, drive: Drive, since_s: float | None = None, within_s: float = 1.5) -> str | None:
    """The first line that says so."""
    end = time.monotonic() + within_s
    while True:
        for line in drive.said(since_s):
            if re.search(says, line):
                return line
        if time.monotonic() > end:
            return None
        time.sleep(0.1)


def fuzz(lines: int = FUZZ_LINES, seed: int = 1) -> dict[str, Any]:
    """Random and mutated lines into the firmware's parser and state machine, natively: tests/firmware/fuzz.c.

    unsafe_pulses: 0 or 1, it ends at the first.
    """
    firmware = REPOSITORY / "firmware" / "rover"
    sources = REPOSITORY / "tests" / "firmware" / "fuzz.c", firmware / "protocol.c", firmware / "vehicle.c"
    with tempfile.TemporaryDirectory(prefix="rover-fuzz-") as folder:
        program = Path(folder) / "fuzz"
        call(*CC, "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-I", firmware, "-o", program, *sources)
        done = subprocess.run([program, str(lines), str(seed)], capture_output=True, text=True)
    said = (done.stdout + done.stderr).strip()
    return {"lines": lines, "seed": seed, "unsafe_pulses": int(done.returncode != 0), "said": said}


def transmitted_and_replayed(bench: Bench, steps: int = 24, step_s: float = 0.2) -> dict[str, Any]:
    """A transmitter's pulses, recorded by `rover record` and replayed by `rover drive --replay`, on the pins.

    worst_us: of all pulses of the replay, against what was transmitted in their place; None if that is another
    sequence. worst_ms: how far a step of the replay began from its time. Raises FaultError if either command fails.
    """
    rng = random.Random(0)
    sent = [REST_US]
    while len(sent) < steps - 1:
        pulses = float(rng.randint(1008, 1948)), float(rng.randint(140, 700))
        if all(abs(a - b) > 40 for a, b in zip(pulses, sent[-1], strict=True)):
            sent.append(pulses)
    sent.append(REST_US)
    bench.end_drive()
    bench.repair()
    folder, times_s = bench.folder / "episodes", []
    with contextlib.closing(Process(bench, ["record", folder, *bench.devices()])) as record:
        record.until("recording")
        for pulses in sent:
            times_s.append(time.monotonic())
            bench.arduino.transmitter(*pulses)
            bench.wait(step_s)
        record.process.send_signal(signal.SIGINT)
        record.must_end(START_S)
    bench.wait(0.1)
    bench.events = []
    episode = next(folder.glob("episode_*"))
    with contextlib.closing(Process(bench, ["drive", "--replay", episode, "--port", bench.cable.port])) as replay:
        replay.until("armed")
        bench.wait(steps * step_s)
        replay.must_end(START_S)
    bench.wait(0.2)
    since_s = bench.cable.commands[0].at_s + 2 * PERIOD_US["steering"] * 1e-6  # before, they are the transmitter's
    return compare_steps([e for e in bench.events if e.monotonic_s > since_s], sent, times_s)


def compare_steps(
    events: Sequence[PinEvent], sent: Sequence[tuple[float, float]], times_s: Sequence[float]
) -> dict[str, Any]:
    """Steps of pulses (steering, throttle; us) that were sent at times, against those on the pins; see above."""
    result: dict[str, Any] = {"steps": len(sent), "worst_us": 0.0, "worst_ms": 0.0, "pulses": 0}
    for i, pin in enumerate(PERIOD_US):
        found = [e for e in events if e.pin == pin and e.kind == "pulse"]
        runs: list[list[PinEvent]] = []
        for e in found:
            if not runs or abs(e.pulse_us - runs[-1][0].pulse_us) > 2 * STEP_US:
                runs.append([])
            runs[-1].append(e)
        result[f"{pin}_steps"] = len(runs)
        if len(runs) != len(sent):
            return result | {"worst_us": None}
        for run, pulses in zip(runs, sent, strict=True):
            # A pin does whole ticks; what simavr adds to an edge is its granularity, not the chip's.
            widths = {TICK_US[pin] * round(e.pulse_us / TICK_US[pin]) for e in run}
            result["worst_us"] = max(result["worst_us"], *(abs(us - pulses[i]) for us in widths))
            result["pulses"] += len(run)
        begun = np.array([run[0].monotonic_s for run in runs[1:]]) - np.array(times_s[1:])
        result["worst_ms"] = max(result["worst_ms"], round(float(np.abs(begun - np.median(begun)).max()) * 1e3, 1))
    return result


@dataclass
class Outcome:
    """What a run found: the rows, the fuzz and the bytes (None: left out), and all that is not as expected."""

    gates: Gates
    rows: list[dict[str, Any]] = field(default_factory=list)
    fuzz: dict[str, Any] | None = None
    bytes: dict[str, Any] | None = None
    wrong: list[str] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def summary(self) -> dict[str, Any]:
        """rows, stopped_rows, as_expected, worst_stopped_after_ms, takeover_ms, repeated, seconds."""
        stopped = [r for r in self.rows if r["expected"] == STOPPED]
        takeovers = [r["takeover_ms"] for r in self.rows if r.get("takeover_ms") is not None]
        return {
            "rows": len(self.rows),
            "stopped_rows": len(stopped),
            "as_expected": sum(not r["wrong"] for r in self.rows),
            "worst_stopped_after_ms": max((r["stopped_after_ms"] for r in stopped), default=None),
            "takeover_ms": max(takeovers, default=None),
            "repeated": sum(r["attempts"] > 1 for r in self.rows),
            "seconds": round(self.seconds, 1),
        }

    def write(self, path: Path | str) -> dict[str, Any]:
        """Writes the stage `faults`, and returns it."""
        metrics = {"faults": self.rows, "fuzz": self.fuzz, "bytes": self.bytes, "summary": self.summary}
        return write_stage(path, "faults", params=vars(self.gates), metrics=metrics | {"wrong": self.wrong})


def run_faults(
    only: Iterable[str] = (),
    *,
    gates: Gates | None = None,
    fuzz_lines: int = FUZZ_LINES,
    say: Callable[[str], None] = lambda text: None,
) -> Outcome:
    """Injects all faults, or those of `only`, where 'fuzz' and 'bytes' are names too; about 5 minutes for all.

    say: is told a line as each is done. Raises FaultError for names that are none and for a bench that does not drive,
    ArduinoError if there is no emulated Arduino here.
    """
    gates, only, begin = gates or Gates.of_params(), list(only), time.monotonic()
    if unknown := sorted(set(only) - {f.name for f in FAULTS} - {"fuzz", "bytes"}):
        raise FaultError(f"no fault {unknown}: choose from {[f.name for f in FAULTS]}, 'fuzz' and 'bytes'")
    build()  # here, where its errors are seen
    outcome = Outcome(gates)
    chosen = [f for f in FAULTS if not only or f.name in only]
    if not only or "fuzz" in only:
        outcome.fuzz = fuzz(fuzz_lines)
        say(f"fuzz: {outcome.fuzz['said']}")
        if outcome.fuzz["unsafe_pulses"]:
            outcome.wrong.append(f"fuzz: {outcome.fuzz['said']}")
    with Bench() as bench:
        if not only or "bytes" in only:
            outcome.bytes = transmitted_and_replayed(bench)
            say(f"bytes: {outcome.bytes}")
            if outcome.bytes["worst_us"] is None or outcome.bytes["worst_us"] > gates.bytes_us:
                outcome.wrong.append(f"bytes: {outcome.bytes}, {gates.bytes_us:g} us are allowed")
        for fault, row in _rows(bench, chosen, gates):
            _complete(fault, row)
            say(row_text(row))
            outcome.rows.append(row)
            outcome.wrong += [f"{row['fault']}: {sentence}" for sentence in row["wrong"]]
    outcome.seconds = time.monotonic() - begin
    for name in ("rows", "stopped_rows"):
        if not only and outcome.summary[name] < getattr(gates, name):
            outcome.wrong.append(f"{outcome.summary[name]} {name}, {getattr(gates, name)} are wanted")
    return outcome


def _rows(bench: Bench, chosen: Sequence[Fault], gates: Gates) -> Iterator[tuple[Fault, dict[str, Any]]]:
    """Each fault's row, once all that belongs to it is known: that it drives again only the next start tells."""
    before: tuple[Fault, dict[str, Any]] | None = None
    for fault in chosen:
        if before:
            _drive_again(bench, *before, fault.start)
            yield before
        elif bench.drive is None:
            bench.at_speed(fault.start)
        before = fault, run_fault(bench, fault, gates)
    if before:
        _drive_again(bench, *before, "")
        yield before


def _drive_again(bench: Bench, fault: Fault, row: dict[str, Any], start: str) -> None:
    """The next drive; what it tells of a fault before it."""
    try:
        bench.at_speed(start)
        again = True
    except FaultError as error:
        row["wrong"].append(str(error))
        again = False
        bench.at_speed(start)
    if fault.exit_code is not None:
        row["recovered"] = again
    if fault.later:
        row["log_line"] = _find(fault.says, bench.drive)


def _complete(fault: Fault, row: dict[str, Any]) -> None:
    if row["log_line"] is None:
        row["wrong"].append(f"no line tells of it (wanted: {fault.says})")
    row["found"] = fault.expected if not row["wrong"] else "not as expected"


def row_text(row: dict[str, Any]) -> str:
    """A line for people: fault, expected, found, after how many milliseconds, log line."""
    ms = row.get("takeover_ms", row["stopped_after_ms"])
    ms = "" if ms is None else f"{ms:.0f} ms"
    line = " ".join((row["log_line"] or "no line").split())
    again = f" ({row['attempts']} attempts)" if row["attempts"] > 1 else ""
    return f"{row['fault']:<35} {row['expected']:<10} {row['found']:<16} {ms:>8}  {line[-70:]}{again}"

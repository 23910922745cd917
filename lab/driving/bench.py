"""The bench for faults: `rover drive` as a process, between a camera, a cable and an Arduino that can be broken."""

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
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from lab.arduino.emulator import CC, NICE, Arduino, call
from lab.driving.pins import Command
from rover_lib.onboard.artifact import SCHEMA, save_artifact
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.pwm import STOPPED_THROTTLE_US
from rover_lib.onboard.servo_link import frame
from rover_lib.onboard.telemetry import LogError, read_log
from rover_lib.onboard.watch import SWITCH_S, schedule
from rover_lib.world.car import CameraFeed
from rover_lib.world.standin import REST_US, PinEvent

AT_SPEED_S = 0.6  # from the first throttle to the fault
START_S = 30.0
END_S = 6.0
SIZE = (160, 320)  # height and width of the camera's pictures
CHUNK, RATE_HZ = 32, 30.0
PLAN, OTHER_PLAN = (0.2, 0.15), (-0.3, 0.08)  # steering, throttle
DISK_BYTES = 512 * 1024
PRIORITY = 3  # of real time, before rover drive: a real Arduino and a real cable do not wait for this machine

# What the picture's corner tells the policy: its red, green and blue are on or off.
PLAIN, RAISE, HANG, NAN, BEYOND, SLOW, OTHER = range(7)


class FaultError(RoverError):
    """A fault that cannot be injected or judged here."""


# ---- the policy, and what tells it what to do


def make_artifact(
    path: Path, *, camera: str = "front", size: tuple[int, int] = (48, 96), engine: str | None = None
) -> None:
    """An artifact with constant plans that obeys the corner of the picture, see PLAIN to OTHER.

    camera, size: its name, and height and width of what the policy looks at. engine: in the manifest; this machine's.
    """
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

    height, width = size
    module = torch.jit.script(Obedient().eval())
    names = ["steering", "throttle"]
    manifest = {
        "schema": SCHEMA,
        "mode": "fp32",
        "scheme": "float",
        "engine": engine or torch.backends.quantized.engine,
        "cameras": [{"name": camera, "height": height, "width": width}],
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
        f"frame_{camera}": frames,
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
            self.arduino = self._stack.enter_context(Arduino(transmitter=REST_US, nice=NICE))
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
                moving_s = next((e.end_s for e in pulses if e.pulse_us > STOPPED_THROTTLE_US), None)
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

"""Twelve faults of a drive in real time: what only processes, clocks and the pins of an emulated Arduino show.

Everything that drives is what drives the real car: `rover drive` as a process, pyserial, and the real firmware, in
simavr. Three pieces of hardware are replaced. The camera is a FIFO of JPEGs, the cable a pair of ptys with this program
between them, and the transmitter's pulses come from simavr. All other faults are in rows.py, in virtual time.
"""

import contextlib
import ctypes
import functools
import platform
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from balloon_world.car import CameraFeed
from balloon_world.child_process import Child
from balloon_world.simulated_arduino import REST_US, PinEvent
from lab.arduino.emulator import NICE, EmulatedArduino
from lab.driving.cable import PRIORITY, Cable, boost
from lab.driving.pins import BEFORE_S, CONTINUES, STOPPED_THROTTLE_US, Gates, Observation, judge, row_of
from lab.driving.policy import RATE_HZ, make_artifact, pictures
from lab.driving.rows import FaultRow
from lab.driving.stories import read_stories
from rover_lib.onboard.drive.watch import real_time
from rover_lib.onboard.errors import RoverError

AT_SPEED_S = 0.6  # from the first throttle to the fault
START_S = 90.0  # a drive imports torch twice, which takes a third of a minute while four other processes are busy
END_S = 6.0
KNOWN_S = 0.05  # how long it takes until a pulse has ended and been read
ATTEMPTS = 5  # how often a row is tried if this machine was too busy
KILLED = -signal.SIGKILL
LINE_S = 1.5  # within which a line must come
LATE_COMMAND_S = 0.1  # three ticks of a drive
# A drive waits for its human's gesture only if stdin is a terminal.
IN_TERMINAL = "import os, pty; kept, terminal = pty.openpty(); os.dup2(terminal, 0); "
THREAD_ENDS = f"from {__name__} import end_thread_on_signal; end_thread_on_signal(); "


def end_thread_on_signal() -> None:
    """Make SIGUSR2 end only the main thread of this process, which is the loop's, by the system call exit."""
    number = {"x86_64": 60, "aarch64": 93}[platform.machine()]
    signal.signal(signal.SIGUSR2, lambda *_: ctypes.CDLL(None).syscall(number, 0))


class Drive(Child):
    """`rover drive` with the bench's artifact, camera and cable. prepared: code that runs in its process before."""

    def __init__(self, bench: "PinBench", prepared: str):
        self.prepared, self._marked = prepared, 0
        code = f"{IN_TERMINAL}{prepared}from rover_lib.onboard.cli import main; main()"
        devices = "--camera", bench.camera, "--port", bench.cable.port, "--view", bench.folder / "view"
        options = "--hz", RATE_HZ, "--threads", 1, "--log", bench.folder / "flight.log"
        command = (sys.executable, "-c", code, "drive", bench.artifact, *devices, *options)
        super().__init__("rover drive", *command, error=RoverError)

    def mark(self) -> None:
        """Note that what it has printed until now is from before the fault."""
        self._marked = len(self.errors())

    def line_of(self, message: str) -> str | None:
        """Return the first line since mark() that matches, or None if there is none within LINE_S."""
        deadline, line = time.monotonic() + LINE_S, None
        while line is None and time.monotonic() < deadline:
            line = next((line for line in self.errors()[self._marked :] if re.search(message, line)), None)
            time.sleep(0.1 * (line is None))
        return line


class PinBench:
    """An Arduino, a camera, a cable, and the drive that uses them; a context manager. undo: what ends the fault."""

    def __enter__(self) -> "PinBench":
        self.undo, self.events = contextlib.ExitStack(), list[PinEvent]()
        self._drive: Drive | None = None
        with contextlib.ExitStack() as stack:
            self.folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rover-faults-")))
            self.artifact, self.camera = self.folder / "policy.pt", self.folder / "camera"
            make_artifact(self.artifact)
            self.arduino = stack.enter_context(EmulatedArduino(transmitter=REST_US, nice=NICE))
            boost(self.arduino.pid)
            stack.enter_context(CameraFeed(self.camera, *pictures()))
            self.cable = Cable(self.arduino.port)
            stack.callback(lambda: self.cable.unplug())
            stack.enter_context(real_time(PRIORITY))
            stack.callback(self._end_drive)
            stack.callback(self.undo.close)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stack.close()

    @property
    def drive(self) -> Drive:
        """The present drive, or the last one."""
        assert self._drive is not None, "at_speed() comes first"
        return self._drive

    def wait(self, seconds: float) -> None:
        """Let time pass, and read the pins meanwhile."""
        end = time.monotonic() + seconds
        while True:
            self.events += self.arduino.pulses()
            if (left := end - time.monotonic()) <= 0:
                return
            time.sleep(min(left, 0.1))

    @property
    def driving(self) -> bool:
        """Whether each of the latest throttle pulses moves the car."""
        since_s = time.monotonic() - BEFORE_S
        latest = [e.pulse_us for e in self.events[-2000:] if e.pin == "throttle" and e.end_s > since_s]
        return bool(latest) and min(latest) > STOPPED_THROTTLE_US

    def at_speed(self, prepared: str = "") -> None:
        """Make sure that a drive has been driving for a while: the present one if it was prepared so, or a new one."""
        if self._drive and self._drive.running and self._drive.prepared == prepared:
            self.wait(AT_SPEED_S)
            if self.driving:
                return
        self._start(prepared)

    def _start(self, prepared: str) -> None:
        """Start a new drive with a new cable, let the human arm it, and wait until it has been driving for a while."""
        self._end_drive()
        self.clear_faults()
        self.cable.unplug()
        self.cable = Cable(self.arduino.port)
        self.arduino.ready(True)
        self._drive = drive = Drive(self, prepared)
        deadline = time.monotonic() + START_S
        first_s = None  # the time of its first command
        while first_s is None or time.monotonic() - first_s < AT_SPEED_S or not self.driving:
            self.wait(0.02)
            if first_s is None and self.cable.commands:
                first_s = self.cable.commands[0].at_s
            if not drive.running or time.monotonic() > deadline:
                raise RoverError("rover drive did not drive", found=drive.errors()[-3:], remedy="drive it by hand")
        self.arduino.ready(False)  # from here on the human only does what a fault says

    def clear_faults(self) -> None:
        """End all faults that a drive which goes on would notice."""
        self.undo.close()
        self.arduino.transmitter(*REST_US)

    def _end_drive(self) -> None:
        if self._drive:
            self._drive.close()
            self._drive = None


# ---- the faults


def _stop_process(bench: PinBench) -> None:
    bench.drive.process.send_signal(signal.SIGSTOP)
    bench.wait(1.0)
    bench.drive.process.send_signal(signal.SIGCONT)


def _signal(name: str) -> Callable[[PinBench], object]:
    return lambda bench: bench.drive.process.send_signal(signal.Signals[name])


def _starve(bench: PinBench) -> None:
    for _ in range(4):
        busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
        bench.undo.callback(busy.wait)
        bench.undo.callback(busy.kill)  # added last, so it is called before wait


def _fill_disk(bench: PinBench) -> None:
    limits = resource.prlimit(bench.drive.pid, resource.RLIMIT_FSIZE, (4096, resource.RLIM_INFINITY))
    bench.undo.callback(resource.prlimit, bench.drive.pid, resource.RLIMIT_FSIZE, limits)


INJECT: dict[str, Callable[[PinBench], object]] = {
    "Arduino reset": lambda bench: bench.arduino.reset(),
    "Arduino's power cut": lambda bench: bench.arduino.power(),
    "Arduino loop hung": lambda bench: bench.arduino.hang(),
    "serial unplugged": lambda bench: bench.cable.unplug(),
    "serial stuck": lambda bench: bench.cable.stick(),
    "human takes over by steering": lambda bench: bench.arduino.transmitter(REST_US[0] + 144, REST_US[1]),
    "host process stopped": _stop_process,
    "loop thread killed": _signal("SIGUSR2"),
    "SIGTERM": _signal("SIGTERM"),
    "SIGKILL": _signal("SIGKILL"),
    "CPU starved": _starve,
    "disk full while logging": _fill_disk,
}
PREPARED = {"loop thread killed": THREAD_ENDS}
STARVES = "CPU starved"  # takes the drive's time


@functools.cache
def pin_rows() -> list[FaultRow]:
    """Read the faults on pins from stories.yml."""
    return [FaultRow(**row) for row in read_stories("pins")]


def _human_us(fault: FaultRow) -> tuple[float, float]:
    return REST_US[0] + fault.moved_us[0], REST_US[1] + fault.moved_us[1]


# ---- judging


def run_pin_row(bench: PinBench, fault: FaultRow, gates: Gates) -> dict[str, Any]:
    """Inject a fault into a drive at speed, judge it, and return the row of metrics.faults.

    If this machine was too busy for the fault to be judged, it is repeated, up to ATTEMPTS times in all.
    """
    attempts, spoilt = 0, True
    while spoilt and attempts < ATTEMPTS:
        attempts += 1
        bench.at_speed(PREPARED.get(fault.name, ""))
        seen, code, line = _inject(bench, fault)
        spoilt = _spoilt(fault, seen, gates)
    verdict = judge(fault.expected, seen, gates, human_us=_human_us(fault))
    if code != fault.wanted_code:
        verdict.wrong.append(f"rover drive ended with {code}, expected {fault.wanted_code}")
    with contextlib.suppress(RoverError):  # then it is not recovered
        bench.at_speed()
    if code == KILLED:  # the next drive tells of it
        line = bench.drive.line_of(fault.message)
    more = {"attempts": attempts, "stalled_ms": round(seen.stalled_ms(), 1)}
    line = line and line.replace(f"{bench.folder}/", "")
    return row_of(fault, verdict, code, line, bench.driving, "on pins", **more)


def _inject(bench: PinBench, fault: FaultRow) -> tuple[Observation, int | None, str | None]:
    """Inject a fault once. Returns what was seen, the drive's exit code, and the line that tells of the fault."""
    drive = bench.drive
    bench.events = bench.events[-2000:]
    drive.mark()
    at_s = time.monotonic()
    INJECT[fault.name](bench)
    bench.wait(fault.watch_ms / 1e3)
    end_s = time.monotonic()
    bench.wait(KNOWN_S)
    commands = [c for c in bench.cable.commands if at_s - 1 < c.at_s <= end_s]
    code = drive.process.poll() if fault.wanted_code is None else drive.wait(END_S)
    line = None if code == KILLED else drive.line_of(fault.message)
    bench.clear_faults()
    return Observation(bench.events, commands, at_s, end_s), code, line


def _spoilt(fault: FaultRow, seen: Observation, gates: Gates) -> bool:
    """Whether this machine had no time for the Arduino or the drive, so that there is nothing to judge."""
    if seen.stalled_ms() or not seen.was_driving(gates.throttle_max_us):
        return True
    return fault.expected == CONTINUES and fault.name != STARVES and seen.longest_pause_s() > LATE_COMMAND_S


def run_on_pins(faults: Sequence[FaultRow], gates: Gates) -> Iterator[dict[str, Any]]:
    """Yield a row for each fault. Raises RoverError if the bench does not drive, or without an emulator."""
    if faults:
        with PinBench() as bench:
            for fault in faults:
                yield run_pin_row(bench, fault, gates)

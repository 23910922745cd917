"""Twelve faults of a drive in real time: what only processes, clocks and the pins of an emulated Arduino show.

Everything that drives is what drives the real car: `rover drive` as a process, pyserial, and the real firmware, in
simavr. Three pieces of hardware are replaced. The camera is a FIFO of JPEGs, the cable a pty, and the transmitter's
pulses come from simavr. All other faults are in rows.py, in virtual time.
"""

import contextlib
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import termios
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from balloon_world.car import CameraFeed
from balloon_world.child_process import Child
from balloon_world.simulated_arduino import REST_US, PinEvent
from lab.arduino.emulator import NICE, EmulatedArduino
from lab.driving.pins import BEFORE_S, CONTINUES, Command, Observation, judge, most_throttle_us, row_of
from lab.driving.policy import RATE_HZ, make_artifact, pictures
from lab.driving.rows import FaultRow
from rover_lib.onboard.drive.watch import real_time
from rover_lib.onboard.errors import RoverError

AT_SPEED_S = 0.6  # from the first throttle to the fault
START_S = 90.0  # a drive imports torch twice, which takes a third of a minute while four other processes are busy
END_S = 6.0
KNOWN_S = 0.05  # how long it takes until a pulse has ended and been read
ATTEMPTS = 5  # how often a row is tried if this machine was too busy
LINE_S = 1.5  # within which a line must come
LATE_COMMAND_S = 0.1  # three ticks of a drive
PRIORITY = 3  # of real-time scheduling, above that of rover drive: hardware does not wait for this machine
# A drive waits for its human's gesture only if stdin is a terminal.
IN_TERMINAL = "import os, pty; kept, terminal = pty.openpty(); os.dup2(terminal, 0); "
# SIGUSR2 ends only the main thread, which is the loop's, by the system call exit.
THREAD_ENDS = (
    "import ctypes, platform, signal; exit = {'x86_64': 60, 'aarch64': 93}[platform.machine()]; "
    "signal.signal(signal.SIGUSR2, lambda *_: ctypes.CDLL(None).syscall(exit, 0)); "
)


class Drive(Child):
    """`rover drive` with the bench's artifact, camera and cable."""

    def __init__(self, bench: "PinBench"):
        self._marked, self._port = 0, str(bench.arduino.port)
        code = f"{IN_TERMINAL}{THREAD_ENDS}from rover_lib.onboard.cli import main; main()"
        devices = "--camera", bench.camera, "--port", bench.arduino.port, "--view", bench.folder / "view"
        options = "--hz", RATE_HZ, "--threads", 1, "--log", bench.folder / "flight.log"
        command = (sys.executable, "-c", code, "drive", bench.artifact, *devices, *options)
        super().__init__("rover drive", *command, error=RoverError)

    def mark(self) -> None:
        """Note that what it has printed until now is from before the fault."""
        self._marked = len(self.errors())

    def line_of(self, message: str) -> str | None:
        """Return the first line since mark() that matches, with PORT for the port, or None if none comes in LINE_S."""
        deadline, line = time.monotonic() + LINE_S, None
        while line is None and time.monotonic() < deadline:
            line = next((line for line in self.errors()[self._marked :] if re.search(message, line)), None)
            time.sleep(0.1 * (line is None))
        return line and line.replace(self._port, "PORT")


class PinBench:
    """An Arduino, a camera, and the drive that uses them; a context manager. undo: what ends the fault."""

    def __enter__(self) -> "PinBench":
        self.undo, self.events = contextlib.ExitStack(), list[PinEvent]()
        self._drive: Drive | None = None
        with contextlib.ExitStack() as stack:
            self.folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rover-faults-")))
            self.artifact, self.camera = self.folder / "policy.pt", self.folder / "camera"
            make_artifact(self.artifact)
            self.arduino = stack.enter_context(EmulatedArduino(transmitter=REST_US, nice=NICE))
            with contextlib.suppress(OSError):  # if this user may not
                os.sched_setscheduler(self.arduino.pid, os.SCHED_RR, os.sched_param(PRIORITY))
            stack.enter_context(CameraFeed(self.camera, *pictures()))
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
            if (remaining_s := end - time.monotonic()) <= 0:
                return
            time.sleep(min(remaining_s, 0.1))

    def driving(self, seconds: float = BEFORE_S) -> bool:
        """Whether each throttle pulse of the last seconds, at most 1.5, moves the car."""
        since_s = time.monotonic() - seconds
        latest = [e.pulse_us for e in self.events[-2000:] if e.pin == "throttle" and e.end_s > since_s]
        return bool(latest) and min(latest) > most_throttle_us()

    def at_speed(self) -> None:
        """Make sure that a drive has been driving for a while: the present one, or a new one."""
        if self._drive and self._drive.running:
            self.wait(AT_SPEED_S)
            if self.driving():
                return
        self._end_drive()
        self.clear_faults()
        self.arduino.ready(True)
        self._drive = drive = Drive(self)
        deadline = time.monotonic() + START_S
        while not self.driving(AT_SPEED_S):
            self.wait(0.02)
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


def _stick(bench: PinBench) -> None:
    """Let the port take no more bytes, so that whoever writes has to wait."""
    port = os.open(bench.arduino.port, os.O_RDWR | os.O_NOCTTY)
    bench.undo.callback(os.close, port)
    bench.undo.callback(termios.tcflow, port, termios.TCOON)
    termios.tcflow(port, termios.TCOOFF)


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
    "serial unplugged": lambda bench: bench.arduino.unplug(),
    "serial stuck": _stick,
    "human takes over by steering": lambda bench: bench.arduino.transmitter(REST_US[0] + 144, REST_US[1]),
    "host process stopped": _stop_process,
    "loop thread killed": _signal("SIGUSR2"),
    "SIGTERM": _signal("SIGTERM"),
    "SIGKILL": _signal("SIGKILL"),
    "CPU starved": _starve,
    "disk full while logging": _fill_disk,
}


# ---- judging


def run_pin_row(bench: PinBench, fault: FaultRow) -> dict[str, Any]:
    """Inject a fault into a drive at speed, judge it, and return the row of metrics.faults.

    If this machine was too busy for the fault to be judged, it is repeated, up to ATTEMPTS times in all.
    """
    attempts, spoilt = 0, True
    while spoilt and attempts < ATTEMPTS:
        attempts += 1
        bench.at_speed()
        observation, code, line = _inject(bench, fault)
        spoilt = _spoilt(fault, observation)
    human_us = REST_US[0] + fault.moved_us[0], REST_US[1] + fault.moved_us[1]
    verdict = judge(fault.expected, observation, human_us=human_us)
    with contextlib.suppress(RoverError):  # then it is not recovered
        bench.at_speed()
    more = {"attempts": attempts, "stalled_ms": round(observation.stalled_ms(), 1)}
    line = line and line.replace(f"{bench.folder}/", "")
    return row_of(fault, verdict, code, line, bench.driving(), "on pins", **more)


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
    lines = [e for e in bench.events if e.kind == "line" and e.pulse_us and e.monotonic_s <= end_s]
    commands = [Command(e.monotonic_s, round(e.pulse_us), round(e.period_us)) for e in lines]
    code = drive.process.poll() if fault.wanted_code is None else drive.wait(END_S)
    line = drive.line_of(fault.message) if fault.message else None
    bench.clear_faults()
    return Observation(bench.events, commands, at_s, end_s), code, line


def _spoilt(fault: FaultRow, seen: Observation) -> bool:
    """Whether this machine had no time for the Arduino or the drive, unless that is the fault: nothing to judge."""
    if seen.stalled_ms() or not seen.was_driving(most_throttle_us()):
        return True
    return fault.expected == CONTINUES and fault.name != "CPU starved" and seen.longest_pause_s() > LATE_COMMAND_S


def run_on_pins(faults: Sequence[FaultRow]) -> Iterator[dict[str, Any]]:
    """Yield a row for each fault. Raises RoverError if the bench does not drive, or without an emulator."""
    if faults:
        with PinBench() as bench:
            for fault in faults:
                yield run_pin_row(bench, fault)

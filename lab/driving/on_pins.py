"""Twelve faults of a drive in real time: what only processes, clocks and the pins of an emulated Arduino show.

Everything that drives is what drives the real car: `rover drive` as a process, pyserial, and the real firmware, in
simavr. Three pieces of hardware are replaced. The camera is a FIFO of JPEGs, the cable a pair of ptys with this program
between them, and the transmitter's pulses come from simavr. All other faults are in rows.py, in virtual time.
"""

import contextlib
import ctypes
import platform
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from balloon_world.car import CameraFeed
from balloon_world.child_process import Child
from balloon_world.simulated_arduino import REST_US, PinEvent
from lab.arduino.emulator import NICE, EmulatedArduino
from lab.driving.cable import PRIORITY, Cable, boost
from lab.driving.pins import (
    BEFORE_S,
    CONTINUES,
    HUMAN,
    LATE_COMMAND_S,
    STOPPED,
    STOPPED_THROTTLE_US,
    Gates,
    Observation,
    judge,
    row_of,
)
from lab.driving.policy import RATE_HZ, make_artifact, pictures
from rover_lib.onboard.drive.watch import real_time
from rover_lib.onboard.errors import RoverError

AT_SPEED_S = 0.6  # from the first throttle to the fault
START_S = 90.0  # a drive imports torch twice, which takes a third of a minute while four other processes are busy
END_S = 6.0
KNOWN_S = 0.05  # how long it takes until a pulse has ended and been read
ATTEMPTS = 5  # how often a row is tried if this machine was too busy
# A drive waits for its human's gesture only if stdin is a terminal.
IN_TERMINAL = "import os, pty; kept, terminal = pty.openpty(); os.dup2(terminal, 0); "
THREAD_ENDS = f"from {__name__} import end_thread_on_signal; end_thread_on_signal(); "


def end_thread_on_signal() -> None:
    """Make SIGUSR2 end only the main thread of this process, which is the loop's, by the system call exit."""
    number = {"x86_64": 60, "aarch64": 93}[platform.machine()]
    signal.signal(signal.SIGUSR2, lambda *_: ctypes.CDLL(None).syscall(number, 0))


class Drive(Child):
    """`rover drive` with the bench's artifact, camera and cable. prepared: code that runs in its process before."""

    def __init__(self, bench: "PinBench", prepared: str, *arguments: object):
        self.prepared, self._marked = prepared, 0
        code = f"{IN_TERMINAL}{prepared}from rover_lib.onboard.cli import main; main()"
        devices = "--camera", bench.camera, "--port", bench.cable.port, "--view", bench.folder / "view"
        options = "--film", "--hz", RATE_HZ, "--threads", 1, "--log", bench.folder / "flight.log"
        command = (sys.executable, "-c", code, "drive", bench.artifact, *devices, *options, *arguments)
        super().__init__("rover drive", *command, error=RoverError)

    def mark(self) -> None:
        """Note that what it has printed until now is from before the fault."""
        self._marked = len(self.errors())

    def line_of(self, message: str, within_s: float = 1.5) -> str | None:
        """Return the first line since mark() that matches, or None if there is none within that time."""
        deadline = time.monotonic() + within_s
        while True:
            for line in self.errors()[self._marked :]:
                if re.search(message, line):
                    return line
            if time.monotonic() > deadline:
                return None
            time.sleep(0.1)


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
        self.start(prepared)

    def start(self, prepared: str = "", *arguments: object) -> None:
        """Start a new drive with a new cable, let the human arm it, and wait until it has been driving for a while."""
        self._end_drive()
        self.clear_faults()
        self.cable.unplug()
        self.cable = Cable(self.arduino.port)
        self.arduino.ready(True)
        self._drive = drive = Drive(self, prepared, *arguments)
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


@dataclass(frozen=True)
class PinRow:
    """One fault, and what is expected of the car.

    inject: makes the fault happen; method: how, in words. message: a regular expression for the line that tells of it.
    told_later: whether only the next drive prints that line. exit_code: of the drive, None if it goes on. starves:
    whether the fault takes this machine's time away from the drive.
    """

    name: str
    kind: str
    expected: str
    message: str
    method: str
    inject: Callable[[PinBench], object]
    exit_code: int | None = 3
    watch_s: float = 1.0
    prepared: str = ""
    told_later: bool = False
    starves: bool = False
    human_us: tuple[float, float] = REST_US


def _stop_process(bench: PinBench) -> None:
    bench.drive.process.send_signal(signal.SIGSTOP)
    bench.wait(1.0)
    bench.drive.process.send_signal(signal.SIGCONT)


def _starve(bench: PinBench) -> None:
    for _ in range(4):
        busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
        bench.undo.callback(busy.wait)
        bench.undo.callback(busy.kill)  # added last, so it is called before wait


def _fill_disk(bench: PinBench) -> None:
    limits = resource.prlimit(bench.drive.pid, resource.RLIMIT_FSIZE, (4096, resource.RLIM_INFINITY))
    bench.undo.callback(resource.prlimit, bench.drive.pid, resource.RLIMIT_FSIZE, limits)


STEERED_US = REST_US[0] + 144, REST_US[1]
PIN_ROWS = (
    PinRow("Arduino reset", "firmware", STOPPED, r"was reset \(reset pin\)", "the reset button",
           lambda bench: bench.arduino.reset()),
    PinRow("Arduino's power cut", "firmware", STOPPED, r"was reset \(power-on\)", "off and on",
           lambda bench: bench.arduino.power()),
    PinRow("Arduino loop hung", "firmware", STOPPED, r"was reset \(watchdog\)", "an endless loop in the firmware",
           lambda bench: bench.arduino.hang()),
    PinRow("serial unplugged", "link", STOPPED, "is it still plugged in", "both ends of the port's pty are closed",
           lambda bench: bench.cable.unplug()),
    PinRow("serial stuck", "link", STOPPED, "took no data", "the port's output is suspended: writes block",
           lambda bench: bench.cable.stick()),
    PinRow("human takes over by steering", "receiver", HUMAN, "the human took over", "the transmitter's pulses",
           lambda bench: bench.arduino.transmitter(*STEERED_US), exit_code=4, human_us=STEERED_US),
    PinRow("host process stopped", "host", STOPPED, "no valid command for 150 ms|said nothing for",
           "SIGSTOP, after 1 s SIGCONT", _stop_process),
    PinRow("loop thread killed", "host", STOPPED, "the loop has not ticked", "the loop's thread leaves by exit(2)",
           lambda bench: bench.drive.process.send_signal(signal.SIGUSR2), prepared=THREAD_ENDS),
    PinRow("SIGTERM", "operator", STOPPED, "SIGTERM: stopping", "a signal from outside",
           lambda bench: bench.drive.process.send_signal(signal.SIGTERM), exit_code=0),
    PinRow("SIGKILL", "operator", STOPPED, "the drive before this one", "a signal from outside",
           lambda bench: bench.drive.process.send_signal(signal.SIGKILL), exit_code=-9, told_later=True),
    PinRow("CPU starved", "host", CONTINUES, "", "4 busy processes of ordinary priority",
           _starve, exit_code=None, watch_s=3.0, starves=True),
    PinRow("disk full while logging", "host", CONTINUES, "the flight log cannot be written",
           "RLIMIT_FSIZE by prlimit", _fill_disk, exit_code=None, watch_s=2.0),
)  # fmt: skip


# ---- judging


def run_pin_row(bench: PinBench, fault: PinRow, gates: Gates) -> dict[str, Any]:
    """Inject a fault into a drive at speed, judge it, and return the row of metrics.faults.

    If this machine was too busy for the fault to be judged, it is repeated, up to ATTEMPTS times in all.
    """
    attempts, spoilt = 0, True
    while spoilt and attempts < ATTEMPTS:
        attempts += 1
        bench.at_speed(fault.prepared)
        seen, code, line = _inject(bench, fault)
        spoilt = _spoilt(fault, seen, gates)
    verdict = judge(fault.expected, seen, gates, human_us=fault.human_us)
    if code != fault.exit_code:
        verdict.wrong.append(f"rover drive ended with {code}, expected {fault.exit_code}")
    with contextlib.suppress(RoverError):  # then it is not recovered
        bench.at_speed()
    if fault.told_later:
        line = bench.drive.line_of(fault.message)
    more = {"attempts": attempts, "stalled_ms": round(seen.stalled_ms(), 1)}
    line = line and line.replace(f"{bench.folder}/", "")
    return row_of(fault, verdict, code, line, bench.driving, f"on pins: {fault.method}", **more)


def _inject(bench: PinBench, fault: PinRow) -> tuple[Observation, int | None, str | None]:
    """Inject a fault once. Returns what was seen, the drive's exit code, and the line that tells of the fault."""
    drive = bench.drive
    bench.events = bench.events[-2000:]
    drive.mark()
    at_s = time.monotonic()
    fault.inject(bench)
    bench.wait(fault.watch_s)
    end_s = time.monotonic()
    bench.wait(KNOWN_S)
    commands = [c for c in bench.cable.commands if at_s - 1 < c.at_s <= end_s]
    code = drive.process.poll() if fault.exit_code is None else drive.wait(END_S)
    line = None if fault.told_later else drive.line_of(fault.message)
    bench.clear_faults()
    return Observation(bench.events, commands, at_s, end_s), code, line


def _spoilt(fault: PinRow, seen: Observation, gates: Gates) -> bool:
    """Whether this machine had no time for the Arduino or the drive, so that there is nothing to judge."""
    if seen.stalled_ms() or not seen.was_driving(gates.throttle_max_us):
        return True
    return fault.expected == CONTINUES and not fault.starves and seen.longest_pause_s() > LATE_COMMAND_S


def run_on_pins(faults: Sequence[PinRow], gates: Gates) -> Iterator[dict[str, Any]]:
    """Yield a row for each fault. Raises RoverError if the bench does not drive, or without an emulator."""
    if faults:
        with PinBench() as bench:
            for fault in faults:
                yield run_pin_row(bench, fault, gates)

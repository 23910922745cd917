"""The bench for faults: `rover drive` runs as a process, with a camera, a cable and an Arduino that can be broken."""

import contextlib
import ctypes
import mmap
import os
import platform
import random
import re
import resource
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from balloon_world.car import CameraFeed
from balloon_world.child_process import Child
from balloon_world.simulated_arduino import REST_US, PinEvent
from lab.arduino.emulator import CC, NICE, EmulatedArduino, compile_c
from lab.driving.cable import Cable
from lab.driving.pins import BEFORE_S, CAR, STOPPED_THROTTLE_US
from lab.driving.policy import PLAIN, RATE_HZ, make_artifact, pictures
from lab.driving.priority import boost, boost_priority
from lab.driving.rpicam_vid import install
from lab.driving.virtual_gamepad import GamepadHuman, VirtualGamepad
from rover_lib.onboard.drive.flight_log import LogError, read_log
from rover_lib.onboard.errors import RoverError

AT_SPEED_S = 0.6  # from the first throttle to the fault
START_S = 90.0  # a drive imports torch twice, which takes a third of a minute while four other processes are busy
END_S = 6.0
DISK_BYTES = 512 * 1024
UNHELD = "arming was refused|signal was lost"  # this machine had no time for the gamepad: nobody held it
CLOCK = Path(__file__).with_name("clock.c")


class FaultError(RoverError):
    """A fault cannot be injected or judged here."""


# ---- what runs inside the process of a drive


def _end_this_thread() -> None:
    # The system call exit ends only this thread.
    ctypes.CDLL(None).syscall({"x86_64": 60, "aarch64": 93}[platform.machine()], 0)


def _raise() -> None:
    raise RuntimeError("raised in the loop")


def _break_logger() -> None:
    from rover_lib.onboard.drive import flight_log as telemetry

    def broken(*_: Any) -> bytes:
        raise RuntimeError("raised in the logger")

    telemetry._line = broken  # type: ignore[assignment]  # this is the fault


# A drive waits for its human's gesture only if stdin is a terminal.
IN_TERMINAL = "import os, pty; kept, terminal = pty.openpty(); os.dup2(terminal, 0); "
INSIDE = {"end the loop's thread": _end_this_thread, "raise in the loop": _raise, "raise in the logger": _break_logger}


def on_signal(what: str) -> None:
    """Make SIGUSR2 do one of INSIDE from now on, in the main thread, which is the loop's."""
    signal.signal(signal.SIGUSR2, lambda *_: INSIDE[what]())


# ---- the commands


def rover_after(code: str) -> list[str]:
    """Return the program that is `rover` once that code has run in its process."""
    return [sys.executable, "-c", f"{code}from rover_lib.cli import main; main()"]


class RoverCommand(Child):
    """A `rover` command that runs beside this program.

    arguments: of the command. run: the program that runs it, `rover` itself if empty. env: variables in addition to
    this process's own.
    """

    def __init__(self, *arguments: object, run: Sequence[str] = (), env: Mapping[str, str] | None = None):
        run = run or (sys.executable, "-m", "rover_lib.cli")
        super().__init__(f"rover {arguments[0]}", *run, *arguments, error=FaultError, env=env)

    def wait_for_message(self, text: str) -> None:
        """Wait until the command prints `text` on stderr. Raises FaultError if it does not."""
        deadline = time.monotonic() + START_S
        while not any(text in line for line in self.errors()):
            self.check()
            if time.monotonic() > deadline:
                raise FaultError(f"{self.name} did not print {text!r}: {self.last_words()}", remedy="try it by hand")
            time.sleep(0.02)

    def wait_for_success(self) -> None:
        """Wait until the command ends. Raises FaultError if it does not, or if its exit code is not 0."""
        if (code := self.wait(START_S)) != 0:
            raise FaultError(f"{self.name} ended with {code}: {self.last_words()}", remedy="try it by hand")


class Drive(RoverCommand):
    """`rover drive` with the bench's artifact, camera and cable.

    start: how it is prepared: one of INSIDE; 'clock': bench.step_clock can set its clock; 'disk': its log is on
    bench.disk; 'csi': it reads the camera through rpicam-vid's stand-in; '': nothing of these.
    """

    arguments: tuple[str, ...] = ()  # further arguments of the command
    in_terminal = False  # whether it waits for the human's gesture, which takes a second and a half after a reset

    def __init__(self, bench: "DrivingBench", start: str):
        self.start = start
        self._marked = 0
        self._folder = bench.folder
        self.log = bench.disk / "flight.log" if start == "disk" else bench.folder / "flight.log"
        env: dict[str, str] = {}
        code = bench.inside + "from lab.driving.policy import obey_pictures; obey_pictures(); "
        if self.in_terminal:
            code += IN_TERMINAL
        if start in INSIDE:
            code += f"from {__name__} import on_signal; on_signal({start!r}); "
        run = rover_after(code)
        if start == "clock":
            env = {"LD_PRELOAD": str(bench.clock_library()), "CLOCK_STEP": str(bench.clock)}
        devices = bench.devices()
        if start == "csi":
            env = {"PATH": f"{install(bench.folder)}:{os.environ['PATH']}", "ROVER_CSI": str(bench.camera)}
            devices[1] = "csi"
        options = ["--film", "--hz", RATE_HZ, "--threads", 1, "--log", self.log, "--view", bench.view]
        super().__init__("drive", bench.artifact, *devices, *options, *self.arguments, run=run, env=env)

    def children(self) -> list[int]:
        """Return the ids of its child processes, the policy's and, with 'csi', the camera's."""
        children = []
        for status in Path("/proc").glob("[0-9]*/stat"):
            with contextlib.suppress(OSError):
                if int(status.read_text().rpartition(")")[2].split()[1]) == self.pid:
                    children.append(int(status.parent.name))
        return children

    def messages(self, since_s: float | None = None) -> list[str]:
        """Return the flight log's events since a time, then the lines of stderr since mark(); without a time, all.

        The bench's folder is removed from the lines, as its name is different each time.
        """
        events = []
        with contextlib.suppress(LogError):
            flight = read_log(self.log)
            start_s = flight.header.get("start_monotonic_s", 0.0)
            events = [str(e) for e in flight.events if since_s is None or start_s + e.t_s >= since_s]
        lines = events + self.errors()[0 if since_s is None else self._marked :]
        return [line.replace(f"{self._folder}/", "") for line in lines]

    def mark(self) -> None:
        """Note that what it has printed on stderr until now is from before the fault."""
        self._marked = len(self.errors())


class PatientDrive(Drive):
    """A drive in a terminal: it waits for a human's gesture."""

    in_terminal = True


# ---- the bench


class DrivingBench:
    """An Arduino, a camera, a cable, and the drive that uses them; a context manager. undo: what ends the fault."""

    def __init__(self) -> None:
        self._stack = contextlib.ExitStack()
        self.undo = contextlib.ExitStack()
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
        self.view = self.folder / "view"
        self.events: list[PinEvent] = []
        self.rng = random.Random(0)
        self._pictures = {instruction: pictures(instruction) for instruction in range(7)}
        self._drive: Drive | None = None
        try:
            self.arduino = self._stack.enter_context(EmulatedArduino(transmitter=REST_US, nice=NICE, human=CAR.human))
            boost(self.arduino.pid)
            self.human: EmulatedArduino | GamepadHuman = self.arduino
            if CAR.human == "gamepad":
                pad = self._stack.enter_context(VirtualGamepad(self.folder))
                self.human = self._stack.enter_context(GamepadHuman(pad, lambda: self.cable.status))
            self.cable = Cable(self.arduino.port)
            self.feed = CameraFeed(self.camera, *self._pictures[PLAIN])
            self._stack.enter_context(boost_priority())
        except BaseException:
            self._stack.close()
            raise
        self._stack.callback(self._disconnect)

    def __enter__(self) -> "DrivingBench":
        return self

    def __exit__(self, *exc: object) -> None:
        self.undo.close()
        self.end_drive()
        self._stack.close()

    @property
    def drive(self) -> Drive:
        """The present drive, or the last one."""
        assert self._drive is not None, "at_speed() comes first"
        return self._drive

    @property
    def inside(self) -> str:
        """The code that plugs the bench's gamepad, if it has one, into a `rover` command's process."""
        if CAR.human == "receiver":
            return ""
        return f"from lab.driving.virtual_gamepad import plug_in; plug_in({str(self.folder)!r}); "

    def wait(self, seconds: float) -> None:
        """Let time pass, and read the pins meanwhile."""
        end = time.monotonic() + seconds
        while True:
            self.events += self.arduino.pulses()
            if (left := end - time.monotonic()) <= 0:
                return
            time.sleep(min(left, 0.1))

    def devices(self) -> list[str]:
        """Return the options that give a `rover` command the bench's camera and port."""
        return ["--camera", str(self.camera), "--port", self.cable.port]

    def show(self, instruction: int) -> None:
        """Let the camera see pictures with that instruction from its next frame on."""
        self.feed.show(*self._pictures[instruction])

    def at_speed(self, start: str = "") -> None:
        """Make sure that a drive with this start has been driving for a while: the present one if it fits, or a new."""
        if self._drive and self._drive.running and self._drive.start == start:
            self.wait(AT_SPEED_S)
            if self.driving:
                return
        self.restart(start)

    def clear_faults(self) -> None:
        """End all faults that a drive which goes on would notice."""
        self.undo.close()
        self.cable.to_arduino = self.cable.to_host = None
        self.feed.late_s = 0.0
        self.show(PLAIN)
        self.human.transmitter(*REST_US)

    def restart(self, start: str = "") -> None:
        """Start a new drive, and wait until it has been driving for a while."""
        drive = self.start(start, make=PatientDrive)
        deadline = time.monotonic() + START_S
        first_s = None  # the time of its first command
        while first_s is None or time.monotonic() - first_s < AT_SPEED_S or not self.driving:
            self.wait(0.02)
            if first_s is None and self.cable.commands:
                first_s = self.cable.commands[0].at_s
            if self.human is not self.arduino and not drive.running and re.search(UNHELD, drive.last_words()):
                drive, first_s = self.start(start, make=PatientDrive), None
            if not drive.running or time.monotonic() > deadline:
                raise FaultError(
                    f"rover drive did not drive within {START_S:g} s: {drive.last_words()}", remedy="drive it by hand"
                )
        self.human.ready(False)  # from here on the human only does what a fault says

    def start(
        self,
        start: str = "",
        fault: Callable[["DrivingBench"], object] = lambda bench: None,
        make: type[Drive] = Drive,
    ) -> Drive:
        """Start a new drive, with a fault that is injected before. make: the class of the drive."""
        self.end_drive()
        self.repair()
        self.human.ready(True)
        fault(self)
        self._drive = make(self, start)
        return self._drive

    def repair(self) -> None:
        """Restore everything that was broken: end all faults, and plug in a new camera and a new cable."""
        self.clear_faults()
        self._disconnect()
        if isinstance(self.human, GamepadHuman):
            self.human.pad.plug()
        self.feed = CameraFeed(self.camera, *self._pictures[PLAIN])
        self.cable = Cable(self.arduino.port)

    def end_drive(self) -> None:
        if self._drive:
            self._drive.close()
            self._drive = None

    def signal(self, number: int) -> None:
        self.drive.process.send_signal(number)

    def signal_children(self, number: int, name: str = "") -> None:
        """Signal the drive's child processes, of which one has `name` in its command line."""
        for pid in self.drive.children():
            if name in Path(f"/proc/{pid}/cmdline").read_text():
                os.kill(pid, number)

    def step_clock(self, seconds: int) -> None:
        """Step the system's clock as a drive that was started with 'clock' sees it."""
        with self.clock.open("r+b") as file, mmap.mmap(file.fileno(), 8) as step:
            struct.pack_into("q", step, 0, struct.unpack_from("q", step)[0] + seconds)

    def fill_disk(self) -> None:
        """Let rover drive write no more to its files on `disk`, until this is undone."""
        if self._own_disk:
            filling = self.disk / "filling"
            self.undo.callback(filling.unlink)
            with filling.open("wb", buffering=0) as file, contextlib.suppress(OSError):
                while file.write(bytes(4096)):
                    pass
        else:
            limits = resource.prlimit(self.drive.pid, resource.RLIMIT_FSIZE, (4096, resource.RLIM_INFINITY))
            self.undo.callback(resource.prlimit, self.drive.pid, resource.RLIMIT_FSIZE, limits)

    def clock_library(self) -> Path:
        """Return the library for LD_PRELOAD that lets step_clock() set a drive's clock; compile it if necessary."""
        library = self.folder / "clock.so"
        if not library.exists():
            compile_c(*CC, "-shared", "-fPIC", "-o", library, CLOCK)
        return library

    def _disconnect(self) -> None:
        self.feed.close()
        self.cable.unplug()

    @property
    def driving(self) -> bool:
        """Whether each of the latest throttle pulses moves the car."""
        since_s = time.monotonic() - BEFORE_S
        latest = [e.pulse_us for e in self.events[-2000:] if e.pin == "throttle" and e.end_s > since_s]
        return bool(latest) and min(latest) > STOPPED_THROTTLE_US

    def _make_disk(self) -> Callable[[], object]:
        """Mount a small disk at `disk`, if this user may; return a function that unmounts it."""
        mount = ["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "tmpfs", str(self.disk)]
        own = os.geteuid() == 0 and subprocess.run(mount, capture_output=True).returncode == 0
        self.disk_is = "a small tmpfs is filled" if own else "RLIMIT_FSIZE by prlimit, as this user may mount no disk"
        self._own_disk = own
        return lambda: own and subprocess.run(["umount", "--lazy", self.disk], check=True)

"""Get what every emulated Pi needs from this machine: root, Debian packages, aarch64 programs, control groups."""

import contextlib
import fcntl
import os
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from lab.arduino import emulator as arduino
from lab.debian import install_packages, missing_packages
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.signal_event import signals
from rover_lib.workshop.cache import cache_root
from rover_lib.workshop.run_program import run

NEEDS = {  # commands, each with its Debian package
    "systemd-nspawn": "systemd-container",
    "qemu-aarch64-static": "qemu-user-static",
    "ssh": "openssh-client",
    "nsenter": "util-linux",
}
BINFMT = Path("/proc/sys/fs/binfmt_misc")
BINFMT_NAME = "rover-aarch64"
# How to recognize an ELF file for aarch64. Of the flags in _register(), P keeps argv[0], F lets the interpreter be
# outside of the container, and C gives setuid programs such as sudo their rights.
MAGIC = r"\x7f\x45\x4c\x46\x02\x01\x01\x00\x00\x00\x00\x00\x00\x00\x00\x00\x02\x00\xb7\x00"
MASK = r"\xff\xff\xff\xff\xff\xff\xff\x00\xff\xff\xff\xff\xff\xff\xff\xff\xfe\xff\xff\xff"
INTERPRETERS = ("/usr/libexec/qemu-binfmt/aarch64-binfmt-P", "/usr/bin/qemu-aarch64-static")
RIGHTS = "is this a container without rights?"


class EmulationError(RoverError):
    """An emulated Pi cannot be made, started or asked here."""


def require() -> None:
    """Make sure that this is root, and install what is missing of NEEDS. Raises EmulationError or DebianError."""
    make_sure(missing_packages(NEEDS), "an emulated Pi", "an emulated Pi mounts file systems and starts a container")


def require_arduino() -> None:
    """Install what the emulated Arduino lacks here. Raises DebianError if that is not possible."""
    install_packages(arduino.missing_packages(), "the emulated Arduino")


def make_sure(missing: list[str], what: str, why: str, error: type[RoverError] = EmulationError) -> None:
    """Make sure that this is root, and install the Debian packages that `what` lacks here. why: what root is for.

    Raises `error` without root, and DebianError for packages that cannot be installed.
    """
    if os.geteuid() != 0:
        packages = f" (and of the Debian packages {' '.join(missing)})" if missing else ""
        raise error(f"{why}, which needs root{packages}: use sudo")
    install_packages(missing, what)


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the block as ^C does, so that everything in it is cleaned up."""

    def on_signal(number: int, frame: object) -> None:
        raise KeyboardInterrupt(signal.Signals(number).name)

    with signals(on_signal):
        yield


def free_port() -> int:
    """Return a free port of the loopback."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


@contextlib.contextmanager
def emulation() -> Iterator[None]:
    """Let the kernel run aarch64 programs. The last process that needs this removes what was registered."""
    cache_root().mkdir(parents=True, exist_ok=True)
    with (cache_root() / "emulation.lock").open("w") as lock:
        mounted = _mount_binfmt()
        fcntl.flock(lock, fcntl.LOCK_SH)
        try:
            if not (BINFMT / BINFMT_NAME).exists():
                _register()
            yield
        finally:
            with contextlib.suppress(BlockingIOError):  # another process of ours still needs it
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                with contextlib.suppress(OSError):
                    (BINFMT / BINFMT_NAME).write_text("-1")
                if mounted:
                    subprocess.run(["umount", BINFMT], capture_output=True)


def wait_for(condition: Callable[[], object], within_s: float, every_s: float = 0.2) -> bool:
    """Wait until the condition is true; return whether that happened in time."""
    end = time.monotonic() + within_s
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(every_s)
    return True


def _mount_binfmt() -> bool:
    if (BINFMT / "register").exists():
        return False
    remedy = "this kernel runs no foreign programs (binfmt_misc)"
    run("mount", "-t", "binfmt_misc", "binfmt_misc", BINFMT, error=EmulationError, remedy=remedy)
    return True


def _register() -> None:
    interpreter = next((i for i in INTERPRETERS if Path(i).exists()), None)
    if not interpreter:
        raise EmulationError(f"none of {', '.join(INTERPRETERS)}", remedy="sudo apt-get install qemu-user-static")
    try:
        (BINFMT / "register").write_text(f":{BINFMT_NAME}:M::{MAGIC}:{MASK}:{interpreter}:POCF")
    except FileExistsError:  # another process was first
        pass
    except OSError as error:
        raise EmulationError(f"the kernel takes no emulator: {error}", remedy=RIGHTS) from None


@contextlib.contextmanager
def in_cgroup(name: str) -> Iterator[Callable[[], None]]:
    """Make a control group, and give a function with which a process enters it before it executes its program.

    Without groups, the systemds of two containers would take each other's processes for their own. Afterwards the group
    is removed, and what is left in it is killed. Of cgroup v1's controllers only that of devices is used, which
    DevicePolicy= needs; its cpu controller admits no real-time processes.
    """
    mounts = [line.split() for line in Path("/proc/self/mounts").read_text().splitlines()]
    used = {"name=systemd", "devices"}
    folders = [
        Path(m[1], name) for m in mounts if m[2] == "cgroup2" or (m[2] == "cgroup" and used & {*m[3].split(",")})
    ]
    try:
        for folder in folders:
            folder.mkdir(exist_ok=True)
    except OSError as error:
        _remove_cgroups(folders)
        raise EmulationError(f"no control group can be made: {error}", remedy=RIGHTS) from None

    def enter() -> None:
        for folder in folders:
            (folder / "cgroup.procs").write_text("0")

    try:
        yield enter
    finally:
        _remove_cgroups(folders)


def _remove_cgroups(folders: list[Path], tries: int = 100) -> None:
    """Kill what is in the groups, and remove them with those below them. Raises nothing."""
    for _ in range(tries):
        left = [f for folder in folders for f in sorted(folder.glob("**/"), reverse=True)]
        for folder in left:
            with contextlib.suppress(OSError, ValueError):
                for pid in map(int, (folder / "cgroup.procs").read_text().split()):
                    os.kill(pid, signal.SIGKILL)
            with contextlib.suppress(OSError):
                folder.rmdir()
        if not any(folder.exists() for folder in folders):
            return
        time.sleep(0.05)

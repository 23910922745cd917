"""Get what an emulated Pi needs from this machine: root, Debian packages, aarch64 programs, control groups."""

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from lab.arduino import emulator as arduino
from lab.debian import install_packages, missing_packages
from rover_lib.onboard.errors import RoverError
from rover_lib.workshop.run_program import run

NEEDS = {  # commands, each with its Debian package
    "mmdebstrap": "mmdebstrap",
    "systemd-nspawn": "systemd-container",
    "qemu-aarch64-static": "qemu-user-static",
    "ssh": "openssh-client",
}
BINFMT = Path("/proc/sys/fs/binfmt_misc")
BINFMT_NAME = "rover-aarch64"
# An ELF file for aarch64. Of the flags in emulation(), P keeps argv[0], F lets the interpreter be outside of the
# container, and C gives setuid programs such as sudo their rights.
MAGIC = r"\x7f\x45\x4c\x46\x02\x01\x01\x00\x00\x00\x00\x00\x00\x00\x00\x00\x02\x00\xb7\x00"
MASK = r"\xff\xff\xff\xff\xff\xff\xff\x00\xff\xff\xff\xff\xff\xff\xff\xff\xfe\xff\xff\xff"
INTERPRETERS = ("/usr/libexec/qemu-binfmt/aarch64-binfmt-P", "/usr/bin/qemu-aarch64-static")
RIGHTS = "is this a container without rights?"


def require() -> None:
    """Make sure that this is root and nothing is missing for a Pi and its Arduino. Raises RoverError."""
    if os.geteuid() != 0:
        raise RoverError("an emulated Pi mounts file systems and starts a container", remedy="use sudo")
    install_packages(missing_packages(NEEDS | arduino.NEEDS), "an emulated Pi")


@contextlib.contextmanager
def emulation() -> Iterator[None]:
    """Let the kernel run aarch64 programs. What was mounted or registered for this is removed afterwards."""
    interpreter = next((i for i in INTERPRETERS if Path(i).exists()), None)
    if not interpreter:
        raise RoverError(f"none of {', '.join(INTERPRETERS)}", remedy="sudo apt-get install qemu-user-static")
    with contextlib.ExitStack() as stack:
        if not (BINFMT / "register").exists():
            run("mount", "-t", "binfmt_misc", "binfmt_misc", BINFMT, error=RoverError, remedy=RIGHTS)
            stack.callback(lambda: subprocess.run(["umount", BINFMT], capture_output=True))
        ours = BINFMT / BINFMT_NAME
        if not ours.exists():
            try:
                (BINFMT / "register").write_text(f":{BINFMT_NAME}:M::{MAGIC}:{MASK}:{interpreter}:POCF")
            except OSError as error:
                raise RoverError(f"the kernel takes no emulator: {error}", remedy=RIGHTS) from None
            stack.callback(ours.write_text, "-1")
        yield


@contextlib.contextmanager
def in_cgroup(name: str) -> Iterator[Callable[[], None]]:
    """Make a control group, and give a function with which a process enters it before it executes its program.

    Afterwards what is left in the group is killed. Of cgroup v1's controllers only that of devices is used, which
    DevicePolicy= needs; its cpu controller admits no real-time processes.
    """
    used = {"name=systemd", "devices"}
    folders = []
    for line in Path("/proc/self/mounts").read_text().splitlines():
        _, place, kind, options, *_ = line.split()
        if kind == "cgroup2" or (kind == "cgroup" and used & {*options.split(",")}):
            folders.append(Path(place, name))
    try:
        for folder in folders:
            folder.mkdir(exist_ok=True)

        def enter() -> None:
            for folder in folders:
                (folder / "cgroup.procs").write_text("0")

        yield enter
    except OSError as error:
        raise RoverError(f"no control group can be made: {error}", remedy=RIGHTS) from None
    finally:
        _remove_cgroups(folders)


def _remove_cgroups(folders: list[Path]) -> None:
    """Kill what is in the groups, and remove them with those below them. Raises nothing."""
    for _ in range(100):
        for group in [g for folder in folders for g in sorted(folder.glob("**/"), reverse=True)]:
            with contextlib.suppress(OSError):
                for pid in (group / "cgroup.procs").read_text().split():
                    os.kill(int(pid), signal.SIGKILL)
            with contextlib.suppress(OSError):
                group.rmdir()
        if not any(folder.exists() for folder in folders):
            return
        time.sleep(0.05)

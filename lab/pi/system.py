"""Debian arm64 as a freshly flashed Raspberry Pi OS Lite has it, for the emulated Pis: built once, then cached.

    with emulation():
        system().root      # /etc, /usr, ... of the Pi, owned by root; never written to

The packages are this machine's own Debian's (12 or 13), fetched by a private apt. dpkg unpacks them natively, which
under emulation takes minutes; only what they do when they are configured is emulated. Nothing is in it that
provision.yml has to install.
"""

import contextlib
import fcntl
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from lab.arduino import emulator as arduino
from lab.debian import fetch_packages, install_packages
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.watch import signals
from rover_lib.workshop.cache import cache_root, cached_folder, key_of

NEEDS = {  # command: its Debian package
    "systemd-nspawn": "systemd-container",
    "qemu-aarch64-static": "qemu-user-static",
    "ssh": "openssh-client",
    "nsenter": "util-linux",
}
USER, HOST_NAME = "pi", "raspberrypi"
PACKAGES = (
    *("?essential", "?priority(^required$)", "debian-archive-keyring", "ca-certificates"),
    *("systemd", "systemd-sysv", "dbus", "udev", "libpam-systemd", "kmod", "procps"),
    *("openssh-server", "sudo", "python3", "python3-apt", "iproute2", "netbase", "less"),
)
RECIPE = 1  # one more when it is made in another way: older ones are then not used
FIRST = "base-passwd"  # whose users and groups the other packages' scripts ask for
FORCE = ("architecture", "depends", "overwrite", "unsafe-io")
GROUPS = "adm,dialout,cdrom,sudo,audio,video,plugdev,games,users,input,render,netdev"  # of Raspberry Pi OS's user
CONFIGURE = f"""set -e
dpkg --configure --pending --force-depends
for group in {GROUPS.replace(",", " ")}; do getent group $group > /dev/null || groupadd --system $group; done
useradd --create-home --shell /bin/bash --groups {GROUPS} {USER}
"""
BINFMT = Path("/proc/sys/fs/binfmt_misc")
BINFMT_NAME = "rover-aarch64"
# An ELF file for aarch64. P: keeps argv[0]. F: the interpreter need not be in the container. C: setuid programs, sudo,
# get their rights.
MAGIC = r"\x7f\x45\x4c\x46\x02\x01\x01\x00\x00\x00\x00\x00\x00\x00\x00\x00\x02\x00\xb7\x00"
MASK = r"\xff\xff\xff\xff\xff\xff\xff\x00\xff\xff\xff\xff\xff\xff\xff\xff\xfe\xff\xff\xff"
INTERPRETERS = ("/usr/libexec/qemu-binfmt/aarch64-binfmt-P", "/usr/bin/qemu-aarch64-static")


class EmulationError(RoverError):
    """An emulated Pi that cannot be made, started or asked here."""


class System(NamedTuple):
    """root: the file system. key: the private ssh key of its user, USER, who may use sudo without a password."""

    root: Path
    key: Path


def missing_packages() -> list[str]:
    """Debian packages that an emulated Pi needs and this machine lacks."""
    return sorted({package for command, package in NEEDS.items() if not shutil.which(command)})


def require() -> None:
    """Makes sure of root and of NEEDS, which are installed. Raises EmulationError."""
    make_sure(missing_packages(), "an emulated Pi", "an emulated Pi mounts file systems and starts a container")


def require_arduino() -> None:
    """Installs what the emulated Arduino lacks here. Raises DebianError where that cannot be."""
    install_packages(arduino.missing_packages(), "the emulated Arduino")


def make_sure(missing: list[str], what: str, why: str, error: type[RoverError] = EmulationError) -> None:
    """Of root, and of Debian packages that `what` lacks here, which are installed. why: what root is for.

    Raises `error` without root, DebianError for packages that cannot be installed.
    """
    if os.geteuid() != 0:
        packages = f" (and of the Debian packages {' '.join(missing)})" if missing else ""
        raise error(f"{why}, which needs root{packages}: use sudo")
    install_packages(missing, what)


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """SIGTERM and SIGHUP end what is inside as ^C does: everything is put away by its own doors."""

    def on_signal(number: int, frame: object) -> None:
        raise KeyboardInterrupt(signal.Signals(number).name)

    with signals(on_signal):
        yield


def free_port() -> int:
    """Of the loopback."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def system() -> System:
    """The Pi's file system and the key to it, from the cache or made now (two minutes, most of them emulated).

    Call it within emulation(). Raises EmulationError or DebianError, with what was not to be had.
    """
    recipe = {"made": [PACKAGES, CONFIGURE, RECIPE], "debian": _codename()}
    folder = cached_folder("pi-system", key_of(recipe), _make)
    return System(folder / "root", folder / "key")


@contextlib.contextmanager
def emulation() -> Iterator[None]:
    """Lets the kernel run aarch64 programs. What it registers is removed by the last process that needs it."""
    cache_root().mkdir(parents=True, exist_ok=True)
    with (cache_root() / "emulation.lock").open("w") as lock:
        mounted = _mount_binfmt()
        fcntl.flock(lock, fcntl.LOCK_SH)
        try:
            if not (BINFMT / BINFMT_NAME).exists():
                _register()
            yield
        finally:
            with contextlib.suppress(BlockingIOError):  # another one of ours is at work
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                with contextlib.suppress(OSError):
                    (BINFMT / BINFMT_NAME).write_text("-1")
                if mounted:
                    subprocess.run(["umount", BINFMT], capture_output=True)


def run(command: list[Any], what: str, **options: Any) -> str:
    """Run a command, return its stdout. Raises EmulationError: `what`, and the end of its complaint."""
    try:
        done = subprocess.run([str(c) for c in command], capture_output=True, text=True, **options)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise EmulationError(f"{what}: {error}") from None
    if done.returncode:
        said = " ".join((done.stderr or done.stdout).split())[-400:] or f"exit code {done.returncode}"
        raise EmulationError(f"{what}: {said}")
    return done.stdout


def _mount_binfmt() -> bool:
    if (BINFMT / "register").exists():
        return False
    run(["mount", "-t", "binfmt_misc", "binfmt_misc", BINFMT], "this kernel runs no foreign programs (binfmt_misc)")
    return True


def _register() -> None:
    interpreter = next((i for i in INTERPRETERS if Path(i).exists()), None)
    if not interpreter:
        raise EmulationError(f"none of {', '.join(INTERPRETERS)}: sudo apt-get install qemu-user-static")
    try:
        (BINFMT / "register").write_text(f":{BINFMT_NAME}:M::{MAGIC}:{MASK}:{interpreter}:POCF")
    except FileExistsError:  # another process was first
        pass
    except OSError as error:
        raise EmulationError(f"the kernel takes no emulator ({error}); is this a container without rights?") from None


def _codename() -> str:
    try:
        told = dict(line.split("=", 1) for line in Path("/etc/os-release").read_text().splitlines() if "=" in line)
    except OSError:
        told = {}
    if told.get("ID") != "debian" or not shutil.which("dpkg"):
        found = told.get("PRETTY_NAME", "something else").strip('"')
        raise EmulationError(
            f"the emulated Pi's packages come by the apt sources of a Debian 12 or 13, here is {found}"
        )
    return told["VERSION_CODENAME"]


def _make(folder: Path) -> None:
    folder.chmod(0o755)
    root = folder / "root"
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".apt.") as scratch:
        packages = fetch_packages(Path(scratch), PACKAGES)
        _unpack(root, packages)
    run(
        ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "emulated Pi", "-f", folder / "key"],
        "no ssh key can be made",
    )
    with _no_services(root):
        environment = ["--setenv=DEBIAN_FRONTEND=noninteractive", "--setenv=LC_ALL=C.UTF-8"]
        chroot = ["systemd-nspawn", "--quiet", "--register=no", "--keep-unit", f"--machine=rover-make-{os.getpid()}"]
        chroot += ["--timezone=off", "--resolv-conf=off", "--link-journal=no"]
        with in_cgroup(f"rover-make-{os.getpid()}") as enter:
            run(
                [*chroot, *environment, f"--directory={root}", "/bin/sh", "-c", CONFIGURE],
                "the emulated Pi's packages cannot be configured",
                preexec_fn=enter,
            )
    _personalize(root, (folder / "key.pub").read_text())


def _unpack(root: Path, packages: list[Path]) -> None:
    """All files, so that the packages' scripts have what they call, and then by dpkg, so that it knows of them."""
    (root / "usr").mkdir(parents=True)
    root.chmod(0o755)
    for name in ("bin", "sbin", "lib"):
        (root / "usr" / name).mkdir()
        (root / name).symlink_to(f"usr/{name}")
    for package in packages:
        what = f"{package.name} cannot be unpacked"
        with subprocess.Popen(["dpkg-deb", "--fsys-tarfile", package], stdout=subprocess.PIPE) as tar:
            run(["tar", "-x", "-C", root, "--keep-directory-symlink"], what, stdin=tar.stdout)
        if tar.returncode:
            raise EmulationError(f"{what}: dpkg-deb ended with {tar.returncode}")
    status = root / "var" / "lib" / "dpkg"
    for name in ("info", "updates"):
        (status / name).mkdir(parents=True, exist_ok=True)
    for name in ("status", "available"):
        (status / name).touch()
    (root / "etc" / "dpkg" / "dpkg.cfg.d").mkdir(parents=True, exist_ok=True)
    (root / "etc" / "dpkg" / "dpkg.cfg.d" / "emulated").write_text("force-unsafe-io\n")  # a cache loses nothing
    forced = [f"--force-{what}" for what in FORCE]
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive", "LC_ALL": "C.UTF-8"}
    for part in ([p for p in packages if p.name.startswith(f"{FIRST}_")], packages):
        command = ["dpkg", f"--root={root}", "--log=/dev/null", *forced, "--unpack", *part]
        run(command, "dpkg cannot unpack the emulated Pi's packages", env=environment)


@contextlib.contextmanager
def _no_services(root: Path) -> Iterator[None]:
    policy = root / "usr" / "sbin" / "policy-rc.d"
    policy.write_text("#!/bin/sh\nexit 101\n")
    policy.chmod(0o755)
    yield
    policy.unlink()


def _personalize(root: Path, public_key: str) -> None:
    """What Raspberry Pi Imager writes: a name, a user with a key, and sudo without a password."""
    (root / "etc" / "hostname").write_text(f"{HOST_NAME}\n")
    (root / "etc" / "hosts").write_text(f"127.0.0.1\tlocalhost\n127.0.1.1\t{HOST_NAME}\n")
    (root / "etc" / "machine-id").write_text("")  # each boot of a copy makes its own
    sudoers = root / "etc" / "sudoers.d" / "010_pi-nopasswd"
    sudoers.write_text(f"{USER} ALL=(ALL) NOPASSWD: ALL\n")
    sudoers.chmod(0o440)
    home = root / "home" / USER
    (home / ".ssh").mkdir(mode=0o700)
    keys = home / ".ssh" / "authorized_keys"
    keys.write_text(public_key)
    keys.chmod(0o600)
    owner = home.stat()
    for path in (home / ".ssh", keys):
        os.chown(path, owner.st_uid, owner.st_gid)


@contextlib.contextmanager
def in_cgroup(name: str) -> Iterator[Callable[[], None]]:
    """A control group of its own, for a process to enter before it becomes something else.

    Without one, the systemds of two containers would take each other's processes for theirs. It is removed afterwards,
    with what is left in it killed. Of cgroup v1's controllers none: its cpu lets nobody in who is real-time.
    """
    mounts = [line.split() for line in Path("/proc/self/mounts").read_text().splitlines()]
    folders = [Path(m[1], name) for m in mounts if m[2] == "cgroup2" or (m[2] == "cgroup" and "name=" in m[3])]
    try:
        for folder in folders:
            folder.mkdir(exist_ok=True)
    except OSError as error:
        remove_cgroups(folders)
        raise EmulationError(f"no control group can be made ({error}); is this a container without rights?") from None

    def enter() -> None:
        for folder in folders:
            (folder / "cgroup.procs").write_text("0")

    try:
        yield enter
    finally:
        remove_cgroups(folders)


def remove_cgroups(folders: list[Path], tries: int = 100) -> None:
    """Kills what is in them and removes them, with those below. Raises nothing."""
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

"""Emulate a whole Pi in QEMU: four Cortex-A76, a kernel of its own, systemd, sshd, a camera and USB.

    with Machine(card(), folder, slow=20) as pi:
        pi.wait_for_ssh()
        pi.ssh("uname -a")
        pi.plug(arduino.port)

Nothing on the host is changed: ssh is on a port of the loopback, the machine reaches no network, and what it writes
goes to a file of its own that lies over the card, which stays as it was.

The machine is many times slower than a Pi. So its clock runs `slow` times slower than the host's: the device tree
tells its kernel that the counter of all its clocks and timers counts `slow` times faster than it does. Then a rate of
30 Hz, a watchdog's 2 s and an Arduino's 150 ms (slowed down alike) have the same proportion to its speed as on a Pi,
and the rover's code needs no other times. A second of the machine takes `slow` seconds here.
"""

import asyncio
import contextlib
import ctypes
import gzip
import logging
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Coroutine, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qemu.qmp import ExecuteError, QMPClient, QMPError

from lab.debian import fetch_packages, missing_packages, unpack_packages, which
from lab.pi.debian_image import USER, DebianImage, debian_image
from lab.pi.emulation import emulation, free_port, make_sure
from rover_lib.onboard.errors import RoverError
from rover_lib.workshop.cache import cache_folder, key_of
from rover_lib.workshop.run_program import last_words, run

PACKAGES = {  # commands, each with the Debian package that it comes from
    "qemu-system-aarch64": "qemu-system-arm",
    "qemu-img": "qemu-utils",
    "mke2fs": "e2fsprogs",
    "depmod": "kmod",
    "cpio": "cpio",
    "fdtput": "device-tree-compiler",
    "ssh": "openssh-client",
}
RECIPE = 1  # raise it when the card is made in another way, so that older ones are not used
CARD_GB = 6  # the file is sparse, so it takes only as much as is in it
MEMORY_MB, CORES, CPU = 3072, 4, "cortex-a76"
TIMER_HZ = 62_500_000  # the counter's frequency of QEMU's Cortex-A76
SLOWEST = 60  # the device tree has only 32 bits for the frequency
DEBS = "/var/lib/rover-debs"  # on the card: the Debian packages that a rover without internet must have
ROVER_PACKAGES = ("python3-venv", "python3-packaging", "avrdude", "v4l-utils")  # as roles/rover/tasks/system.yml
KERNEL_PACKAGES = ("linux-image-arm64", "busybox-static")
# Only those of the kernel's modules that the machine has devices for.
MODULES = (
    *("fs", "lib", "crypto", "arch", "net/core", "net/packet", "net/ipv6", "net/unix"),
    *("drivers/virtio", "drivers/block", "drivers/net/virtio_net.ko", "drivers/net/net_failover.ko", "drivers/char"),
    *("drivers/usb", "drivers/media", "drivers/video", "drivers/i2c"),
)
FIRST_MODULES = ("virtio_pci", "virtio_blk", "virtio_net", "virtio_rng", "ext4", "crc32c_generic")
INIT = """#!/bin/busybox sh
B=/bin/busybox
$B mount -t proc p /proc; $B mount -t sysfs s /sys; $B mount -t devtmpfs d /dev
while read -r m; do $B insmod /m/$m; done < /m/order
n=0; while [ ! -b /dev/vda ] && [ $n -lt 100 ]; do $B sleep 0.1; n=$((n+1)); done
$B mount -t ext4 -o rw,noatime /dev/vda /new || { echo "no file system on the card"; $B poweroff -f; }
$B mount --move /dev /new/dev; $B mount --move /proc /new/proc; $B mount --move /sys /new/sys
exec $B switch_root /new /lib/systemd/systemd
"""
NETWORK = "[Match]\nName=e*\n[Network]\nDHCP=ipv4\nLinkLocalAddressing=no\nIPv6AcceptRA=no\n[DHCPv4]\nUseDNS=no\n"
# Units that need a network, or do work that nobody waits for.
MASKED = (
    *("apt-daily.timer", "apt-daily-upgrade.timer", "man-db.timer", "e2scrub_all.timer", "e2scrub_reap.service"),
    *("fstrim.timer", "dpkg-db-backup.timer", "systemd-networkd-wait-online.service", "systemd-timesyncd.service"),
)
ADAPTER, CAMERA = "adapter", "camera"  # what can be plugged in
KERNEL_LINE = "console=ttyAMA0 root=/dev/vda rw quiet mitigations=off systemd.show_status=0 audit=0"
BOOT_S = 600.0
OFF_S = 120.0
QMP_S = 30.0
PR_SET_PDEATHSIG = 1


class MachineError(RoverError):
    """The emulated machine cannot be made here, does not start, or does not do what it is told."""


# ---- the card


@dataclass(frozen=True)
class Card:
    """A card as flashed, with its file system, the kernel and initramfs that boot it, and the key to log in."""

    folder: Path

    kernel = property(lambda self: self.folder / "vmlinuz")
    initramfs = property(lambda self: self.folder / "initramfs.gz")
    disk = property(lambda self: self.folder / "card.ext4")
    key = property(lambda self: self.folder / "id")


def card() -> Card:
    """Return the card with Debian on it, from the cache or made now, which takes a minute more than debian_image().

    Missing Debian packages are installed. Raises RoverError if no card can be made; it needs root.
    """
    why = "an emulated Pi's card is written with its owner's rights"
    make_sure(missing_packages(PACKAGES), "the emulated machine", why, MachineError)
    with emulation():
        flashed = debian_image()
    made = [RECIPE, CARD_GB, MODULES, FIRST_MODULES, INIT, NETWORK, MASKED, ROVER_PACKAGES, KERNEL_PACKAGES]
    key = key_of({"system": str(flashed.root), "made": made, "holds": "public key"})
    return Card(cache_folder("pi-card", key, lambda folder: _make_card(flashed, folder)))


def _make_card(flashed: DebianImage, folder: Path) -> None:
    made = Card(folder)
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".pi-card.") as scratch:
        work, root = Path(scratch), Path(scratch) / "root"
        _run("cp", "-a", "--reflink=auto", flashed.root, root)
        kernel, debs = work / "kernel", root / DEBS.lstrip("/")
        debs.mkdir(parents=True)
        for package in fetch_packages(work / "rover", ROVER_PACKAGES, flashed.root):
            shutil.move(package, debs)
        for package in fetch_packages(work / "linux", KERNEL_PACKAGES, flashed.root):
            if package.name.startswith(("linux-image-", "busybox-static_")):
                unpack_packages([package], kernel)
        version = next((kernel / "lib/modules").iterdir()).name
        shutil.copy(kernel / f"boot/vmlinuz-{version}", made.kernel)
        _modules(kernel, root, version)
        _initramfs(kernel / "bin/busybox", root, version, made.initramfs, work)
        _configure(root)
        shutil.copy(flashed.key, made.key)
        made.key.chmod(0o600)
        shutil.copy(f"{flashed.key}.pub", f"{made.key}.pub")  # deployments are signed with it
        # Without metadata checksums, for which the kernel would need modules before it has the card.
        options = ["-t", "ext4", "-E", "lazy_itable_init=1,lazy_journal_init=1", "-O", "^metadata_csum"]
        _run("mke2fs", "-q", *options, "-d", root, made.disk, f"{CARD_GB}G")


def _modules(kernel: Path, root: Path, version: str) -> None:
    source, target = kernel / "lib/modules" / version, root / "lib/modules" / version
    (target / "kernel").mkdir(parents=True)
    for file in (*source.glob("modules.builtin*"), source / "modules.order"):
        shutil.copy(file, target)
    for name in MODULES:
        if (found := source / "kernel" / name).is_dir():
            shutil.copytree(found, target / "kernel" / name, dirs_exist_ok=True)
        elif found.exists():
            (target / "kernel" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(found, target / "kernel" / name)
    _run("depmod", "--basedir", root, version)


def _initramfs(busybox: Path, root: Path, version: str, output: Path, scratch: Path) -> None:
    """Make an initramfs: a busybox that loads the modules needed to mount the card, and hands over to systemd."""
    tree = scratch / "initramfs"
    for name in ("bin", "proc", "sys", "dev", "new", "m"):
        (tree / name).mkdir(parents=True)
    shutil.copy(busybox, tree / "bin")
    (tree / "bin/sh").symlink_to("busybox")
    order: list[str] = []
    for module in FIRST_MODULES:
        shown = _run("modprobe", "--dirname", root, "--set-version", version, "--show-depends", module)
        for path in map(Path, re.findall(r"^insmod (\S+)", shown, re.MULTILINE)):
            if path.name not in order:
                order.append(path.name)
                shutil.copy(path, tree / "m")
    (tree / "m/order").write_text("".join(f"{name}\n" for name in order))
    (tree / "init").write_text(INIT)
    (tree / "init").chmod(0o755)
    names = "".join(f"{p.relative_to(tree)}\n" for p in (tree, *sorted(tree.rglob("*"))))
    archive = subprocess.run(
        ["cpio", "--create", "--format=newc", "--quiet"],
        cwd=tree,
        input=names.encode(),
        capture_output=True,
        check=True,
    )
    output.write_bytes(gzip.compress(archive.stdout, 1))


def _configure(root: Path) -> None:
    """Configure what the machine has and a container has not: file systems, network, host keys."""
    (root / "etc/fstab").write_text("/dev/vda / ext4 noatime 0 1\n")
    (root / "etc/systemd/network").mkdir(parents=True, exist_ok=True)
    (root / "etc/systemd/network/20-wired.network").write_text(NETWORK)
    units = root / "etc/systemd/system"
    (units / "multi-user.target.wants").mkdir(parents=True, exist_ok=True)
    for name, target in [
        ("multi-user.target.wants/systemd-networkd.service", "/lib/systemd/system/systemd-networkd.service"),
        *((name, "/dev/null") for name in MASKED),
    ]:
        (units / name).unlink(missing_ok=True)
        (units / name).symlink_to(target)
    for kind in ("ed25519", "rsa"):
        host_key = root / f"etc/ssh/ssh_host_{kind}_key"
        if not host_key.exists():
            _run("ssh-keygen", "-q", "-t", kind, "-N", "", "-C", "emulated Pi", "-f", host_key)


def _run(command: str, *arguments: object) -> str:
    """Run a program, also one in root's folders, which a user's PATH may lack; return its output."""
    return run(which(command) or command, *arguments, error=MachineError)


# ---- QEMU's monitor


logging.getLogger("qemu.qmp").addHandler(logging.NullHandler())  # it also raises what it logs


class Qmp:
    """QEMU's machine protocol on a Unix socket: commands with their answers, and events that QEMU reports."""

    def __init__(self, path: Path | str, timeout_s: float = QMP_S):
        self._timeout_s = timeout_s
        self._runner = asyncio.Runner()
        self._client = QMPClient()
        try:
            self._run(self._client.connect(str(path)))
        except BaseException:
            self._runner.close()
            raise

    def command(self, name: str, **arguments: object) -> object:
        """Send a command, and return QEMU's answer. Raises MachineError if QEMU refuses, or does not answer."""
        return self._run(self._client.execute(name, arguments))

    def wait_for(self, event: str, device: str) -> None:
        """Wait until QEMU has reported this event of a device. Raises MachineError if it does not."""

        async def wait() -> None:
            async for reported in self._client.events:
                data = reported.get("data")
                if reported["event"] == event and isinstance(data, dict) and data.get("device") == device:
                    return

        self._run(wait())

    def close(self) -> None:
        """End the connection. Raises nothing."""
        with contextlib.suppress(MachineError):
            self._run(self._client.disconnect())
        self._runner.close()

    def _run(self, conversation: Coroutine[Any, Any, Any]) -> Any:
        try:
            return self._runner.run(asyncio.wait_for(conversation, self._timeout_s))
        except ExecuteError as error:
            raise MachineError(f"QEMU refused {error.sent['execute']}: {error}") from None
        except (QMPError, OSError, EOFError, TimeoutError) as error:
            ended = "the console's log may say why, if it has ended"
            raise MachineError("QEMU does not answer", found=repr(error), remedy=ended) from None


# ---- the machine


class Machine:
    """A running emulated Pi; a context manager. name, port, key: for playbooks.run(), and to log in.

    card: what it boots from. folder: gets console.log, and its own disk, which is removed at the end. layer: the disk
    of an earlier machine on the same card, to start from instead of the card itself. slow: how many times slower than
    this host's its clock runs, 1 to 60. drives: more disks, which are read-only: /dev/vdb, /dev/vdc, ...
    """

    def __init__(
        self,
        card: Card,
        folder: Path | str,
        *,
        layer: Path | None = None,
        slow: float = 1.0,
        drives: Sequence[Path] = (),
    ):
        if not 1 <= slow <= SLOWEST:
            raise MachineError(f"the machine's clock can run 1 to {SLOWEST} times slower, found {slow:g}")
        self.card, self.slow = card, slow
        self.name, self.port, self.key = "rover-pi", free_port(), card.key
        self.folder = Path(folder)
        self.folder.mkdir(parents=True, exist_ok=True)
        self.console = self.folder / "console.log"
        self.disk = self.folder / "disk.qcow2"
        with contextlib.ExitStack() as stack:
            # Not in `folder`, as the paths of sockets must be short.
            self._work = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rover-pi-")))
            self._errors = stack.enter_context(tempfile.TemporaryFile())
            stack.callback(self.disk.unlink, missing_ok=True)
            base, kind = (layer, "qcow2") if layer else (card.disk, "raw")
            _run("qemu-img", "create", "-q", "-f", "qcow2", "-b", base.resolve(), "-F", kind, self.disk)
            stack.callback(self._log_out)
            self._process = self._start(drives)
            stack.callback(self._end)
            self._qmp = self._connect()
            stack.callback(self._quit)
            self._stack = stack.pop_all()

    def __enter__(self) -> "Machine":
        return self

    def __exit__(self, *exc: object) -> None:
        """Cut its power, and remove its disk. Raises nothing."""
        self._stack.close()

    def _start(self, drives: Sequence[Path]) -> subprocess.Popen:
        machine = ["-cpu", CPU, "-smp", str(CORES), "-m", str(MEMORY_MB), "-display", "none", "-nodefaults"]
        tree = self._work / "tree.dtb"
        _run("qemu-system-aarch64", "-machine", f"virt,dumpdtb={tree}", *machine)
        _run("fdtput", "-t", "u", tree, "/timer", "clock-frequency", round(TIMER_HZ * self.slow))
        command: list[object] = ["qemu-system-aarch64", "-machine", "virt", *machine]
        command += ["-accel", "tcg,thread=multi,tb-size=512", "-dtb", tree, "-append", KERNEL_LINE]
        command += ["-kernel", self.card.kernel, "-initrd", self.card.initramfs]
        # Nothing is synced to the host's disk: the disk of a machine that ends early is thrown away.
        disks = [(self.disk, "format=qcow2,cache=unsafe"), *((d, "format=raw,readonly=on") for d in drives)]
        for i, (file, options) in enumerate(disks):
            command += ["-drive", f"if=none,id=d{i},file={_comma(file)},{options}"]
            command += ["-device", f"virtio-blk-pci,drive=d{i},romfile="]
        # restrict: the machine reaches no network, as at a track; only its sshd can be reached.
        command += ["-netdev", f"user,id=n,restrict=on,hostfwd=tcp:127.0.0.1:{self.port}-:22"]
        for device in ("virtio-net-pci,netdev=n,romfile=", "virtio-rng-pci", "qemu-xhci,id=xhci"):
            command += ["-device", device]
        command += ["-serial", f"file:{_comma(self.console)}", "-qmp", f"unix:{self._work}/qmp,server=on,wait=off"]
        return subprocess.Popen(
            [str(word) for word in command],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
            start_new_session=True,  # so that a terminal's ^C does not reach it
            preexec_fn=_end_with_parent,
        )

    def _connect(self) -> Qmp:
        end = time.monotonic() + QMP_S
        while True:
            try:
                return Qmp(self._work / "qmp")
            except MachineError:
                self._check()
                if time.monotonic() > end:
                    raise
                time.sleep(0.05)

    def _check(self) -> None:
        if self._process.poll() is not None:
            self._errors.seek(0)
            last = last_words(self._errors.read().decode(errors="replace"))
            raise MachineError(f"QEMU has ended (exit code {self._process.returncode}): {last}")

    # -- ssh

    @property
    def ssh_options(self) -> list[str]:
        """The options for ssh, scp and Ansible, without the port."""
        return [
            *("-i", str(self.card.key), "-o", "IdentitiesOnly=yes", "-o", "BatchMode=yes", "-o", "LogLevel=ERROR"),
            *("-o", "StrictHostKeyChecking=no", "-o", "UserKnownHostsFile=/dev/null", "-o", "ConnectTimeout=60"),
            *("-o", "ControlMaster=auto", "-o", f"ControlPath={self._work}/ssh", "-o", "ControlPersist=120"),
        ]

    def wait_for_ssh(self, timeout_s: float = BOOT_S) -> float:
        """Wait until somebody can log in; return how many seconds that took. Raises MachineError if it takes longer."""
        start = time.monotonic()
        while time.monotonic() - start < timeout_s:
            self._check()
            with contextlib.suppress(MachineError, subprocess.TimeoutExpired):
                self.ssh("true", timeout_s=90)
                return time.monotonic() - start
            time.sleep(0.5)
        raise MachineError(f"no ssh within {timeout_s:g} s; the machine's console is in {self.console}")

    def ssh(self, command: str, *, timeout_s: float = 600, check: bool = True, text: str | None = None) -> str:
        """Run a shell command as the login user; return its stdout, followed by its stderr.

        text: for its stdin. Raises MachineError if it takes longer than timeout_s, or if it fails and check is set.
        """
        words = ["ssh", *self.ssh_options, "-p", str(self.port), f"{USER}@127.0.0.1", command]
        try:
            done = subprocess.run(
                words, capture_output=True, text=True, timeout=timeout_s, input=text or "", errors="replace"
            )
        except subprocess.TimeoutExpired:
            raise MachineError(f"'{command}' took more than {timeout_s:g} s in the emulated machine") from None
        if check and done.returncode:
            last = last_words(done.stderr or done.stdout)
            raise MachineError(f"'{command}' failed in the emulated machine ({done.returncode}): {last}")
        return done.stdout + done.stderr

    # -- USB

    def plug(self, port: Path | str) -> None:
        """Plug in a USB serial adapter (with an FTDI's ids), and connect a serial port of the host to it."""
        device = {"device": str(Path(port).resolve())}
        self._plug(ADAPTER, "usb-serial", {"type": "serial", "data": device})

    def plug_camera(self, socket: Path | str) -> None:
        """Plug in the USB device that speaks the usbredir protocol on a Unix socket."""
        address = {"type": "unix", "data": {"path": str(socket)}}
        self._plug(CAMERA, "usb-redir", {"type": "socket", "data": {"addr": address, "server": False}})

    def unplug(self, what: str = ADAPTER) -> None:
        """Pull out a device: ADAPTER or CAMERA."""
        self._qmp.command("device_del", id=what)
        self._qmp.wait_for("DEVICE_DELETED", device=what)
        if what == ADAPTER:  # usb-redir removes its character device itself
            self._qmp.command("chardev-remove", id=f"{what}-wire")

    def _plug(self, what: str, driver: str, backend: dict[str, Any]) -> None:
        self._qmp.command("chardev-add", id=f"{what}-wire", backend=backend)
        self._qmp.command("device_add", driver=driver, id=what, chardev=f"{what}-wire", bus="xhci.0")

    # -- the end

    def power_off(self, timeout_s: float = OFF_S) -> None:
        """Shut the system down, so that its disk can be a layer for others. Raises MachineError if it does not end."""
        with contextlib.suppress(MachineError):  # the connection ends with the system
            self.ssh("sudo sync; sudo systemctl poweroff", timeout_s=60)
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise MachineError(f"the machine was not off after {timeout_s:g} s; see {self.console}") from None

    def _quit(self) -> None:
        with contextlib.suppress(MachineError):
            self._qmp.command("quit")
        self._qmp.close()

    def _end(self) -> None:
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _log_out(self) -> None:
        with contextlib.suppress(OSError, subprocess.SubprocessError):
            options = [*self.ssh_options, "-p", str(self.port), f"{USER}@127.0.0.1"]
            subprocess.run(["ssh", "-O", "exit", *options], capture_output=True, timeout=10)


def _comma(path: Path) -> str:
    """Write a path for one of QEMU's options, in which a comma must be doubled."""
    return str(path.resolve()).replace(",", ",,")


def _end_with_parent() -> None:
    """Let QEMU, in whose process this runs, end with the thread that started it, even if that is killed."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)

"""An emulated Pi that is up in seconds: real systemd and sshd, aarch64 programs, kernel and network of this machine.

    with Container("rover1") as pi:
        pi.boot()
        pi.ssh("uname -m")                  # aarch64
        with VirtualCar(board=BOARD) as car:
            pi.plug(camera=car.camera, arduino=car.port)    # CAMERA and PORT in there
            ...
        pi.cut_power()
        pi.boot()

Its disk is a layer over the folders below it, which stay as they are: what one has installed, many can start from.

    pi.power_off()
    with Container("rover2", layers=pi.layers) as another: ...

Its systemd is this machine's own program, of the same version, and so real with all that a service's sandbox is made
of; all other programs are aarch64. What a container cannot have: a kernel of its own, so no udev, no V4L2 camera (a
FIFO of JPEGs stands in for it) and no time of its own; and what is written is with this machine's kernel at once, so
that a power cut ends all programs at one moment, but takes no unsynced write with it. The whole machine has all that.
"""

import ast
import contextlib
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from lab.pi.system import USER, EmulationError, emulation, free_port, in_cgroup, run, system
from rover_lib.workshop.cache import cache_root

BOOT_S = 180.0  # until sshd answers; 10 on two quiet cores
OFF_S = 60.0
KILL_S = 20.0
SSH_S = 30.0
BENCH, PTS = "/srv/bench", "/srv/pts"  # in the container: what is plugged in, and the host's pseudo terminals
CAMERA, PORT = f"{BENCH}/camera", "/dev/rover-arduino"
DIALOUT = 20  # Debian's number for the group
# The network is the host's, which has its own; and nothing begins to update itself while something is measured.
MASKED = ("systemd-networkd.service", "systemd-resolved.service", "apt-daily.timer", "apt-daily-upgrade.timer")
# Their own programs, which may make no memory executable: an emulator must.
TRANSLATED = ("systemd-journald", "systemd-logind", "systemd-hostnamed", "systemd-timedated", "systemd-localed")
SYSTEMD = Path("/usr/lib/systemd/systemd")
CERTIFICATES = Path("/etc/ssl/certs/ca-certificates.crt")


class Container:
    """One emulated Pi; a context manager, which leaves nothing behind.

    name: of the rover. root: its file system as it is now, on the host. port: of its sshd, on the loopback. key: the
    ssh key of its user. layers: for another container that starts from what this one has become, once it is off.
    """

    def __init__(self, name: str, *, layers: Sequence[Path] = (), nice: int = 0):
        """layers: folders with what is changed in the system, from the lowest to the highest. nice: priority of all
        its programs; -10 comes nearer to a Pi that has its processor for itself.
        """
        self.name = name
        self._nice = nice
        self.port = free_port()
        self._below = tuple(layers)
        self._process: subprocess.Popen | None = None
        self._leader = 0

    def __enter__(self) -> "Container":
        with contextlib.ExitStack() as stack:
            stack.enter_context(emulation())
            made = system()
            self.key = made.key
            # Not in /tmp, which may be in memory: torch alone has half a gigabyte.
            disk = Path(tempfile.mkdtemp(prefix=f".pi-{self.name}-", dir=cache_root()))
            stack.callback(shutil.rmtree, disk, ignore_errors=True)
            self._own = Path(tempfile.mkdtemp(prefix=f"rover-pi-{self.name}-"))
            stack.callback(shutil.rmtree, self._own, ignore_errors=True)
            self.bench = self._own / "bench"
            self.machine = f"rover-pi-{secrets.token_hex(4)}"
            for folder in ("upper", "work", "root"):
                (disk / folder).mkdir(mode=0o755)
            self.root, self._upper = disk / "root", disk / "upper"
            below = ":".join(str(p) for p in (*reversed(self._below), made.root))
            # redirect_dir: a folder of a layer below can be renamed, as on any disk.
            how = f"lowerdir={below},upperdir={self._upper},workdir={disk / 'work'},redirect_dir=on"
            run(
                ["mount", "-t", "overlay", self.machine, "-o", how, self.root],
                f"{cache_root()} cannot hold a layered file system; put ROVER_CACHE on a plain disk",
            )
            stack.callback(subprocess.run, ["umount", "--lazy", self.root], capture_output=True)
            self._enter_cgroup = stack.enter_context(in_cgroup(self.machine))
            stack.callback(_forget, self.machine)
            stack.callback(self.cut_power)
            self._configure()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stack.close()

    def close(self) -> None:
        """Ends it and removes all that it was."""
        self._stack.close()

    @property
    def layers(self) -> tuple[Path, ...]:
        """For another container, while this one is off and not closed."""
        return (*self._below, self._upper)

    @property
    def on(self) -> bool:
        """Whether it has power; it need not have booted yet, and may have failed."""
        return self._process is not None and self._process.poll() is None

    # Power

    def boot(self, *, within_s: float = BOOT_S) -> float:
        """Switches it on; seconds until sshd answers. Raises EmulationError with the last of its console if not."""
        if self.on:
            raise EmulationError(f"{self.name} is on already: cut its power, or power it off")
        started = time.monotonic()
        console = (self._own / "console.log").open("wb")
        command = ["systemd-nspawn", "--quiet", "--boot", "--register=no", "--keep-unit", "--link-journal=no"]
        command += [f"--machine={self.machine}", f"--hostname={self.name}", f"--directory={self.root}"]
        command += ["--capability=CAP_SYS_RESOURCE"]  # for limits, of which one is the drive loop's real-time priority
        command += ["--resolv-conf=replace-host", "--timezone=off", "--console=pipe"]
        command += [f"--bind={self.bench}:{BENCH}", f"--bind=/dev/pts:{PTS}"]
        with console:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=console,
                stderr=subprocess.STDOUT,
                preexec_fn=self._enter,
                start_new_session=True,  # a terminal's ^C is for this program, which then stops in order
            )
        while True:
            if not self.on:
                raise EmulationError(f"{self.name} did not boot, its console's last: {self._console()}")
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", self.port), 5) as s:
                s.settimeout(10)
                if s.recv(4) == b"SSH-":
                    break
            if time.monotonic() > started + within_s:
                said = self._console()
                self.cut_power()
                raise EmulationError(f"{self.name} has no sshd after {within_s:g} s, its console's last: {said}")
            time.sleep(0.2)
        self._leader = self._find_leader()
        return time.monotonic() - started

    def cut_power(self) -> None:
        """Kills everything in it at one moment; its disk stays as it was. Raises nothing."""
        process, self._process = self._process, None
        if process is None:
            return
        with contextlib.suppress(EmulationError, OSError):
            os.kill(self._leader or self._find_leader(process.pid), signal.SIGKILL)  # and with it its whole namespace
        self._leader = 0
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(KILL_S)
        process.kill()
        process.wait()

    def power_off(self) -> None:
        """Shuts it down as `systemctl poweroff` does."""
        if self.on:
            self.inside("systemctl", "poweroff")
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(OFF_S)
        self.cut_power()

    # Work in it

    def ssh(
        self, command: str, *, check: bool = True, timeout_s: float | None = None, stdin: bytes | None = None
    ) -> subprocess.CompletedProcess:
        """Runs a command for its user, as a human would; bytes. Raises EmulationError if it fails and check is set."""
        return self._ran([*self.ssh_command, command], command, check, timeout_s, stdin)

    def inside(
        self, *command: object, check: bool = True, timeout_s: float | None = None
    ) -> subprocess.CompletedProcess:
        """Runs a program as root, past sshd; otherwise as ssh()."""
        enter = ["nsenter", f"--target={self.leader}", "--mount", "--uts", "--ipc", "--pid", "--root", "--wd=/"]
        enter += ["--", "/usr/bin/env", "--ignore-environment", "PATH=/usr/local/bin:/usr/sbin:/usr/bin", "LC_ALL=C"]
        return self._ran([*enter, *map(str, command)], " ".join(map(str, command)), check, timeout_s, None)

    @property
    def ssh_command(self) -> list[str]:
        """To be followed by a command; one connection for all of them."""
        return ["ssh", "-q", "-i", str(self.key), "-p", str(self.port), *SSH, f"{USER}@127.0.0.1"]

    @property
    def leader(self) -> int:
        """Its first process, as this machine numbers it. Raises EmulationError while it is off."""
        if not self.on or not self._leader:
            raise EmulationError(f"{self.name} is off: boot it")
        return self._leader

    def pid_of(self, pid: int) -> int:
        """This machine's number of one of its processes. Raises EmulationError if there is none."""
        inner = Path(f"/proc/{self.leader}/ns/pid").readlink()
        for status in Path("/proc").glob("[0-9]*/status"):
            with contextlib.suppress(OSError, StopIteration):
                numbers = next(x for x in status.read_text().splitlines() if x.startswith("NSpid:")).split()[1:]
                if int(numbers[-1]) == pid and (status.parent / "ns" / "pid").readlink() == inner:
                    return int(numbers[0])
        raise EmulationError(f"{self.name} has no process {pid}")

    # Devices

    def plug(self, *, camera: str | Path | None = None, arduino: str | Path | None = None) -> None:
        """Plugs in a camera, a FIFO of JPEGs in /tmp, and an Arduino, a pseudo terminal of this machine; on or off.

        None: as it was. They are CAMERA and PORT in there; both stay plugged in when it boots again.
        """
        if camera is not None:
            Path(camera).chmod(0o666)
            self.unplug(camera=True)
            (self.bench / "camera").hardlink_to(camera)
        if arduino is not None:
            terminal = Path(arduino).resolve()
            os.chown(terminal, 0, DIALOUT)
            terminal.chmod(0o660)
            self.unplug(arduino=True)
            (self.bench / "arduino").symlink_to(f"{PTS}/{terminal.name}")

    def unplug(self, *, camera: bool = False, arduino: bool = False) -> None:
        """Their names are gone; who has them open notices nothing: close camera or Arduino itself for that."""
        if camera:
            (self.bench / "camera").unlink(missing_ok=True)
        if arduino:
            (self.bench / "arduino").unlink(missing_ok=True)

    # What is done to the disk before it boots

    def _configure(self) -> None:
        self.bench.mkdir(mode=0o755)
        self._own.chmod(0o755)
        units = self.root / "etc" / "systemd" / "system"
        for name in MASKED:
            (units / name).unlink(missing_ok=True)
            (units / name).symlink_to("/dev/null")
        for name in TRANSLATED:
            (units / f"{name}.service.d").mkdir(exist_ok=True)
            (units / f"{name}.service.d" / "emulated.conf").write_text("[Service]\nMemoryDenyWriteExecute=no\n")
        (self.root / "etc" / "hostname").write_text(f"{self.name}\n")
        (self.root / "etc" / "hosts").write_text(f"127.0.0.1\tlocalhost\n127.0.1.1\t{self.name}\n")
        settings = f"Port {self.port}\nListenAddress 127.0.0.1\nUseDNS no\nPasswordAuthentication no\n"
        (self.root / "etc" / "ssh" / "sshd_config.d" / "emulated.conf").write_text(settings)
        # What udev would do, and no udev can do here
        (self.root / "etc" / "tmpfiles.d" / "emulated.conf").write_text(f"L {PORT} - - - - {BENCH}/arduino\n")
        _lend_systemd(self.root)
        _lend_registries(self.root)

    def _ran(
        self, command: list[str], what: str, check: bool, timeout_s: float | None, stdin: bytes | None
    ) -> subprocess.CompletedProcess:
        try:
            done = subprocess.run(command, capture_output=True, timeout=timeout_s, input=stdin)
        except subprocess.TimeoutExpired:
            raise EmulationError(f"{self.name}: '{what}' took more than {timeout_s:g} s") from None
        if check and done.returncode:
            said = " ".join((done.stderr or done.stdout).decode(errors="replace").split())[-600:]
            raise EmulationError(f"{self.name}: '{what}' ended with {done.returncode}: {said}")
        return done

    def _enter(self) -> None:
        self._enter_cgroup()
        os.setpriority(os.PRIO_PROCESS, 0, self._nice)

    def _console(self) -> str:
        text = (self._own / "console.log").read_text(errors="replace")
        return " | ".join(text.strip().splitlines()[-8:]) or "nothing"

    def _find_leader(self, nspawn: int | None = None) -> int:
        """The child of nspawn that is the first process of another pid namespace."""
        waiting = [nspawn or self._process.pid]
        while waiting:
            pid = waiting.pop()
            with contextlib.suppress(OSError):
                status = Path(f"/proc/{pid}/status").read_text()
                numbers = next(x for x in status.splitlines() if x.startswith("NSpid:")).split()[1:]
                if numbers[1:] and numbers[-1] == "1":
                    return pid
                waiting += map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split())
        raise EmulationError(f"{self.name}: systemd-nspawn has no first process")


SSH = [
    *("-o", "UserKnownHostsFile=/dev/null", "-o", "StrictHostKeyChecking=no", "-o", "IdentitiesOnly=yes"),
    *("-o", "BatchMode=yes", "-o", f"ConnectTimeout={SSH_S:g}"),
]


def _forget(machine: str) -> None:
    """What nspawn leaves where /run is no tmpfs."""
    for folder in ("propagate", "unix-export"):
        shutil.rmtree(Path("/run/systemd/nspawn") / folder / machine, ignore_errors=True)
    (Path("/run/systemd/nspawn") / f"{machine}.lock").unlink(missing_ok=True)
    for lock in Path("/run/systemd/nspawn/locks").glob("*"):
        if machine in lock.name:
            lock.unlink(missing_ok=True)


def _lend_systemd(root: Path) -> None:
    """This machine's own systemd as the first process, of the version that the Pi has; everything else stays aarch64.

    What sets up a service's sandbox runs in it, and under qemu-user that fails (PrivateNetwork=, credentials) or does
    nothing (seccomp). The sandbox holds for the emulator that a service runs in just as well.
    """
    told = run(["ldd", SYSTEMD], f"{SYSTEMD} cannot be examined")
    libraries = {Path(word) for line in told.splitlines() for word in line.split() if word.startswith("/")}
    ask = ["--show", "--showformat=${Version}"]
    here = run(["dpkg-query", *ask, "systemd"], "this machine's systemd is no Debian package")
    theirs = ["dpkg-query", f"--admindir={root}/var/lib/dpkg", *ask, "systemd:arm64"]
    there = run(theirs, "the emulated Pi has no systemd")
    if here.partition(".")[0] != there.partition(".")[0]:
        raise EmulationError(
            f"systemd is {here} here and {there} on the emulated Pi: remove {cache_root()}/pi-system-*"
        )
    for path in (SYSTEMD, *libraries):
        target = root / path.relative_to("/")
        target.parent.mkdir(parents=True, exist_ok=True)
        target.unlink(missing_ok=True)
        shutil.copy(path, target)


def _lend_registries(root: Path) -> None:
    """This machine's own ways to Debian's and Python's packages: sources, proxies, certificates, pip's settings."""
    form = "$(REPO_URI) $(RELEASE) $(COMPONENT)"
    told = run(["apt-get", "indextargets", "--format", form, "Identifier: Packages"], "apt-get names no sources")
    release = (root / "etc" / "os-release").read_text()
    codename = next(x.partition("=")[2] for x in release.splitlines() if x.startswith("VERSION_CODENAME="))
    suites = {codename, f"{codename}-updates", f"{codename}-security"}
    sources = sorted({line for line in told.splitlines() if set(line.split()[1:2]) & suites})
    if not sources:
        raise EmulationError(f"this machine's apt sources have no Debian {codename}, whose packages the Pi installs")
    (root / "etc" / "apt" / "sources.list").write_text("".join(f"deb {line}\n" for line in sources))
    apt = run(["apt-config", "dump"], "apt-config does not work").splitlines()
    settings = [line for line in apt if line.startswith(("Acquire::http", "Acquire::https"))]
    settings += [f'Acquire::{k}::Proxy "{v}";' for k in ("http", "https") if (v := _proxy(k))]
    (root / "etc" / "apt" / "apt.conf.d" / "90emulated").write_text(
        "\n".join([*settings, 'Acquire::Languages "none";\n'])
    )
    if CERTIFICATES.exists():
        shutil.copy(CERTIFICATES, root / CERTIFICATES.relative_to("/"))
    told = run([sys.executable, "-m", "pip", "config", "list"], "pip does not tell its settings")
    (root / "etc" / "pip.conf").write_text(pip_settings(told, _proxy("https")))


def pip_settings(told: str, proxy: str = "") -> str:
    """A pip.conf for another machine from what `pip config list` told here: where packages are, not how they are used.

    Folders of this machine are left out; so are its certificates, since the other has them where its own were.
    """
    found = {"cert": str(CERTIFICATES), "proxy": proxy}
    for line in told.splitlines():
        key, _, value = line.partition("=")
        name = key.rpartition(".")[2]
        if name in ("index-url", "extra-index-url", "trusted-host", "proxy", "timeout", "default-timeout", "retries"):
            there = [word for word in str(ast.literal_eval(value)).split() if not word.startswith(("file:", "/"))]
            found[name] = " ".join(there)
    return "[global]\n" + "".join(f"{k} = {v}\n" for k, v in found.items() if v)


def _proxy(scheme: str) -> str:
    return os.environ.get(f"{scheme}_proxy") or os.environ.get(f"{scheme.upper()}_PROXY") or ""

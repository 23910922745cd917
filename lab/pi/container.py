"""Emulate a Pi that is up in seconds: real systemd and sshd, aarch64 programs, but this machine's kernel and network.

    with Container("rover1") as pi:
        pi.boot()
        pi.inside("uname", "-m")            # aarch64
        with EmulatedArduino() as board:
            pi.plug(board.port)             # it is PORT inside
            ...
        pi.cut_power()
        pi.boot()

Its disk is a layer over folders that stay as they are, so that many containers can start from what one has installed.

    pi.power_off()
    with Container("rover2", layers=pi.layers) as another: ...

Its systemd is this machine's own program, of the same version, so everything that makes a service's sandbox is real.
All other programs are aarch64. A container has no kernel of its own, so it has no udev, no V4L2 camera (a FIFO of JPEGs
replaces it) and no time of its own. This machine's kernel gets every write at once, so a power cut ends all programs at
one moment, but no write that was not synced is lost.
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

from lab.a76.core import CORES
from lab.pi.debian_image import debian_image
from lab.pi.emulation import EmulationError, emulation, free_port, in_cgroup
from rover_lib.workshop.cache import cache_root
from rover_lib.workshop.run_program import last_words, run

BOOT_S = 180.0  # until sshd answers, which takes 10 s on two quiet cores
OFF_S = 60.0
KILL_S = 20.0
BENCH, PTS = "/srv/bench", "/srv/pts"  # folders in the container: what is plugged in, the host's pseudo terminals
CAMERA, PORT = f"{BENCH}/camera", "/dev/rover-arduino"
DIALOUT = 20  # Debian's number for the group
# The network is the host's, so the host configures it; and nothing may update itself while something is measured.
MASKED = ("systemd-networkd.service", "systemd-resolved.service", "apt-daily.timer", "apt-daily-upgrade.timer")
# Units that forbid their programs to make memory executable, which the emulator of these programs must do.
TRANSLATED = (
    *("systemd-journald", "systemd-logind", "systemd-hostnamed", "systemd-timedated", "systemd-localed"),
    "rover-view",
)
SYSTEMD = Path("/usr/lib/systemd/systemd")
CERTIFICATES = Path("/etc/ssl/certs/ca-certificates.crt")


class Container:
    """One emulated Pi; a context manager, which leaves nothing behind.

    name: of the rover. root: the host's path of its present file system. port: of its sshd, on the loopback. key: the
    ssh key of its user. layers: for another container that starts from what this one has become, once this one is off.
    """

    def __init__(self, name: str, *, layers: Sequence[Path] = (), nice: int = 0):
        """Prepare a container, which is made when it is entered.

        layers: folders with changes to the system, from the lowest to the highest. nice: the priority of all its
        programs; -10 comes nearer to a Pi, which has a processor of its own.
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
            made = debian_image()
            self.key = made.key
            # Not in /tmp, which may be in memory: torch alone takes half a gigabyte.
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
            # redirect_dir allows to rename a folder of a lower layer, as on any disk.
            how = f"lowerdir={below},upperdir={self._upper},workdir={disk / 'work'},redirect_dir=on"
            remedy = f"put ROVER_CACHE on a plain disk if {cache_root()} cannot hold a layered file system"
            run("mount", "-t", "overlay", self.machine, "-o", how, self.root, error=EmulationError, remedy=remedy)
            stack.callback(lambda: subprocess.run(["umount", "--lazy", self.root], capture_output=True))
            self._enter_cgroup = stack.enter_context(in_cgroup(self.machine))
            stack.callback(_forget, self.machine)
            stack.callback(self.cut_power)
            self._configure()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stack.close()

    @property
    def layers(self) -> tuple[Path, ...]:
        """The layers for another container, to be used while this one is off and not closed."""
        return (*self._below, self._upper)

    @property
    def on(self) -> bool:
        """Whether it has power. It may still be booting, or have failed to boot."""
        return self._process is not None and self._process.poll() is None

    # Power

    def boot(self) -> float:
        """Switch it on, and return how many seconds it took until sshd answered.

        Raises EmulationError with the last lines of its console if sshd does not answer.
        """
        if self.on:
            raise EmulationError(f"{self.name} is on already", remedy="cut its power, or power it off")
        started = time.monotonic()
        console = (self._own / "console.log").open("wb")
        command = ["systemd-nspawn", "--quiet", "--boot", "--register=no", "--keep-unit", "--link-journal=no"]
        command += [f"--machine={self.machine}", f"--hostname={self.name}", f"--directory={self.root}"]
        command += ["--capability=CAP_SYS_RESOURCE"]  # for limits such as the drive loop's real-time priority
        command += ["--resolv-conf=replace-host", "--timezone=off", "--console=pipe"]
        command += [f"--bind={self.bench}:{BENCH}", f"--bind=/dev/pts:{PTS}"]
        # The Pi's numbers of processors: with this machine's, and with its /proc/cpuinfo, ONNX Runtime's wheel for
        # arm64 crashes when it is imported.
        for cpus in ("possible", "present"):
            command += [f"--bind-ro={self._own / 'cpus'}:/sys/devices/system/cpu/{cpus}"]
        with console:
            process = self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=console,
                stderr=subprocess.STDOUT,
                preexec_fn=self._enter,
                start_new_session=True,  # a terminal's ^C must reach only this program, which then stops it in order
            )
        while True:
            if not self.on:
                raise EmulationError(f"{self.name} did not boot, its console's last: {self._console()}")
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", self.port), 5) as s:
                s.settimeout(10)
                if s.recv(4) == b"SSH-":
                    break
            if time.monotonic() > started + BOOT_S:
                last = self._console()
                self.cut_power()
                raise EmulationError(f"{self.name} has no sshd after {BOOT_S:g} s, its console's last: {last}")
            time.sleep(0.2)
        self._leader = self._find_leader(process.pid)
        return time.monotonic() - started

    def cut_power(self) -> None:
        """Kill everything in it at one moment, and leave its disk as it was. Raises nothing."""
        process, self._process = self._process, None
        if process is None:
            return
        with contextlib.suppress(EmulationError, OSError):
            os.kill(self._leader or self._find_leader(process.pid), signal.SIGKILL)  # which ends its whole namespace
        self._leader = 0
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(KILL_S)
        process.kill()
        process.wait()

    def power_off(self) -> None:
        """Shut it down with `systemctl poweroff`, and cut its power if that takes too long."""
        if self._process and self.on:
            self.inside("systemctl", "poweroff")
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(OFF_S)
        self.cut_power()

    # Work in it

    def inside(
        self, *command: object, check: bool = True, timeout_s: float | None = None
    ) -> subprocess.CompletedProcess[str]:
        """Run a program in it as root, without sshd.

        Raises EmulationError if it takes longer than timeout_s, or if it fails and check is set.
        """
        enter = ["nsenter", f"--target={self.leader}", "--mount", "--uts", "--ipc", "--pid", "--root", "--wd=/"]
        enter += ["--", "/usr/bin/env", "--ignore-environment", "PATH=/usr/local/bin:/usr/sbin:/usr/bin", "LC_ALL=C"]
        words = [str(word) for word in command]
        what = f"{self.name}: '{' '.join(words)}'"
        try:
            done = subprocess.run([*enter, *words], capture_output=True, text=True, errors="replace", timeout=timeout_s)
        except subprocess.TimeoutExpired:
            raise EmulationError(f"{what} took more than {timeout_s:g} s") from None
        if check and done.returncode:
            raise EmulationError(f"{what} ended with {done.returncode}: {last_words(done.stderr or done.stdout)}")
        return done

    @property
    def leader(self) -> int:
        """The id of its first process on this machine. Raises EmulationError while it is off."""
        if not self.on or not self._leader:
            raise EmulationError(f"{self.name} is off", remedy="boot it")
        return self._leader

    def pid_of(self, pid: int) -> int:
        """Return the id on this machine of its process `pid`. Raises EmulationError if there is none."""
        inner = Path(f"/proc/{self.leader}/ns/pid").readlink()
        for process in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                numbers = _pids(process)
                if numbers[-1] == pid and (process / "ns" / "pid").readlink() == inner:
                    return numbers[0]
        raise EmulationError(f"{self.name} has no process {pid}")

    def plug(self, arduino: str | Path) -> None:
        """Plug in an Arduino, a pseudo terminal of this machine. It is PORT inside, also after the next boot."""
        terminal = Path(arduino).resolve()
        os.chown(terminal, 0, DIALOUT)
        terminal.chmod(0o660)
        (self.bench / "arduino").symlink_to(f"{PTS}/{terminal.name}")

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
        # udev would make this link, but there is none here.
        (self.root / "etc" / "tmpfiles.d" / "emulated.conf").write_text(f"L {PORT} - - - - {BENCH}/arduino\n")
        (self._own / "cpus").write_text(f"0-{CORES - 1}\n")
        _lend_systemd(self.root)
        _lend_registries(self.root)

    def _enter(self) -> None:
        self._enter_cgroup()
        os.setpriority(os.PRIO_PROCESS, 0, self._nice)

    def _console(self) -> str:
        text = (self._own / "console.log").read_text(errors="replace")
        return " | ".join(text.strip().splitlines()[-8:]) or "nothing"

    def _find_leader(self, nspawn: int) -> int:
        """Return the descendant of nspawn that is the first process of its own pid namespace."""
        waiting = [nspawn]
        while waiting:
            process = Path("/proc", str(waiting.pop()))
            with contextlib.suppress(OSError):
                numbers = _pids(process)
                if numbers[1:] and numbers[-1] == 1:
                    return numbers[0]
                waiting += map(int, (process / "task" / process.name / "children").read_text().split())
        raise EmulationError(f"{self.name}: systemd-nspawn has no first process")


def _pids(process: Path) -> list[int]:
    """Return the ids of a process in /proc: this machine's first, then that in each nested pid namespace."""
    lines = (process / "status").read_text().splitlines()
    return next([int(word) for word in line.split()[1:]] for line in lines if line.startswith("NSpid:"))


def _forget(machine: str) -> None:
    """Remove what nspawn leaves behind if /run is not a tmpfs."""
    for folder in ("propagate", "unix-export"):
        shutil.rmtree(Path("/run/systemd/nspawn") / folder / machine, ignore_errors=True)
    (Path("/run/systemd/nspawn") / f"{machine}.lock").unlink(missing_ok=True)
    for lock in Path("/run/systemd/nspawn/locks").glob("*"):
        if machine in lock.name:
            lock.unlink(missing_ok=True)


def _lend_systemd(root: Path) -> None:
    """Copy this machine's own systemd, which must have the Pi's version, into the Pi; everything else stays aarch64.

    systemd sets up the sandboxes of services, which under qemu-user fails (PrivateNetwork=, credentials) or has no
    effect (seccomp). A sandbox also holds for the emulator in which a service's program runs.
    """
    libraries = {Path(word) for word in _run("ldd", SYSTEMD).split() if word.startswith("/")}
    ask = ["dpkg-query", "--show", "--showformat=${Version}"]
    here = _run(*ask, "systemd")
    there = _run(*ask, f"--admindir={root}/var/lib/dpkg", "systemd:arm64")
    if here.partition(".")[0] != there.partition(".")[0]:
        what = f"systemd is {here} here and {there} on the emulated Pi"
        raise EmulationError(what, remedy=f"remove {cache_root()}/pi-system-*")
    for path in (SYSTEMD, *libraries):
        target = root / path.relative_to("/")
        target.parent.mkdir(parents=True, exist_ok=True)
        target.unlink(missing_ok=True)
        shutil.copy(path, target)


def _lend_registries(root: Path) -> None:
    """Give the Pi this machine's access to Debian's and Python's packages: sources, proxies, certificates, pip.conf."""
    form = "$(REPO_URI) $(RELEASE) $(COMPONENT)"
    listed = _run("apt-get", "indextargets", "--format", form, "Identifier: Packages")
    release = (root / "etc" / "os-release").read_text()
    codename = next(x.partition("=")[2] for x in release.splitlines() if x.startswith("VERSION_CODENAME="))
    suites = {codename, f"{codename}-updates", f"{codename}-security"}
    sources = sorted({line for line in listed.splitlines() if set(line.split()[1:2]) & suites})
    if not sources:
        raise EmulationError(f"this machine's apt sources have no Debian {codename}, whose packages the Pi installs")
    (root / "etc" / "apt" / "sources.list").write_text("".join(f"deb {line}\n" for line in sources))
    apt = _run("apt-config", "dump").splitlines()
    settings = [line for line in apt if line.startswith(("Acquire::http", "Acquire::https"))]
    settings += [f'Acquire::{k}::Proxy "{v}";' for k in ("http", "https") if (v := _proxy(k))]
    settings += ['Acquire::Languages "none";\n']
    (root / "etc" / "apt" / "apt.conf.d" / "90emulated").write_text("\n".join(settings))
    if CERTIFICATES.exists():
        shutil.copy(CERTIFICATES, root / CERTIFICATES.relative_to("/"))
    config = _run(sys.executable, "-m", "pip", "config", "list")
    (root / "etc" / "pip.conf").write_text(pip_settings(config, _proxy("https")))


def _run(*command: object) -> str:
    return run(*command, error=EmulationError)


def pip_settings(config: str, proxy: str = "") -> str:
    """Make a pip.conf for another machine from the output of `pip config list` here: only where to get packages.

    Folders of this machine are left out. The path of its certificates is replaced by that of the other machine's.
    """
    found = {"cert": str(CERTIFICATES), "proxy": proxy}
    for line in config.splitlines():
        key, _, value = line.partition("=")
        name = key.rpartition(".")[2]
        if name in ("index-url", "extra-index-url", "trusted-host", "proxy", "timeout", "default-timeout", "retries"):
            there = [word for word in str(ast.literal_eval(value)).split() if not word.startswith(("file:", "/"))]
            found[name] = " ".join(there)
    return "[global]\n" + "".join(f"{k} = {v}\n" for k, v in found.items() if v)


def _proxy(scheme: str) -> str:
    return os.environ.get(f"{scheme}_proxy") or os.environ.get(f"{scheme.upper()}_PROXY") or ""

"""Emulate a Pi that is up in seconds: real systemd and sshd, aarch64 programs, but this machine's kernel and network.

Its systemd is this machine's own program, of the same version, so everything that makes a service's sandbox is real.
All other programs are aarch64. A container has no kernel of its own, so it has no udev, no V4L2 camera (a FIFO of JPEGs
replaces it) and no time of its own.
"""

import ast
import contextlib
import os
import secrets
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any
from urllib.request import getproxies

from lab.debian import debian_sources
from lab.pi.debian_image import debian_image
from lab.pi.emulation import in_cgroup
from rover_lib.onboard.errors import RoverError
from rover_lib.workshop.cache import cache_root
from rover_lib.workshop.run_program import run

BOOT_S = 180.0  # until sshd answers, which takes 10 s on two quiet cores
OFF_S = 30.0
NICE = -5  # the priority of its programs, as a real Pi has a processor of its own
BENCH, PTS = "/srv/bench", "/srv/pts"  # folders in the container: what is plugged in, the host's pseudo terminals
CAMERA, PORT = f"{BENCH}/camera", "/dev/rover-arduino"
DIALOUT = 20  # Debian's number for the group
# The network is the host's, so the host configures it; and nothing may update itself while something is measured.
MASKED = ("systemd-networkd.service", "systemd-resolved.service", "apt-daily.timer", "apt-daily-upgrade.timer")
# Units that forbid their programs to make memory executable, which the emulator of these programs must do.
TRANSLATED = ("systemd-journald", "systemd-logind", "systemd-hostnamed", "systemd-timedated", "systemd-localed")
SYSTEMD = Path("/usr/lib/systemd/systemd")
CERTIFICATES = Path("/etc/ssl/certs/ca-certificates.crt")


class Container:
    """One emulated Pi; a context manager, which leaves nothing behind.

    root, bench: the host's paths of its file system and of BENCH. port: of its sshd. key: the ssh key of its user.
    """

    def __init__(self, name: str):
        self.name = name
        with socket.socket() as s:
            s.bind(("127.0.0.1", 0))
            self.port: int = s.getsockname()[1]

    def __enter__(self) -> "Container":
        with contextlib.ExitStack() as stack:
            system = debian_image()
            self.key, self.machine = system / "key", f"rover-pi-{secrets.token_hex(4)}"
            # Not in /tmp, which may be in memory: torch alone takes half a gigabyte.
            folder = stack.enter_context(tempfile.TemporaryDirectory(prefix=".pi-", dir=cache_root()))
            self._own = Path(folder)
            self._own.chmod(0o755)
            self.root, self.bench = self._own / "root", self._own / "bench"
            for name in ("upper", "work", "root", "bench"):
                (self._own / name).mkdir(mode=0o755)
            # redirect_dir allows to rename a folder of a lower layer, as on any disk.
            layers = f"lowerdir={system}/root,upperdir={folder}/upper,workdir={folder}/work,redirect_dir=on"
            remedy = f"put ROVER_CACHE on a plain disk if {cache_root()} cannot hold a layered file system"
            run("mount", "-t", "overlay", self.machine, "-o", layers, self.root, error=RoverError, remedy=remedy)
            stack.callback(lambda: subprocess.run(["umount", "--lazy", self.root], capture_output=True))
            self._enter_cgroup = stack.enter_context(in_cgroup(self.machine))
            self._configure()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *exc: object) -> None:
        self._stack.close()

    def boot(self) -> None:
        """Switch it on, and wait until its sshd answers. Raises RoverError if it does not."""
        command = ["systemd-nspawn", "--quiet", "--boot", "--register=no", "--keep-unit", "--link-journal=no"]
        command += [f"--machine={self.machine}", f"--hostname={self.name}", f"--directory={self.root}"]
        command += ["--capability=CAP_SYS_RESOURCE"]  # for limits such as the drive loop's real-time priority
        command += ["--resolv-conf=replace-host", "--timezone=off", "--console=pipe"]
        command += [f"--bind={self.bench}:{BENCH}", f"--bind=/dev/pts:{PTS}"]
        console = self._stack.enter_context((self._own / "console.log").open("wb"))
        streams: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": console, "stderr": subprocess.STDOUT}
        # In its own session: a terminal's ^C must reach only this program, which then stops it in order.
        process = subprocess.Popen(command, preexec_fn=self._enter, start_new_session=True, **streams)
        self._stack.callback(_power_off, process)
        self._wait_for_sshd(process)

    def plug(self, arduino: str | Path) -> None:
        """Plug in an Arduino, a pseudo terminal of this machine. It is PORT inside."""
        terminal = Path(arduino).resolve()
        os.chown(terminal, 0, DIALOUT)
        terminal.chmod(0o660)
        (self.bench / "arduino").symlink_to(f"{PTS}/{terminal.name}")

    def _enter(self) -> None:
        self._enter_cgroup()
        os.setpriority(os.PRIO_PROCESS, 0, NICE)

    def _wait_for_sshd(self, process: subprocess.Popen) -> None:
        end = time.monotonic() + BOOT_S
        while process.poll() is None and time.monotonic() < end:
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", self.port), 5) as s:
                s.settimeout(10)
                if s.recv(4) == b"SSH-":
                    return
            time.sleep(0.2)
        last = (self._own / "console.log").read_text(errors="replace").strip().splitlines()[-8:]
        raise RoverError(f"{self.name} has no sshd, its console's last: {' | '.join(last) or 'nothing'}")

    def _configure(self) -> None:
        """Write to its disk what makes it this Pi, before it boots."""
        etc, units = self.root / "etc", self.root / "etc/systemd/system"
        for name in MASKED:
            (units / name).unlink(missing_ok=True)
            (units / name).symlink_to("/dev/null")
        for name in TRANSLATED:
            (units / f"{name}.service.d").mkdir(exist_ok=True)
            (units / f"{name}.service.d" / "emulated.conf").write_text("[Service]\nMemoryDenyWriteExecute=no\n")
        (etc / "hostname").write_text(f"{self.name}\n")
        (etc / "hosts").write_text(f"127.0.0.1\tlocalhost\n127.0.1.1\t{self.name}\n")
        settings = f"Port {self.port}\nListenAddress 127.0.0.1\nUseDNS no\nPasswordAuthentication no\n"
        (etc / "ssh/sshd_config.d/emulated.conf").write_text(settings)
        # udev would make this link, but there is none here.
        (etc / "tmpfiles.d/emulated.conf").write_text(f"L {PORT} - - - - {BENCH}/arduino\n")
        _lend_systemd(self.root)
        _lend_registries(etc)


def _power_off(nspawn: subprocess.Popen) -> None:
    nspawn.terminate()  # which shuts the container down in order
    with contextlib.suppress(subprocess.TimeoutExpired):
        nspawn.wait(OFF_S)
    nspawn.kill()  # what it leaves is killed with its control group
    nspawn.wait()


def _lend_systemd(root: Path) -> None:
    """Copy this machine's systemd, of the Pi's version, into the Pi: under qemu-user, a service's sandbox fails."""
    libraries = {Path(word) for word in run("ldd", SYSTEMD).split() if word.startswith("/")}
    ask = ["dpkg-query", "--show", "--showformat=${Version}"]
    here, there = run(*ask, "systemd"), run(*ask, f"--admindir={root}/var/lib/dpkg", "systemd:arm64")
    if here.partition(".")[0] != there.partition(".")[0]:
        remedy = f"remove {cache_root()}/pi-system-*"
        raise RoverError(f"the Pi's systemd must be {here}, as here", found=there, remedy=remedy)
    for path in (SYSTEMD, *libraries):
        target = root / path.relative_to("/")
        target.parent.mkdir(parents=True, exist_ok=True)
        target.unlink(missing_ok=True)
        shutil.copy(path, target)


def _lend_registries(etc: Path) -> None:
    """Give the Pi this machine's access to Debian's and Python's packages: sources, proxies, certificates, pip.conf."""
    (etc / "apt/sources.list").write_text(debian_sources()[1])
    settings = [x for x in run("apt-config", "dump").splitlines() if x.startswith(("Acquire::http", "Acquire::https"))]
    proxies = getproxies()
    settings += [f'Acquire::{kind}::Proxy "{proxies[kind]}";' for kind in ("http", "https") if kind in proxies]
    (etc / "apt/apt.conf.d/90emulated").write_text("\n".join([*settings, 'Acquire::Languages "none";\n']))
    if CERTIFICATES.exists():
        shutil.copy(CERTIFICATES, etc / CERTIFICATES.relative_to("/etc"))
    config = run(sys.executable, "-m", "pip", "config", "list")
    (etc / "pip.conf").write_text(pip_settings(config, proxies.get("https", "")))


def pip_settings(config: str, proxy: str = "") -> str:
    """Make a pip.conf for another machine from `pip config list` here, without folders of this machine."""
    settings = {"cert": str(CERTIFICATES), "proxy": proxy}
    for line in config.splitlines():
        key, _, value = line.partition("=")
        name = key.rpartition(".")[2]
        if name in ("index-url", "extra-index-url", "trusted-host", "proxy", "timeout", "default-timeout", "retries"):
            there = [word for word in str(ast.literal_eval(value)).split() if not word.startswith(("file:", "/"))]
            settings[name] = " ".join(there)
    return "[global]\n" + "".join(f"{k} = {v}\n" for k, v in settings.items() if v)

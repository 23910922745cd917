"""Build Debian arm64 for the emulated Pis, like a freshly flashed Raspberry Pi OS Lite. It is built once, then cached.

    with emulation():
        debian_image() / "root"      # /etc, /usr, ... of the Pi, owned by root; never written to

The packages are those of this machine's own Debian (12 or 13). dpkg unpacks them natively; only their configuration is
emulated. The image has nothing that provision.yml must install.
"""

import os
import platform
import subprocess
import tempfile
from pathlib import Path

from lab.debian import fetch_packages
from lab.pi.emulation import in_cgroup
from rover_lib.onboard.errors import RoverError
from rover_lib.workshop.cache import cache_folder, key_of
from rover_lib.workshop.run_program import run

USER = "pi"
PACKAGES = (
    *("?essential", "?priority(^required$)", "debian-archive-keyring", "ca-certificates"),
    *("systemd", "systemd-sysv", "dbus", "udev", "libpam-systemd", "kmod", "procps"),
    *("openssh-server", "sudo", "python3", "python3-apt", "iproute2", "netbase", "less"),
)
RECIPE = 3  # raise it when the image is made in another way, so that older ones are not used
FIRST = "base-passwd"  # unpacked first, as the other packages' scripts ask for its users and groups
FORCE = ("architecture", "depends", "overwrite", "unsafe-io")
GROUPS = "adm,dialout,cdrom,sudo,audio,video,plugdev,games,users,input,render,netdev"  # of Raspberry Pi OS's user
CONFIGURE = f"""set -e
dpkg --configure --pending --force-depends
for group in {GROUPS.replace(",", " ")}; do getent group $group > /dev/null || groupadd --system $group; done
useradd --create-home --shell /bin/bash --groups {GROUPS} {USER}
"""
# These stand before the real programs while packages are configured, so that no service is started, and no bundle of
# certificates is made: a container gets this machine's.
STAND_INS = {"usr/sbin/policy-rc.d": "exit 101", "usr/local/sbin/update-ca-certificates": "exit 0"}


def debian_image() -> Path:
    """Return the folder of the Pi's system, from the cache or made now, within emulation(), in two minutes.

    root: its file system. key: the private ssh key of USER, who may use sudo without a password. Raises RoverError.
    """
    about = platform.freedesktop_os_release()
    if about["ID"] != "debian":
        raise RoverError("the emulated Pi needs the apt sources of a Debian 12 or 13", found=about["PRETTY_NAME"])
    recipe = {"made": [PACKAGES, CONFIGURE, RECIPE], "debian": about["VERSION_CODENAME"]}
    return cache_folder("pi-system", key_of(recipe), _make)


def _make(folder: Path) -> None:
    folder.chmod(0o755)
    root = folder / "root"
    with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".apt.") as scratch:
        _unpack(root, fetch_packages(Path(scratch), PACKAGES))
    run("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "emulated Pi", "-f", folder / "key", error=RoverError)
    name = f"rover-make-{os.getpid()}"
    stand_ins = [root / path for path in STAND_INS]
    for program in stand_ins:
        program.parent.mkdir(parents=True, exist_ok=True)
        program.write_text(f"#!/bin/sh\n{STAND_INS[str(program.relative_to(root))]}\n")
        program.chmod(0o755)
    with in_cgroup(name) as enter:
        chroot = ["systemd-nspawn", "--quiet", "--register=no", "--keep-unit", f"--machine={name}"]
        chroot += ["--timezone=off", "--resolv-conf=off", "--link-journal=no", f"--directory={root}"]
        chroot += ["--setenv=DEBIAN_FRONTEND=noninteractive", "--setenv=LC_ALL=C.UTF-8"]
        run(*chroot, "/bin/sh", "-c", CONFIGURE, error=RoverError, preexec_fn=enter)
    for program in stand_ins:
        program.unlink()
    _personalize(root, (folder / "key.pub").read_text())


def _unpack(root: Path, packages: list[Path]) -> None:
    """Unpack all files, so that the packages' scripts find what they call; then again with dpkg, so that it knows."""
    (root / "usr").mkdir(parents=True)
    root.chmod(0o755)
    for name in ("bin", "sbin", "lib"):
        (root / "usr" / name).mkdir()
        (root / name).symlink_to(f"usr/{name}")
    for package in packages:
        with subprocess.Popen(["dpkg-deb", "--fsys-tarfile", package], stdout=subprocess.PIPE) as tar:
            run("tar", "-x", "-C", root, "--keep-directory-symlink", error=RoverError, stdin=tar.stdout)
        if tar.returncode:
            raise RoverError(f"{package.name} cannot be unpacked: dpkg-deb ended with {tar.returncode}")
    status = root / "var" / "lib" / "dpkg"
    for name in ("info", "updates"):
        (status / name).mkdir(parents=True, exist_ok=True)
    for name in ("status", "available"):
        (status / name).touch()
    forced = [f"--force-{what}" for what in FORCE]
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive", "LC_ALL": "C.UTF-8"}
    for part in ([p for p in packages if p.name.startswith(f"{FIRST}_")], packages):
        command = ["dpkg", f"--root={root}", "--log=/dev/null", *forced, "--unpack", *part]
        run(*command, error=RoverError, env=environment)


def _personalize(root: Path, public_key: str) -> None:
    """Write what Raspberry Pi Imager writes, but the host's name: a user with a key, and sudo without a password."""
    (root / "etc" / "machine-id").write_text("")  # each boot of a copy makes its own
    sudoers = root / "etc" / "sudoers.d" / "010_pi-nopasswd"
    sudoers.write_text(f"{USER} ALL=(ALL) NOPASSWD: ALL\n")
    sudoers.chmod(0o440)
    home = root / "home" / USER
    (home / ".ssh").mkdir(mode=0o700)
    keys = home / ".ssh" / "authorized_keys"
    keys.write_text(public_key)
    keys.chmod(0o600)
    for path in (home / ".ssh", keys):
        os.chown(path, home.stat().st_uid, home.stat().st_gid)

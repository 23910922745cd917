"""Build Debian arm64 for the emulated Pis, like a freshly flashed Raspberry Pi OS Lite. It is built once, then cached.

    with emulation():
        debian_image() / "root"      # /etc, /usr, ... of the Pi, owned by root; never written to

The packages are those of this machine's own Debian (12 or 13), which mmdebstrap installs. The image has nothing that
provision.yml must install.
"""

import os
from pathlib import Path

from lab.debian import debian_sources, make_arm64
from rover_lib.onboard.errors import RoverError
from rover_lib.workshop.cache import cache_folder, key_of
from rover_lib.workshop.run_program import run

USER = "pi"
PACKAGES = (
    *("debian-archive-keyring", "ca-certificates", "systemd", "systemd-sysv", "dbus", "udev", "libpam-systemd", "kmod"),
    *("procps", "openssh-server", "sudo", "python3", "python3-apt", "iproute2", "netbase", "less"),
)
RECIPE = 4  # raise it when the image is made in another way, so that older ones are not used
GROUPS = "adm,dialout,cdrom,sudo,audio,video,plugdev,games,users,input,render,netdev"  # of Raspberry Pi OS's user
# What Raspberry Pi Imager writes, but the host's name: a user with a key, and sudo without a password. Each boot of a
# copy makes its own machine-id.
PERSONALIZE = f"""
for group in {GROUPS.replace(",", " ")}; do getent group $group > /dev/null || groupadd --system $group; done
useradd --create-home --shell /bin/bash --groups {GROUPS} {USER}
install --owner={USER} --group={USER} --mode=700 --directory /home/{USER}/.ssh
install --owner={USER} --group={USER} --mode=600 /dev/stdin /home/{USER}/.ssh/authorized_keys
echo "{USER} ALL=(ALL) NOPASSWD: ALL" > /etc/sudoers.d/010_pi-nopasswd
chmod 440 /etc/sudoers.d/010_pi-nopasswd
: > /etc/machine-id
"""


def debian_image() -> Path:
    """Return the folder of the Pi's system, from the cache or made now, within emulation(), in some minutes.

    root: its file system. key: the private ssh key of USER, who may use sudo without a password. Raises RoverError.
    """
    recipe = {"made": [PACKAGES, PERSONALIZE, RECIPE], "debian": debian_sources()[0]}
    return cache_folder("pi-system", key_of(recipe), _make)


def _make(folder: Path) -> None:
    folder.chmod(0o755)
    run("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "emulated Pi", "-f", folder / "key", error=RoverError)
    hook = f"chroot \"$1\" sh -ec '{PERSONALIZE}' < {folder / 'key.pub'}"
    # emulation() has registered an emulator, which mmdebstrap would look for by a package of its own
    options = ("--mode=root", "--variant=required", "--skip=check/qemu", "--dpkgopt=force-unsafe-io")
    make_arm64(folder / "root", PACKAGES, *options, f"--customize-hook={hook}")
    os.utime(folder / "root/var/lib/apt/lists", (0, 0))  # empty: whoever asks apt must not take it for fresh

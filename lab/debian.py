"""Find and install the Debian packages that this machine lacks, and make arm64 systems of such packages."""

import os
import platform
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from rover_lib.onboard.errors import RoverError
from rover_lib.workshop.run_program import run

INSTALL = "ROVER_LAB_INSTALL"  # environment variable: 1 if missing packages may be installed, as --install says
NO_DEBIAN = "use a Debian 12 or 13 with the network, in a container if need be"


def missing_packages(needs: Mapping[str, str]) -> list[str]:
    """Return which of these Debian packages this machine lacks.

    needs: the package that each command, or each file by its absolute path, comes from.
    """
    folders = [*os.get_exec_path(), "/usr/sbin", "/sbin"]  # a user's PATH may lack root's
    missing = (package for name, package in needs.items() if not any(Path(f, name).exists() for f in folders))
    return sorted(set(missing))


def install_packages(packages: Sequence[str], what: str) -> None:
    """Install Debian packages, if there are any and the user asked for that. what: the thing that needs them.

    Raises RoverError.
    """
    if not packages:
        return
    command = ["apt-get", "install", "--yes", "--quiet", "--no-install-recommends", *packages]
    if os.environ.get(INSTALL) != "1" or os.geteuid() != 0 or not shutil.which("apt-get"):
        remedy = f"sudo {' '.join(command)}, or as root python -m lab --install"
        raise RoverError(f"{what} needs the Debian packages {' '.join(packages)}", remedy=remedy)
    print(f"installing Debian packages: {' '.join(packages)}", file=sys.stderr)
    run("apt-get", "update", "--quiet", error=RoverError)
    run(*command, error=RoverError, env={**os.environ, "DEBIAN_FRONTEND": "noninteractive"})


def debian_sources() -> tuple[str, str]:
    """Return the name of this machine's Debian, such as bookworm, and its sources as a sources.list. Raises RoverError.

    They are of that Debian alone, without what else apt knows here.
    """
    release = platform.freedesktop_os_release()
    if release["ID"] != "debian":
        raise RoverError("this needs the apt sources of a Debian 12 or 13", found=release["PRETTY_NAME"])
    name = release["VERSION_CODENAME"]
    listed = run("apt-get", "indextargets", "--format", "$(REPO_URI) $(RELEASE) $(COMPONENT)", "Identifier: Packages")
    suites = {name, f"{name}-updates", f"{name}-security"}
    return name, "".join(sorted({f"deb {line}\n" for line in listed.splitlines() if set(line.split()[1:2]) & suites}))


def make_arm64(root: Path, packages: Sequence[str], *options: str) -> None:
    """Make an arm64 system of this machine's Debian with these packages and what they need, by mmdebstrap.

    options: of mmdebstrap; --mode=chrootless --variant=extract only unpacks, and needs neither root nor an emulator.
    Raises RoverError if the packages cannot be had.
    """
    name, sources = debian_sources()
    words = ["mmdebstrap", "--quiet", "--architectures=arm64", f"--include={','.join(packages)}", *options]
    run(*words, name, root, "-", error=RoverError, remedy=NO_DEBIAN, input=sources)

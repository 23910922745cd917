"""Find and install the Debian packages that this machine lacks, and fetch arm64 packages without installing them."""

import os
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from rover_lib.onboard.errors import RoverError
from rover_lib.workshop.run_program import run

NO_DEBIAN = "use a Debian 12 or 13 with the network, in a container if need be"


def missing_packages(needs: Mapping[str, str]) -> list[str]:
    """Return which of these Debian packages this machine lacks.

    needs: the package that each command, or each file by its absolute path, comes from.
    """
    folders = [*os.get_exec_path(), "/usr/sbin", "/sbin"]  # a user's PATH may lack root's
    missing = (package for name, package in needs.items() if not any(Path(f, name).exists() for f in folders))
    return sorted(set(missing))


def install_packages(packages: Sequence[str], what: str) -> None:
    """Install Debian packages, if there are any. what: the thing that needs them. Raises RoverError."""
    if not packages:
        return
    command = ["apt-get", "install", "--yes", "--quiet", "--no-install-recommends", *packages]
    if os.geteuid() != 0 or not shutil.which("apt-get"):
        raise RoverError(f"{what} needs the Debian packages {' '.join(packages)}", remedy=f"sudo {' '.join(command)}")
    print(f"installing Debian packages: {' '.join(packages)}", file=sys.stderr)
    run("apt-get", "update", "--quiet", error=RoverError)
    run(*command, error=RoverError, env={**os.environ, "DEBIAN_FRONTEND": "noninteractive"})


def fetch_packages(folder: Path, packages: Sequence[str]) -> list[Path]:
    """Fetch arm64 packages and their dependencies as .deb files into a scratch folder; return their paths.

    apt uses this machine's sources and keys, but lists, cache and status in the folder. packages: names, or apt's
    patterns. Raises RoverError if they cannot be had.
    """
    for subfolder in ("lists/partial", "archives/partial"):
        (folder / subfolder).mkdir(parents=True)
    (folder / "status").touch()  # says that nothing is installed, so that apt fetches all dependencies
    options: dict[str, object] = {f"Dir::{name}": folder for name in ("State", "Cache", "Log")}
    options |= {"Dir::State::lists": folder / "lists", "Dir::State::status": folder / "status"}
    options |= {"Dir::Cache::archives": folder / "archives", "Dir::Cache::pkgcache": "", "Dir::Cache::srcpkgcache": ""}
    options |= {"APT::Architecture": "arm64", "APT::Architectures": "arm64", "APT::Sandbox::User": "root"}
    options |= {"Debug::NoLocking": "true"}
    apt = ["apt-get", "--quiet", *(f"--option={key}={value}" for key, value in options.items())]
    run(*apt, "update", error=RoverError, remedy=NO_DEBIAN)
    download = ["install", "--yes", "--download-only", "--no-install-recommends", *packages]
    run(*apt, *download, error=RoverError, remedy=NO_DEBIAN)
    return sorted((folder / "archives").glob("*.deb"))

"""What `rover --version` says: of this program, of Python, and of the engines that are installed. Imports no engine."""

import platform
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec

from rover_lib.onboard.artifact.engines import PACKAGES
from rover_lib.onboard.wheel_version import UNTAGGED


def versions() -> list[str]:
    """A line each for rover, Python and every engine's package."""
    lines = [f"rover {_version('rover-policy') or f'{UNTAGGED}, not installed'}", f"Python {platform.python_version()}"]
    for engine, package in PACKAGES.items():
        there = f"{package} {_version(package) or ''}".rstrip() if find_spec(package) else f"{package} is not installed"
        lines.append(f"engine {engine}: {there}")
    return lines


def _version(distribution: str) -> str | None:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return None

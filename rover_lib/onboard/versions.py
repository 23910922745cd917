"""What `rover --version` says: of this program, of Python, and of the engines that are installed. Imports no engine."""

import platform
from importlib.util import find_spec

from rover_lib.onboard.artifact.engines import PACKAGES
from rover_lib.onboard.stage import version_of
from rover_lib.onboard.wheel_version import UNTAGGED


def versions() -> list[str]:
    """A line each for rover, Python and every engine's package."""
    lines = [
        f"rover {version_of('rover-policy') or f'{UNTAGGED}, not installed'}",
        f"Python {platform.python_version()}",
    ]
    for engine, package in PACKAGES.items():
        there = (
            f"{package} {version_of(package) or ''}".rstrip() if find_spec(package) else f"{package} is not installed"
        )
        lines.append(f"engine {engine}: {there}")
    return lines

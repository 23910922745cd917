"""All that a Pi installs, in one folder, so that a rover without internet can be set up from a laptop.

rover_policy-<version>+<hash of its files>-py3-none-any.whl is rover_lib/onboard, nothing else; the others are as
requirements_pi.txt, or requirements_pi_onnxruntime.txt, and requirements_pi_view.txt pin and hash them.
"""

import os
import re
import shutil
import sys
import tempfile
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.wheel_version import ONBOARD, PACKAGE, wheel_version
from rover_lib.workshop.installed import SHIPPED
from rover_lib.workshop.run_program import run

PINS, ONNX_PINS = SHIPPED / "requirements_pi.txt", SHIPPED / "requirements_pi_onnxruntime.txt"
REQUIREMENTS = {"torch": PINS, "onnxruntime": ONNX_PINS}  # by engine
VIEW = SHIPPED / "requirements_pi_view.txt"  # with either, for `rover view`
PYTHONS = ("3.11", "3.13")  # of Debian 12 and 13, and of Raspberry Pi OS, which follows them
# The newest glibc that a wheel may ask for is Debian 12's 2.36; pip takes a list, not "at most".
PLATFORMS = [f"manylinux_2_{minor}_aarch64" for minor in range(17, 37)] + ["manylinux2014_aarch64"]


@dataclass(frozen=True)
class Wheelhouse:
    """wheel: the rover's own. version: its, with the hash of its files. changed: something new is in the folder."""

    wheel: Path
    version: str
    changed: bool


def make(folder: Path | str, *, only_rover: bool = False, engine: str = "torch") -> Wheelhouse:
    """Fill a folder with the rover's own wheel and those that it needs and that are not there. Raises RoverError.

    only_rover: no others, for Pis with internet. engine: of REQUIREMENTS.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    before = {p.name for p in folder.glob("*.whl")}
    wheel, version = _build(folder)
    if not only_rover:
        for python in PYTHONS:
            for requirements in (REQUIREMENTS[engine], VIEW):
                _fetch(folder, python, requirements)
    return Wheelhouse(wheel, version, {p.name for p in folder.glob("*.whl")} != before)


def _build(folder: Path) -> tuple[Path, str]:
    """The rover's own wheel in `folder`, and its version; older ones are removed."""
    version = wheel_version()
    wheel = folder / f"rover_policy-{version}-py3-none-any.whl"
    if wheel.exists():
        return wheel, version
    with tempfile.TemporaryDirectory() as built:
        # The same files make the same bytes: the zip has this date, whatever the user's environment says.
        environment = {**os.environ, "SOURCE_DATE_EPOCH": "315532800"}
        command = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", built]
        # As in a checkout, wherever this is installed: an installed package has no LICENSE above it.
        sources = Path(built, "sources")
        copied = sources / "rover_lib" / ONBOARD.name
        shutil.copytree(ONBOARD, copied, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(PACKAGE, copied.parent)
        shutil.copy(SHIPPED / "LICENSE", sources)
        run(*command, cwd=copied, env=environment, error=RoverError)
        for old in folder.glob("rover_policy-*.whl"):
            old.unlink()
        shutil.move(Path(built, wheel.name), wheel)
    return wheel, version


def _fetch(folder: Path, python: str, requirements: Path) -> None:
    lines = requirements.read_text().splitlines()
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as f:
        # Without conditions: pip would judge them by this machine's Python, not by the Pi's.
        f.write("\n".join(re.sub(r"\s;[^\\]*", " ", line) for line in lines) + "\n")
        f.flush()
        pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", "download", "--dest", folder]
        platforms = chain.from_iterable(("--platform", p) for p in PLATFORMS)
        target = ["--python-version", python, "--implementation", "cp", *platforms]
        pins = ["--require-hashes", "--no-deps", "--only-binary", ":all:", "--requirement", f.name]
        remedy = f"is there internet here? pip fetches the wheels of {requirements.name} for Python {python}"
        run(*pip, *target, *pins, error=RoverError, remedy=remedy)

"""All that a Pi installs, in one folder, so that a rover without internet can be set up from a laptop.

rover_policy-0.1.0+<hash of its sources>-py3-none-any.whl     rover_lib/onboard and the command line, nothing else
torch-2.8.0-cp313-...aarch64.whl, ...                          as requirements_pi.txt pins and hashes them
"""

import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from rover_lib.onboard.errors import RoverError

REPOSITORY = Path(__file__).parents[2]
REQUIREMENTS = "requirements_pi.txt"
PYTHONS = ("3.11", "3.13")  # of Debian 12 and 13, and of Raspberry Pi OS, which follows them
# The newest glibc that a wheel may ask for is Debian 12's 2.36; pip takes a list, not "at most".
PLATFORMS = [f"manylinux_2_{minor}_aarch64" for minor in range(17, 37)] + ["manylinux2014_aarch64"]
PARTS = ("__init__.py", "cli.py", "onboard/*.py")


class WheelhouseError(RoverError):
    """Wheels that are not to be had."""


@dataclass(frozen=True)
class Wheelhouse:
    """wheel: rover_lib's own. version: its, with the hash of its sources. changed: something new is in the folder."""

    wheel: Path
    version: str
    changed: bool


def make(folder: Path | str, *, pythons: Iterable[str] = PYTHONS, only_rover: bool = False) -> Wheelhouse:
    """Fill a folder with the Pi's wheels, and rover_lib's own; what is there already is not fetched again.

    pythons: the Pis'. only_rover: no others, for Pis with internet. Raises WheelhouseError.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    before = {p.name for p in folder.glob("*.whl")}
    wheel, version = _own(folder)
    if not only_rover:
        _others(folder, tuple(pythons))
    return Wheelhouse(wheel, version, {p.name for p in folder.glob("*.whl")} != before)


def sources() -> list[Path]:
    """The files of rover_lib that a Pi gets."""
    return sorted(p for part in PARTS for p in (REPOSITORY / "rover_lib").glob(part))


def own_version() -> str:
    """rover_lib's version with the hash of what a Pi gets of it: another content is another version to pip."""
    digest = hashlib.sha256()
    for path in [REPOSITORY / "pyproject.toml", *sources()]:
        digest.update(f"{path.relative_to(REPOSITORY)}\0".encode() + path.read_bytes() + b"\0")
    found = re.search(r'^version = "(.+)"$', (REPOSITORY / "pyproject.toml").read_text(), re.MULTILINE)
    return f"{found[1]}+{digest.hexdigest()[:12]}"


def _own(folder: Path) -> tuple[Path, str]:
    version = own_version()
    wheel = folder / f"rover_policy-{version}-py3-none-any.whl"
    if wheel.exists():
        return wheel, version
    with tempfile.TemporaryDirectory() as name:
        tree = Path(name, "tree")
        for path in [*sources(), REPOSITORY / "README.md", REPOSITORY / "LICENSE"]:
            target = tree / path.relative_to(REPOSITORY)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(path, target)
        project = (REPOSITORY / "pyproject.toml").read_text()
        (tree / "pyproject.toml").write_text(
            re.sub(r'^version = ".+"$', f'version = "{version}"', project, count=1, flags=re.MULTILINE)
        )
        built = Path(name, "built")
        # The same sources make the same bytes: no dates in the zip.
        _pip(["wheel", "--no-deps", "--wheel-dir", built, tree], "rover_lib's wheel", SOURCE_DATE_EPOCH="315532800")
        for old in folder.glob("rover_policy-*.whl"):
            old.unlink()
        shutil.move(next(built.glob("*.whl")), wheel)
    return wheel, version


def _others(folder: Path, pythons: tuple[str, ...]) -> None:
    lines = (REPOSITORY / REQUIREMENTS).read_text().splitlines()
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as f:
        # Without conditions: pip would judge them by this machine's Python, not by the Pi's.
        f.write("\n".join(re.sub(r"\s;[^\\]*", " ", line) for line in lines) + "\n")
        f.flush()
        for python in pythons:
            platforms = [o for p in PLATFORMS for o in ("--platform", p)]
            where = ["--dest", folder, "--python-version", python, "--implementation", "cp", *platforms]
            what = ["--require-hashes", "--no-deps", "--only-binary", ":all:", "--requirement", f.name]
            _pip(["download", *where, *what], f"the wheels of {REQUIREMENTS} for Python {python}")


def _pip(arguments: list[object], what: str, **environment: str) -> None:
    command = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", *map(str, arguments)]
    found = subprocess.run(command, capture_output=True, text=True, env={**os.environ, **environment})
    if found.returncode:
        last = (found.stderr.strip() or found.stdout.strip() or "it says nothing").splitlines()[-1]
        raise WheelhouseError(f"pip cannot make or fetch {what}: {last}; is there internet here?")

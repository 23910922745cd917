"""Virtual environments with our wheels."""

import contextlib
import importlib.metadata
import os
import re
import subprocess
import sys
import venv
from pathlib import Path

from rover_lib.workshop.wheelhouse import REQUIREMENTS

ROOT = Path(__file__).parents[2]
# Neither this checkout nor this environment is to be seen.
ELSEWHERE = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL_ENV", "COV"))}


def borrow(packages: Path, names: list[str]) -> None:
    """Link packages of this environment: installing torch takes minutes."""
    for name in names:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):  # only another Python needs it
            package = importlib.metadata.distribution(name)
            for top in {f.parts[0] for f in package.files or []} - {"..", "__pycache__"}:
                there, here = Path(str(package.locate_file(top))), packages / top
                if there.exists() and not here.exists():
                    here.symlink_to(there)


def required(engine: str) -> list[str]:
    """The names of what a Pi with that engine has."""
    return re.findall(r"^([\w.-]+)==", REQUIREMENTS[engine].read_text(), re.MULTILINE)


def with_needs(names: list[str]) -> list[str]:
    """Add what pip would install with these packages."""
    for name in names:  # it grows
        for need in importlib.metadata.requires(name) or []:
            needed = re.match(r"[\w.-]+", need)[0]
            if "extra ==" not in need and needed not in names:
                with contextlib.suppress(importlib.metadata.PackageNotFoundError):  # only elsewhere
                    names += [importlib.metadata.distribution(needed).name]
    return names


class Installed:
    """A virtual environment with one wheel of ours, and of others those that are named."""

    def __init__(self, folder: Path, wheel: Path, names: list[str]):
        self.folder, self.bin = folder, folder / "venv" / "bin"
        venv.create(folder / "venv", with_pip=False, symlinks=True)
        self.packages = next((folder / "venv" / "lib").glob("python3*/site-packages"))
        borrow(self.packages, names)
        pip = [sys.executable, "-m", "pip", "--python", self.bin / "python", "install", "--no-deps", "--no-index"]
        subprocess.run([*pip, "--quiet", "--disable-pip-version-check", wheel], check=True)

    def start(self, *command: object) -> subprocess.Popen:
        words = [str(self.bin / str(command[0])), *map(str, command[1:])]
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
        return subprocess.Popen(words, cwd=self.folder, env=ELSEWHERE, **pipes)

    def run(self, *command: object) -> subprocess.CompletedProcess:
        with self.start(*command) as process:
            texts = process.communicate()
        return subprocess.CompletedProcess(command, process.returncode, *texts)

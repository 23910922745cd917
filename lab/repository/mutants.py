"""Break single lines, each in a copy, and see that a named test fails: `make mutants`.

The lines are in planted/*.yml, a file for each subject. A row has a `name`, a `file`, the `good` text that stands in it
once, the `bad` text that takes its place, and the `test` file whose tests that match `words` (pytest's -k) must fail;
with `random: true`, random drives must notice it too. To add lines of another subject, add a file.

A line that can be broken unnoticed is a line that no test holds.
"""

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import Queue

import yaml

from lab.arduino.emulator import REPOSITORY
from rover_lib.onboard.errors import RoverError
from rover_lib.workshop.run_program import run

RANDOM_DRIVES = 2000
NOTICED = 3  # the exit code of random drives of which one breaks an invariant
DRIVE = f"""
from lab.driving.random_drives import random_drives
raise SystemExit({NOTICED} * any(random_drives(range(i, i + 100))["broken"] for i in range(0, {RANDOM_DRIVES}, 100)))
"""
PYTEST = ("-m", "pytest", "-q", "-x", "-p", "no:nbval", "-p", "no:cacheprovider", "-o", "addopts=--strict-markers")
PLANTED = Path(__file__).with_name("planted")


@dataclass(frozen=True)
class Mutant:
    """A line that is broken: a row of planted/*.yml."""

    name: str
    file: str
    good: str
    bad: str
    test: str
    words: str
    random: bool = False


def read_mutants() -> list[Mutant]:
    """Read the tables of mutants, in the order of their files' names."""
    tables = [yaml.safe_load(path.read_text()) for path in sorted(PLANTED.glob("*.yml"))]
    return [Mutant(**row) for table in tables for row in table]


def make_copy(folder: Path) -> None:
    """Copy the repository's files, those that git does not know yet too, into a folder."""
    listed = run("git", "-C", REPOSITORY, "ls-files", "-co", "--exclude-standard", error=RoverError)
    for name in filter(lambda name: (REPOSITORY / name).is_file(), listed.splitlines()):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(REPOSITORY / name, folder / name)


def exit_code(folder: Path, *arguments: str) -> int:
    """Run Python in a copy; return its exit code. Raises RoverError if what was planted cannot be compiled."""
    env = {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1", "ROVER_CACHE": str(folder / ".cache")}
    done = subprocess.run(
        [sys.executable, *arguments], cwd=folder, env=os.environ | env, capture_output=True, text=True, errors="replace"
    )
    if "gcc failed" in (said := done.stdout + done.stderr):
        raise RoverError("what was planted cannot be compiled", found=said[-2000:])
    return done.returncode


def try_mutants(
    mutants: Sequence[Mutant], jobs: int, drives: bool, say: Callable[[str], None]
) -> dict[str, int | list[str]]:
    """Plant each mutant and see whether its test fails, and with `drives` whether random drives notice it.

    say: called with a line for each. Returns how many there were, who survived, and how many random drives noticed.
    Raises RoverError if a mutant's line is not there, or if a named test does not pass without mutants.
    """
    for mutant in mutants:
        if (count := (REPOSITORY / mutant.file).read_text().count(mutant.good)) != 1:
            raise RoverError(f"{mutant.file}: {mutant.good!r} is there {count} times", remedy=f"mend {mutant.name!r}")
    with tempfile.TemporaryDirectory(prefix="rover-mutants-") as scratch, ThreadPoolExecutor(jobs) as pool:
        copies: Queue[Path] = Queue()
        for job in range(jobs):
            make_copy(Path(scratch, str(job)))
            copies.put(Path(scratch, str(job)))
        words = " or ".join(sorted({m.words for m in mutants}))
        if exit_code(copies.queue[0], *PYTEST, "-k", words, *sorted({m.test for m in mutants})):
            raise RoverError("the named tests fail without mutants", remedy="run them")

        def attempt(mutant: Mutant) -> tuple[bool, bool | None]:
            copy, begin_s = copies.get(), time.monotonic()
            path = copy / mutant.file
            good = path.read_text()
            try:
                path.write_text(good.replace(mutant.good, mutant.bad))
                caught = exit_code(copy, *PYTEST, "-k", mutant.words, mutant.test) == 1  # 5: no test has that name
                noticed = exit_code(copy, "-c", DRIVE) == NOTICED if drives and mutant.random else None
            finally:
                path.write_text(good)
                copies.put(copy)
            by_drives = {None: "", True: ", noticed by random drives", False: ", NOT noticed by random drives"}[noticed]
            seconds = time.monotonic() - begin_s
            say(f"{'caught' if caught else 'SURVIVED'}{by_drives}: {mutant.name} ({seconds:.0f} s)")
            return caught, noticed

        outcomes = dict(zip([m.name for m in mutants], pool.map(attempt, mutants), strict=True))
    survived = [name for name, (caught, noticed) in outcomes.items() if not caught or noticed is False]
    noticed = sum(noticed is True for _, noticed in outcomes.values())
    return {"mutants": len(outcomes), "survived": survived, "noticed_by_random_drives": noticed}

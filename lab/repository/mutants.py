"""Break single lines of the safety path, each in a copy, and see that a named test fails: `make mutants`.

A line that can be broken unnoticed is a line that no test holds. Where an invariant of the random drives is about the
line, they must notice it too, within RANDOM_DRIVES. Each worker has a copy of the repository, and a process that has
imported what all tests need: for each mutant it changes the file, forks, and runs the tests in the child.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from queue import Queue

import yaml

from lab.arduino.emulator import REPOSITORY
from rover_lib.onboard.errors import RoverError

RANDOM_DRIVES = 2000
MOST_S = 600  # for the tests of one mutant; a test that hangs has noticed it
MUTANTS = Path(__file__).with_suffix(".yml")


@dataclass(frozen=True)
class Mutant:
    """A line that is broken; mutants.yml says what the fields mean."""

    name: str
    file: str
    good: str
    bad: str
    test: str
    words: str
    random: bool = False


def read_mutants() -> list[Mutant]:
    """Read the table of mutants."""
    return [Mutant(**row) for row in yaml.safe_load(MUTANTS.read_text())]


@dataclass(frozen=True)
class Outcome:
    """What became of a mutant. caught: by its test. noticed: by random drives, None if they were not asked."""

    mutant: Mutant
    caught: bool
    noticed: bool | None
    seconds: float

    @property
    def survived(self) -> bool:
        return not self.caught or self.noticed is False

    def __str__(self) -> str:
        drives = {None: "", True: ", noticed by random drives", False: ", NOT noticed by random drives"}[self.noticed]
        return f"{'caught' if self.caught else 'SURVIVED'}{drives}: {self.mutant.name} ({self.seconds:.0f} s)"


WORKER = """
import json, os, sys
import cv2, numpy, pytest, hypothesis, serial
for line in sys.stdin:
    ask = json.loads(line)
    if not (child := os.fork()):
        sys.path.insert(0, os.getcwd())
        with open(ask["log"], "w") as log:
            os.dup2(log.fileno(), 1), os.dup2(log.fileno(), 2)
        code = 9
        try:
            if ask["pytest"]:
                code = int(pytest.main(ask["pytest"]))
            else:
                from lab.driving.random_drives import find_broken
                print(found := find_broken(range(ask["drives"])), flush=True)
                code = int(bool(found))
        finally:
            os._exit(code)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


class Copy:
    """A copy of the repository, and a process that runs tests in it; a context manager."""

    def __enter__(self) -> "Copy":
        self._stack = ExitStack()
        self.folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="rover-mutants-")))
        listed = subprocess.run(
            ["git", "ls-files", "-co", "--exclude-standard"], cwd=REPOSITORY, capture_output=True, text=True
        )
        for name in listed.stdout.split("\n"):
            if (
                name
                and not name.startswith(("results", "notebooks", "pictures", "docs"))
                and (REPOSITORY / name).is_file()
            ):
                (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(REPOSITORY / name, self.folder / name)
        cache = str(self.folder / ".cache")
        env = os.environ | {"PYTHONPATH": str(self.folder), "PYTHONDONTWRITEBYTECODE": "1", "ROVER_CACHE": cache}
        command = [sys.executable, "-c", WORKER]
        pipe = subprocess.PIPE
        self._worker = subprocess.Popen(command, cwd=self.folder, env=env, stdin=pipe, stdout=pipe, text=True)
        return self

    def __exit__(self, *exc: object) -> None:
        self._worker.kill()
        self._worker.communicate()
        self._stack.close()

    def run(self, files: Sequence[str], words: str) -> int:
        """Run the tests of those files that match `words`; return pytest's exit code."""
        options = ["-q", "-x", "-p", "no:nbval", "-p", "no:cacheprovider", "-o", "addopts=--strict-markers"]
        return self._ask(pytest=[*options, "-k", words, *files])

    def drive(self) -> bool:
        """Drive randomly; return whether an invariant was broken."""
        return self._ask(pytest=[], drives=RANDOM_DRIVES) == 1

    def _ask(self, **what: object) -> int:
        assert self._worker.stdin and self._worker.stdout
        self._worker.stdin.write(json.dumps({**what, "log": str(self.folder / "log.txt")}) + "\n")
        self._worker.stdin.flush()
        code = int(self._worker.stdout.readline())
        if code == 9 or "gcc failed" in self.log:
            raise RoverError("what was planted cannot run", found=self.log)
        return code

    @property
    def log(self) -> str:
        return (self.folder / "log.txt").read_text(errors="replace")[-2000:]


def try_mutants(mutants: Sequence[Mutant], jobs: int, drives: bool) -> list[Outcome]:
    """Plant each mutant and see whether its test fails, and with `drives` whether random drives notice it.

    Raises RoverError if a mutant's line is not there, or if a named test does not pass without mutants.
    """
    for mutant in mutants:
        if (count := (REPOSITORY / mutant.file).read_text().count(mutant.good)) != 1:
            raise RoverError(f"{mutant.file}: {mutant.good!r} is there {count} times", remedy=f"mend {mutant.name!r}")
    with ExitStack() as stack:
        copies: Queue[Copy] = Queue()
        for _ in range(jobs):
            copies.put(stack.enter_context(Copy()))
        copy = copies.get()
        words = " or ".join(sorted({m.words for m in mutants}))
        if copy.run(sorted({m.test for m in mutants}), words):
            raise RoverError("the named tests fail without mutants", found=copy.log)
        copies.put(copy)

        def attempt(mutant: Mutant) -> Outcome:
            copy, begin_s = copies.get(), time.monotonic()
            path = copy.folder / mutant.file
            good = path.read_text()
            try:
                path.write_text(good.replace(mutant.good, mutant.bad))
                caught = copy.run([mutant.test], mutant.words) == 1  # 5: no test has that name
                noticed = copy.drive() if drives and mutant.random else None
            finally:
                path.write_text(good)
                copies.put(copy)
            return Outcome(mutant, caught, noticed, time.monotonic() - begin_s)

        with ThreadPoolExecutor(jobs) as pool:
            return list(pool.map(attempt, mutants))

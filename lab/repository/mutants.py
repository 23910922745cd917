"""Plant slips, each in a copy, and see that a test fails: `make mutants`.

A program draws lines of the judging, quantizing, recording, learning and driving code, each file in proportion to its
lines, and plants a slip in each: a `<` becomes a `<=`, a 3 a 4, an `and` an `or`. cosmic-ray finds and makes the slips.
The tests that run are those of the file's name, then those that import it, then its room's, up to the first that
fails, or hangs; what failed must pass without slips. What survives needs a test, or a reason in survivors.yml.

What cosmic-ray cannot do stands in planted.yml: lines of the firmware, and lines that random drives must notice. A row
has a `name`, a `file`, the `good` text that stands in it once, the `bad` text that takes its place, and the `test` file
whose tests that match `words` (pytest's -k) must fail; with `random: true`, random drives must notice it too.
"""

import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from lab.arduino.emulator import REPOSITORY
from rover_lib.onboard.errors import RoverError
from rover_lib.workshop.run_program import run

SEED, RANDOM_DRIVES = 1, 2000
NOTICED = 3  # the exit code of random drives of which one breaks an invariant
DRIVE = f"""
from lab.driving.random_drives import random_drives
raise SystemExit({NOTICED} * any(random_drives(range(i, i + 100))["broken"] for i in range(0, {RANDOM_DRIVES}, 100)))
"""
PYTEST = ("-m", "pytest", "-q", "-x", "-p", "no:nbval", "-p", "no:cacheprovider", "-o", "addopts=--strict-markers")
FAST, SLOW = "not slow and not release and not emulated", "slow and not release"
ENDLESS = ("-o", "faulthandler_timeout=200", "-o", "faulthandler_exit_on_timeout=true")  # for a fast test; then caught
HANGS_S = 900.0  # a slip may make a loop endless; then it is caught
HERE = Path(__file__).parent
ROOMS = (
    *(f"rover_lib/workshop/{room}" for room in ("judge", "int8", "checkpoint", "recordings", "run")),
    *(f"rover_lib/onboard/{room}" for room in ("drive", "car", "policy", "artifact", "recording")),
    "rover_lib/onboard/care/release.py",
    "rover_learn",
    "rover_exchange",
)
# Slips that a person makes. Others of cosmic-ray fail at once: a decorator that is gone, or a + that becomes >>.
SLIPS = re.compile(
    r"core/(AddNot|NumberReplacer|ZeroIterationForLoop|Replace(TrueWithFalse|FalseWithTrue|AndWithOr|OrWithAnd"
    r"|BreakWithContinue|ContinueWithBreak|BinaryOperator_(Add_Sub|Sub_Add|Mul_Div|Div_Mul|FloorDiv_Div|Mod_FloorDiv"
    r"|Pow_Mul|BitAnd_BitXor|LShift_RShift|RShift_LShift)|UnaryOperator_(USub_UAdd|Delete_Not|Delete_USub)"
    r"|ComparisonOperator_(Lt_LtE|Lt_GtE|LtE_Lt|LtE_Gt|Gt_GtE|Gt_LtE|GtE_Gt|GtE_Lt|Eq_NotEq|NotEq_Eq|Is_IsNot|IsNot_Is)))"
)


@dataclass(frozen=True)
class Slip:
    """A line that cosmic-ray can break. occurrence: of the operator in the file."""

    file: str
    line: int
    operator: str
    occurrence: int
    random = False  # whether random drives must notice it

    def plant(self, good: str) -> str:
        """Return the file's text with the slip in it."""
        from cosmic_ray import mutating, plugins

        return mutating.mutate_code(good, plugins.get_operator(self.operator)(), self.occurrence) or good

    def name_in(self, good: str) -> str:
        """Say what becomes of the line."""
        before, after = (text.splitlines()[self.line - 1].strip() for text in (good, self.plant(good)))
        return f"{self.file}:{self.line}: {before}  ->  {after}"

    def runs(self) -> list[tuple[str, ...]]:
        """Return pytest's options for each run of tests that may notice it, slow tests last."""
        stages = tests_of(self.file)
        return [(*ENDLESS, "-m", FAST, *tests) for tests in stages] + [("-m", SLOW, *tests) for tests in stages]


def slips_in(file: str) -> list[Slip]:
    """Return all slips that may be planted in a file."""
    from cosmic_ray import ast, plugins

    nodes = list(ast.ast_nodes(ast.get_ast((REPOSITORY / file).read_text())))
    slips = []
    for name in filter(SLIPS.fullmatch, plugins.operator_names()):
        operator = plugins.get_operator(name)()
        lines = [start[0] for node in nodes for start, _ in operator.mutation_positions(node)]
        slips += [Slip(file, line, name, occurrence) for occurrence, line in enumerate(lines)]
    return slips


def draw_slips(count: int) -> list[Slip]:
    """Draw slips, files in proportion to their lines, one on a line. The first of a longer draw are the same."""
    paths = [path for room in ROOMS for path in sorted((REPOSITORY / room).rglob("*.py")) or [REPOSITORY / room]]
    files = [path.relative_to(REPOSITORY).as_posix() for path in paths]
    sizes = [len(path.read_text().splitlines()) for path in paths]
    slips = {file: slips_in(file) for file in files}
    chance = random.Random(SEED)
    drawn: dict[tuple[str, int], Slip] = {}
    while len(drawn) < count:
        (file,) = chance.choices(files, sizes)
        if lines := sorted({slip.line for slip in slips[file]}):
            line = chance.choice(lines)
            slip = chance.choice([slip for slip in slips[file] if slip.line == line])
            with suppress(SyntaxError):
                compile(slip.plant((REPOSITORY / file).read_text()), "a slip", "exec")
                drawn.setdefault((file, line), slip)
    return list(drawn.values())


def tests_of(file: str) -> list[list[str]]:
    """Return the tests that may notice a slip in a file, the likely first: of its name, that import it, of its room."""
    path = Path(file)
    tests, module = REPOSITORY / "tests", file.removesuffix(".py").replace("/", ".")
    room = tests / path.parent.as_posix().removeprefix("rover_lib/")
    package, _, stem = module.rpartition(".")
    imported = re.compile(rf"(from|import) {re.escape(module)}\b|from {re.escape(package)} import .*\b{stem}\b")
    stages: list[list[str]] = [[], [], []]
    for test in sorted(tests.rglob("test_*.py")):
        name = test.relative_to(REPOSITORY).as_posix()
        if test.name == f"test_{path.stem}.py":
            stages[0].append(name)
        elif imported.search(test.read_text()):
            stages[1].append(name)
        elif test.parent == room:
            stages[2].append(name)
    return [stage for stage in stages if stage]


@dataclass(frozen=True)
class Mutant:
    """A line that is broken by hand: a row of planted.yml."""

    name: str
    file: str
    good: str
    bad: str
    test: str
    words: str
    random: bool = False

    def plant(self, good: str) -> str:
        """Return the file's text with the broken line. Raises RoverError unless the line is there once."""
        if (count := good.count(self.good)) != 1:
            raise RoverError(f"{self.file}: {self.good!r} is there {count} times", remedy=f"mend {self.name!r}")
        return good.replace(self.good, self.bad)

    def name_in(self, good: str) -> str:
        """Return its name."""
        return self.name

    def runs(self) -> list[tuple[str, ...]]:
        """Return pytest's options for the tests that must notice it."""
        return [("-k", self.words, self.test)]


def read_mutants() -> list[Mutant]:
    """Read the table of mutants."""
    return [Mutant(**row) for row in yaml.safe_load((HERE / "planted.yml").read_text())]


@contextmanager
def broken_copy(file: str, change: Callable[[str], str]) -> Iterator[Path]:
    """Yield a copy of the repository's files, those that git does not know yet too, in which a file is changed."""
    listed = run("git", "-C", REPOSITORY, "ls-files", "-co", "--exclude-standard", error=RoverError)
    with tempfile.TemporaryDirectory(prefix="rover-mutant-") as scratch:
        folder = Path(scratch)
        for name in filter(lambda name: (REPOSITORY / name).is_file(), listed.splitlines()):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(REPOSITORY / name, folder / name)
        (folder / file).write_text(change((folder / file).read_text()))
        yield folder


def run_python(folder: Path, *arguments: str) -> tuple[int, str]:
    """Run Python in a copy; return its exit code, 1 if it hangs, and its output. RoverError if C cannot be compiled."""
    env = {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1", "ROVER_CACHE": str(folder / ".cache")}
    options: dict[str, Any] = {"cwd": folder, "env": os.environ | env, "capture_output": True, "timeout": HANGS_S}
    try:
        done = subprocess.run([sys.executable, *arguments], text=True, errors="replace", **options)
    except subprocess.TimeoutExpired:
        return 1, ""
    if "gcc failed" in (printed := done.stdout + done.stderr):
        raise RoverError("what was planted cannot be compiled", found=printed[-2000:])
    return done.returncode, printed


def try_mutants(mutants: Sequence[Slip | Mutant], jobs: int, say: Callable[[str], None]) -> tuple[int, list[str]]:
    """Plant each mutant in a copy and see whether a test fails; return how many were caught, and what survived.

    say: called with a line for each. What survivors.yml gives a reason for is not counted. A mutant that random drives
    must notice survives if they do not. Raises RoverError if a mutant's line is not there, or if a test that failed
    fails without mutants too.
    """
    reasons = {row["slip"] for row in yaml.safe_load((HERE / "survivors.yml").read_text()) or []}

    def attempt(mutant: Slip | Mutant) -> tuple[str, str | None]:
        begin_s = time.monotonic()
        with broken_copy(mutant.file, mutant.plant) as copy:
            failed = next(filter(None, (_failed(copy, options) for options in mutant.runs())), None)
            unnoticed = failed and mutant.random and run_python(copy, "-c", DRIVE)[0] != NOTICED
        name = mutant.name_in((REPOSITORY / mutant.file).read_text())
        outcome = f"caught by {failed}" if failed else "SURVIVED"
        outcome = "NOT noticed by random drives" if unnoticed else outcome
        say(f"{outcome}: {name} ({time.monotonic() - begin_s:.0f} s)")
        return name, None if unnoticed else failed

    with ThreadPoolExecutor(jobs) as pool:
        outcomes = list(pool.map(attempt, mutants))
    names = sorted({failed for _, failed in outcomes if failed})
    with broken_copy(mutants[0].file, str) as copy:
        for options, tests in (
            ((), [name for name in names if "::" in name]),
            (("--collect-only",), [name for name in names if "::" not in name]),  # could not be imported, or hung
        ):
            if tests and run_python(copy, *PYTEST, *options, *tests)[0]:
                raise RoverError("tests fail without mutants too", found=" ".join(tests), remedy="make test-fast")
    survived = [name for name, failed in outcomes if not failed]
    caught = len(outcomes) - len(survived)
    # In survivors.yml a line has no number, which changes.
    return caught, [name for name in survived if re.sub(r":\d+:", ":", name, count=1) not in reasons]


def _failed(copy: Path, options: Sequence[str]) -> str | None:
    """Return the first test of such a run that fails in a copy, the run's last file if it names none, or None."""
    code, printed = run_python(copy, *PYTEST, *options)
    if code in (0, 5):  # 5: no test has that name
        return None
    match = re.search(r"^(?:FAILED|ERROR) ([^\s[]+)", printed, re.MULTILINE)
    return match[1] if match else options[-1]

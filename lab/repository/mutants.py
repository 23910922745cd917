"""Plant slips, one at a time, and see that a test fails: `make mutants`.

A program draws lines of the judging, quantizing, recording, learning and driving code, each file in proportion to its
lines, and plants a slip in each: a `<` becomes a `<=`, a 3 a 4, an `and` an `or`. cosmic-ray finds and makes the slips.
The tests that reach the line run first, the shortest first, then those of the file's name, up to the first that fails,
or hangs; what failed must pass without slips. What survives needs a test, or a reason in survivors.yml.

Each job has one copy of the repository, and there a process that has imported torch and LeRobot once and forks for each
run of tests. Which tests reach which line is measured once, and kept in runs/mutants until a file changes.

What cosmic-ray cannot do stands in planted.yml: lines of the firmware, and lines that random drives must notice. A row
has a `name`, a `file`, the `good` text that stands in it once, the `bad` text that takes its place, and the `test` file
whose tests that match `words` (pytest's -k) must fail; with `random: true`, random drives must notice it too.
"""

import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from importlib.util import cache_from_source
from itertools import chain
from pathlib import Path
from subprocess import PIPE
from typing import Any
from xml.etree import ElementTree

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
HANGS_S = 900  # a slip may make a loop endless; then it is caught
# Runs pytest in a forked process for each line of its input, options as JSON, and prints its exit code.
SERVER = f"""
import json, os, signal, sys
import cv2, hypothesis, lerobot.policies.act.modeling_act, pandas, pytest, torch, torchvision
for line in sys.stdin:
    if not (child := os.fork()):
        os.setpgid(0, 0)
        signal.alarm({HANGS_S})
        log = os.open("pytest.log", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(log, 1)
        os.dup2(log, 2)
        sys.exit(int(pytest.main(json.loads(line))))
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""
PYTEST = ("-q", "-x", "-p", "no:nbval", "-p", "no:cacheprovider", "-o", "addopts=--strict-markers")
FAST, SLOW = "not slow and not release and not emulated", "slow and not release"
MAPPED = ("tests/onboard", "tests/workshop", "tests/rover_learn", "tests/rover_exchange")
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
class Mutant:
    """A file with a broken line. name: says which. text: the whole file's. random: random drives must notice it too.

    runs: pytest's options for each run of tests that may notice it, slow tests last.
    """

    name: str
    file: str
    text: str
    runs: Sequence[Sequence[str]]
    random: bool = False


def read_mutants() -> list[Mutant]:
    """Read planted.yml. Raises RoverError for a line that is not there once."""
    mutants = []
    for row in yaml.safe_load((HERE / "planted.yml").read_text()):
        good = (REPOSITORY / row["file"]).read_text()
        if (count := good.count(row["good"])) != 1:
            raise RoverError(f"{row['file']}: {row['good']!r} is there {count} times", remedy=f"mend {row['name']!r}")
        text = good.replace(row["good"], row["bad"])
        runs = [("-k", row["words"], row["test"])]
        mutants.append(Mutant(row["name"], row["file"], text, runs, row.get("random", False)))
    return mutants


def slips_in(code: str) -> dict[int, list[tuple[Any, int]]]:
    """Return by line the slips that may be planted in a file: cosmic-ray's operator, and which of its places."""
    from cosmic_ray import ast, plugins

    nodes = list(ast.ast_nodes(ast.get_ast(code)))
    slips: dict[int, list[tuple[Any, int]]] = {}
    for name in filter(SLIPS.fullmatch, plugins.operator_names()):
        operator = plugins.get_operator(name)()
        lines = [start[0] for node in nodes for start, _ in operator.mutation_positions(node)]
        for occurrence, line in enumerate(lines):
            slips.setdefault(line, []).append((operator, occurrence))
    return slips


def drawn_files() -> list[Path]:
    """Return the files that slips are drawn from."""
    return [path for room in ROOMS for path in sorted((REPOSITORY / room).rglob("*.py")) or [REPOSITORY / room]]


def draw_slips(count: int) -> list[Mutant]:
    """Draw slips, files in proportion to their lines, one on a line. The first of a longer draw are the same."""
    from cosmic_ray import mutating

    files = {path.relative_to(REPOSITORY).as_posix(): path.read_text() for path in drawn_files()}
    sizes = [len(code.splitlines()) for code in files.values()]
    slips = {file: slips_in(code) for file, code in files.items()}
    chance = random.Random(SEED)
    drawn: dict[tuple[str, int], Mutant] = {}
    while len(drawn) < count:
        (file,) = chance.choices(list(files), sizes)
        if not slips[file]:
            continue
        line = chance.choice(sorted(slips[file]))
        text = mutating.mutate_code(files[file], *chance.choice(slips[file][line])) or files[file]
        before, after = (code.splitlines()[line - 1].strip() for code in (files[file], text))
        with suppress(SyntaxError):
            compile(text, "a slip", "exec")
            name = f"{file}:{line}: {before}  ->  {after}"
            drawn.setdefault((file, line), Mutant(name, file, text, runs_of(file, line)))
    return list(drawn.values())


def runs_of(file: str, line: int) -> list[tuple[str, ...]]:
    """Return pytest's options for the tests that reach a line, and for all in the test file of its file's name."""
    own = [
        path.relative_to(REPOSITORY).as_posix() for path in (REPOSITORY / "tests").rglob(f"test_{Path(file).stem}.py")
    ]
    runs = [(FAST, tests_that_reach(file, line)), (FAST, own), (SLOW, own)]
    return [("-m", marks, *tests) for marks, tests in runs if tests]


@cache
def measure_tests() -> tuple[Any, dict[str, float]]:
    """Return the coverage of each fast test, and the seconds of each that passes; measured once for these files."""
    from coverage import CoverageData

    key = sha256(b"".join(path.read_bytes() for path in drawn_files())).hexdigest()[:12]
    folder = REPOSITORY / "runs" / "mutants" / key
    report, coverage = folder / "tests.xml", folder / "coverage"
    if not report.exists():
        packages = [f"--cov={name}" for name in ("rover_lib", "rover_learn", "rover_exchange")]
        options = ("--cov-context=test", "--cov-report=", "--junit-xml", str(report), "-m", FAST, *MAPPED)
        command = [sys.executable, "-m", "pytest", *PYTEST, "--maxfail=1000", *packages, *options]
        subprocess.run(command, cwd=REPOSITORY, env=os.environ | {"COVERAGE_FILE": str(coverage)}, stdout=sys.stderr)
    data, seconds = CoverageData(str(coverage)), {}
    data.read()
    for case in ElementTree.parse(report).iter("testcase"):
        if not len(case):  # else it was skipped, or failed
            seconds[f"{case.get('classname', '').replace('.', '/')}.py::{case.get('name')}"] = float(
                case.get("time", 0)
            )
    return data, seconds


def tests_that_reach(file: str, line: int) -> list[str]:
    """Return the tests that reach a line, the shortest first; those that reach its file if it runs at import."""
    data, seconds = measure_tests()
    contexts = data.contexts_by_lineno(str(REPOSITORY / file))
    for lines in ([line], contexts):
        names = {context.rpartition("|")[0] for number in lines for context in contexts.get(number, ())}
        if tests := names & seconds.keys():
            return sorted(tests, key=seconds.__getitem__)
    return []


class Bench:
    """A copy of the repository in a folder, and a process that runs its tests there."""

    def __init__(self, folder: Path):
        self.folder = folder
        listed = run("git", "-C", REPOSITORY, "ls-files", "-co", "--exclude-standard", error=RoverError)
        for name in filter(lambda name: (REPOSITORY / name).is_file(), listed.splitlines()):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(REPOSITORY / name, folder / name)
        self._env = os.environ | {"PYTHONPATH": str(folder), "ROVER_CACHE": str(folder / ".cache")}
        self._server = subprocess.Popen(
            [sys.executable, "-c", SERVER], stdin=PIPE, stdout=PIPE, text=True, cwd=folder, env=self._env
        )

    def write(self, file: str, text: str) -> None:
        """Write a file of the copy, and forget its bytecode, which may look as new as the file."""
        (self.folder / file).write_text(text)
        Path(cache_from_source(str(self.folder / file))).unlink(missing_ok=True)

    def failed(self, options: Sequence[str]) -> str | None:
        """Run pytest; return the first test that fails, the last option if none is named, or None.

        Raises RoverError if C cannot be compiled, or a test is not there.
        """
        assert self._server.stdin and self._server.stdout, "they are pipes"
        print(json.dumps([*PYTEST, *options]), file=self._server.stdin, flush=True)
        code = int(self._server.stdout.readline())
        printed = (self.folder / "pytest.log").read_text(errors="replace")
        if "gcc failed" in printed or ("ERROR: not found" in printed and "ERROR collecting" not in printed):
            raise RoverError("its tests cannot be run", found=printed[-2000:])
        if code in (0, 5):  # 5: no test has that name
            return None
        match = re.search(r"^(?:FAILED|ERROR) ([^\s[]+)", printed, re.MULTILINE)
        return match[1] if match else options[-1]

    def drives_notice(self) -> bool:
        """Return whether random drives break an invariant."""
        return subprocess.run([sys.executable, "-c", DRIVE], cwd=self.folder, env=self._env).returncode == NOTICED


def try_mutants(mutants: Sequence[Mutant], jobs: int, say: Callable[[str], None]) -> tuple[int, list[str]]:
    """Plant each mutant in a copy and see whether a test fails; return how many were caught, and what survived.

    say: called with a line for each. What survivors.yml gives a reason for is not counted. A mutant that random drives
    must notice survives if they do not. Raises RoverError if a test that failed fails without mutants too.
    """
    reasons = {row["slip"] for row in yaml.safe_load((HERE / "survivors.yml").read_text()) or []}
    with ThreadPoolExecutor(jobs) as pool:
        shares = pool.map(lambda share: _try_share(share, say), [mutants[i::jobs] for i in range(jobs)])
        outcomes = list(chain.from_iterable(shares))
    survived = [name for name, failed in outcomes if not failed]
    # In survivors.yml a line has no number, which changes.
    unexplained = [name for name in survived if re.sub(r":\d+:", ":", name, count=1) not in reasons]
    return len(outcomes) - len(survived), unexplained


def _try_share(mutants: Sequence[Mutant], say: Callable[[str], None]) -> list[tuple[str, str | None]]:
    """Return each mutant's name, and the test that failed for it, if one did."""
    outcomes = []
    with tempfile.TemporaryDirectory(prefix="rover-mutant-") as folder:
        bench = Bench(Path(folder))
        for mutant in mutants:
            begin_s = time.monotonic()
            bench.write(mutant.file, mutant.text)
            failed = next(filter(None, map(bench.failed, mutant.runs)), None)
            unnoticed = failed and mutant.random and not bench.drives_notice()
            bench.write(mutant.file, (REPOSITORY / mutant.file).read_text())
            outcome = f"caught by {failed}" if failed else "SURVIVED"
            outcome = "NOT noticed by random drives" if unnoticed else outcome
            say(f"{outcome}: {mutant.name} ({time.monotonic() - begin_s:.0f} s)")
            outcomes.append((mutant.name, None if unnoticed else failed))
        names = sorted({failed for _, failed in outcomes if failed and "::" in failed})
        if names and (failed := bench.failed(names)):
            raise RoverError("a test fails without mutants too", found=failed, remedy="make test-fast")
    return outcomes

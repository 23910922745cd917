"""What the notebooks' parameters may be, whether a cell, `rover run -p` or params.yml sets them."""

import ast
import sys
from collections.abc import Callable
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

from rover_lib.onboard.car.host import usable_cores
from rover_lib.onboard.checked import Rule, broken_rule, is_number, number, of_type, whole
from rover_lib.onboard.errors import ParamsError
from rover_lib.workshop.int8.scheme import MODES, OBSERVERS

MOST = 1_000_000
INJECTED = "# Parameters\n"  # how papermill's cell begins, after the notebook's own
DEFAULT, DEMO = "../runs/", "../runs/demo"  # how the notebooks' defaults begin
FILES = ("run_dir", "checkpoint", "episodes")  # in notebook 01, of one run


def _is_path(value: Any) -> bool:
    return isinstance(value, str | Path) and str(value).strip() != ""


def _list_of(words: str, holds: Callable[[Any], bool]) -> Rule:
    """The rule of a list of values each of which holds."""
    return Rule(lambda v: isinstance(v, list | tuple) and all(map(holds, v)), f"a list of {words}")


BLOCKS = _list_of('names, as in ["backbone.stem"], or None', lambda v: isinstance(v, str))
DELAYS = _list_of("milliseconds, as in [0, 150]", lambda v: is_number(v, 0, MOST))
OBSERVED = _list_of("histogram, minmax or both, and frames", lambda v: v in OBSERVERS)
RULES = {
    **dict.fromkeys(("checkpoint", "episodes", "rovers"), Rule(_is_path, "a path")),
    "run_dir": Rule(lambda v: _is_path(v) and not Path(v).is_file(), "a folder's path"),
    **dict.fromkeys(("action_names", "camera", "facts"), of_type(str)),
    "throttle": Rule(lambda v: v in ("", "as-recorded", "negated"), "as-recorded, negated or empty"),
    **dict.fromkeys(("samples", "choosing_frames", "iterations"), whole(1, MOST)),
    "held_out_frames": whole(2, MOST),  # whose pictures are swapped
    **dict.fromkeys(("seed", "worlds", "pushes"), whole(0, MOST)),
    "threads": whole(0, usable_cores()),
    "level": Rule(lambda v: v in ("easy", "hard"), "easy or hard"),
    "smooth": number(0, 1),
    "observers": OBSERVED._replace(holds=lambda v: OBSERVED.holds(v) and any(name != "frames" for name in v)),
    "modes": _list_of(f"any of {', '.join(MODES)}", lambda v: v in MODES),
    "float_blocks": BLOCKS._replace(holds=lambda v: v is None or BLOCKS.holds(v)),
    **dict.fromkeys(("latencies_ms", "pushed_latencies_ms"), DELAYS),
    "students": _list_of("paths", _is_path),
}


def check_parameters(**turned: Any) -> None:
    """Check a notebook's parameters before anything uses them.

    Raises ParamsError, which names the parameter and what it may be, for the first that is something else; for names
    that papermill was given and the notebook does not have; and where some of its files would be the defaults'.
    """
    own, passed = _parameters_here()
    if unknown := sorted(passed.keys() - own.keys()):
        raise ParamsError(f"no parameter {', '.join(unknown)}", remedy=f"known are {', '.join(own)}")
    missing = [name for name, value in own.items() if passed and name not in passed and _is_of_a_run(value)]
    if missing:
        names = " and ".join(missing)
        problem = f"{', '.join(passed)} was passed, and {names} would be another run's, the notebook's default"
        raise ParamsError(problem, found=own[missing[0]], remedy=f"pass {names} too")
    if broken := broken_rule(turned, {name: RULES[name] for name in turned}):
        name, rule, actual = broken
        remedy = "set it in the notebook, by -p, or in params.yml"
        raise ParamsError(f"the parameter {name} must be {rule}", found=actual, remedy=remedy)
    files = {name: str(turned[name]).startswith(DEMO) for name in FILES if "checkpoint" in turned}
    if not passed and len(set(files.values())) > 1:
        default = next(name for name, of_default in files.items() if of_default)
        remedy = f"set {', '.join(files)}; if you mean the demo's, by its whole path"
        problem = f"the parameter {default} is still the notebook's default"
        raise ParamsError(problem, found=turned[default], remedy=remedy)


def _is_of_a_run(value: Any) -> bool:
    """Whether a default, or the first of several, is a run's folder or in one."""
    first = value[0] if isinstance(value, list) and value else value
    return isinstance(first, str) and first.startswith(DEFAULT)


def _parameters_here() -> tuple[dict[str, Any], dict[str, Any]]:
    """Return what the parameters cell of the notebook in this kernel sets, and what papermill's cell after it sets.

    Both are empty where papermill was given nothing.
    """
    shell = sys.modules["IPython"].get_ipython() if "IPython" in sys.modules else None
    cells = shell.user_ns.get("In", []) if shell else []
    for before, cell in pairwise(cells):
        if cell.startswith(INJECTED):
            return _assigned(before), _assigned(cell)
    return {}, {}


def _assigned(source: str) -> dict[str, Any]:
    """Return the names that a cell of literals sets, and their values; None for what is no literal."""
    literals = {}
    for line in ast.parse(source).body:
        if isinstance(line, ast.Assign) and isinstance(line.targets[0], ast.Name):
            value = None
            with suppress(ValueError):
                value = ast.literal_eval(line.value)
            literals[line.targets[0].id] = value
    return literals

"""What the notebooks' parameters may be, whether a cell, `rover run -p` or params.yml sets them."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from rover_lib.onboard.car.host import usable_cores
from rover_lib.onboard.checked import Rule, broken_rule, is_number, number, of_type, whole
from rover_lib.onboard.errors import ParamsError
from rover_lib.workshop.int8.scheme import MODES, OBSERVERS

MOST = 1_000_000


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
    "smooth": number(0, 1),
    "observers": OBSERVED._replace(holds=lambda v: OBSERVED.holds(v) and any(name != "frames" for name in v)),
    "modes": _list_of(f"any of {', '.join(MODES)}", lambda v: v in MODES),
    "float_blocks": BLOCKS._replace(holds=lambda v: v is None or BLOCKS.holds(v)),
    **dict.fromkeys(("latencies_ms", "pushed_latencies_ms"), DELAYS),
    "students": _list_of("paths", _is_path),
}


def check_parameters(**turned: Any) -> None:
    """Raise ParamsError, which names the parameter and what it may be, for the first that is something else."""
    if broken := broken_rule(turned, {name: RULES[name] for name in turned}):
        name, wanted, found = broken
        remedy = "set it in the notebook, by -p, or in params.yml"
        raise ParamsError(f"the parameter {name} must be {wanted}", found=found, remedy=remedy)

"""Measured figures held against what was promised.

rows = check_gates(metrics, params()["gates"]["original"])
"""

from collections.abc import Mapping
from typing import Any

from rover_lib.onboard.checked import is_number
from rover_lib.onboard.errors import ParamsError

HIGHER_IS_BETTER = ("throughput_fps", "control_rate_hz")
GATE_KEYS = {"memory_mb": "peak_memory_mb", "model_size_mb": "size_mb"}  # gates that go by another name in a benchmark


def check_gates(metrics: Mapping[str, Any], gates: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Hold measured figures against gates: one {gate, limit, found, passed} each; passed is None if not measured.

    A gate is a number or a [low, high] range that was promised. Doing better than promised passes: a latency need only
    not be above its range, a rate not below it. A single number must be stayed under (rates: reached). A text, such as
    throttled "0x0", must be equal. Raises ParamsError for a gate that is none of these.
    """
    rows = []
    for gate, limit in gates.items():
        value = metrics.get(gate, metrics.get(GATE_KEYS.get(gate, gate)))
        rows.append({"gate": gate, "limit": limit, "found": value, "passed": _passes(gate, value, limit)})
    return rows


def _passes(gate: str, value: Any, limit: Any) -> bool | None:
    if isinstance(limit, str):
        return None if value is None else bool(value == limit)
    ends = limit if isinstance(limit, list) else [limit]
    if not all(map(is_number, ends)) or len(ends) not in (1, 2) or ends != sorted(ends):
        what = f"gate {gate} must be a number, [low, high] or a text"
        raise ParamsError(what, found=repr(limit), remedy="see params.yml")
    if value is None:
        return None
    if gate in HIGHER_IS_BETTER:
        return bool(value >= ends[0])
    return bool(value <= ends[-1] if len(ends) == 2 else value < ends[0])

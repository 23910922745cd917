"""Decide by a fixed rule whether a policy is better than before, on held-out episodes.

    found = verdict(rows)

Whole episodes are compared and not single frames, because the frames of one drive are alike. A policy is *better* if
its error fell significantly on the new held-out episodes, and did not rise significantly on the old ones. That is
computed by Fisher's randomisation test: if only chance were at work, each episode's difference could equally well have
had the other sign. The test needs at least six episodes of a kind.
"""

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np

from rover_lib.workshop.judge.recorded_range import format_pct

CHANCE = 0.05
LEAST_EPISODES = 6  # with 5, all changed the same way, the chance is 2 in 32
EXACT = 12  # most episodes for which all 2 ** 12 combinations of signs are tried; else DRAWN at random
DRAWN = 10_000
OLD, NEW = KINDS = ("old", "new")


def change_points(row: Mapping[str, Any]) -> float:
    """Return the change of an episode's error (after - before), the mean of the judged actions. Below 0 is better.

    row: before_<action>_pct and after_<action>_pct, mean absolute errors in percent of the action's recorded range;
    None for an action that never changes.
    """
    actions = [key.removeprefix("before_") for key in row if key.startswith("before_")]
    pairs = [(row[f"before_{action}"], row[f"after_{action}"]) for action in actions]
    changes = [after - before for before, after in pairs if before is not None and after is not None]
    return float(np.mean(changes)) if changes else 0.0


def chance_of(changes: Sequence[float]) -> float:
    """The two-sided p-value: how often changes with random signs have a mean at least as far from 0."""
    found = np.asarray(changes, float)
    if len(found) <= EXACT:
        signs = np.array(list(product((-1.0, 1.0), repeat=len(found))))
    else:
        drawn = np.random.default_rng(0).choice([-1.0, 1.0], (DRAWN, len(found)))
        signs = np.vstack([np.ones(len(found)), drawn])
    least = abs(found.sum()) * (1 - 1e-9)  # the last bit of a sum depends on the order of adding
    return float((np.abs(signs @ found) >= least).mean())


def verdict(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return {"better": True, False, or None if it cannot be decided, "why", "kinds": the figures of each kind}.

    rows: of held-out episodes, each with its `kind`, OLD or NEW, and its errors as `change_points` takes them.
    """
    kinds: dict[str, Any] = {}
    for kind in KINDS:
        changes = [change_points(row) for row in rows if row["kind"] == kind]
        kinds[kind] = {
            "episodes": len(changes),
            "change_points": float(np.mean(changes)) if changes else None,
            "chance": chance_of(changes) if changes else None,
        }
    better, why = _judge(kinds)
    return {"better": better, "why": why, "kinds": kinds}


def _judge(kinds: Mapping[str, Any]) -> tuple[bool | None, str]:
    few = [f"{kinds[k]['episodes']} {k}" for k in KINDS if kinds[k]["episodes"] < LEAST_EPISODES]
    if few:
        return None, f"undecided: only {' and '.join(few)} held-out episodes, of at least {LEAST_EPISODES} each"
    moved = {kind: kinds[kind]["change_points"] for kind in KINDS if kinds[kind]["chance"] < CHANCE}
    if moved.get(OLD, 0) > 0:
        return False, f"not better: on the old episodes it is {moved[OLD]:.2f} points further from the human"
    if moved.get(NEW, 0) > 0:
        return False, f"worse: on the new episodes it is {moved[NEW]:.2f} points further from the human"
    if NEW not in moved:
        return None, "undecided: on the new episodes the difference may be chance"
    why = f"better: on the new episodes it is {-moved[NEW]:.2f} points nearer to the human, and no worse on the old"
    return True, why


def summary(content: Mapping[str, Any]) -> str:
    """The content of finetune.json as text for people."""
    metrics = content["metrics"]
    lines = ["frames: " + ", ".join(f"{n} {kind.replace('_', ' ')}" for kind, n in metrics["learned_from"].items())]
    for row in metrics["held_out"]:
        errors = [f"{key.removesuffix('_pct')} {format_pct(row[key]).strip()}" for key in row if key.endswith("_pct")]
        lines.append(f"{row['kind']} {row['episode']}, error: {', '.join(errors)}".replace("_", " "))
    return "\n".join([*lines, metrics["verdict"]["why"], *metrics["warnings"]])

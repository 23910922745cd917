"""Is a policy better than before? By rule, over whole held-out episodes: frames of one drive are alike.

    found = verdict(judged)

The rule: an episode's error is the mean of its actions' errors. It is *better* if on the new held-out episodes that
error fell, and chance would make it fall or rise as much in less than 5 of 100 cases, and if on the old ones it did not
rise in that sense. Chance: each episode's difference might as well have had the other sign (Fisher's randomisation
test), which needs at least six episodes of a kind to say anything.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from rover_lib.workshop.judge import shown_pct

CHANCE = 0.05
LEAST_EPISODES = 6  # of 5, all alike, chance makes 2 in 32
EXACT = 12  # episodes at most for which all 2 ** 12 ways are counted; for more, DRAWN of them
DRAWN = 10_000
KINDS = ("old", "new")


@dataclass(frozen=True)
class Judged:
    """A held-out episode. kind: 'old' or 'new'. frames: that judged. before, after: by action, mean absolute error in
    percent of the recorded range; None for an action that never changes.
    """

    name: str
    kind: str
    frames: int
    before: Mapping[str, float | None]
    after: Mapping[str, float | None]

    def row(self) -> dict[str, Any]:
        """The same as plain JSON types."""
        errors: dict[str, float | None] = {}
        for action, before in self.before.items():
            errors |= {f"before_{action}_pct": before, f"after_{action}_pct": self.after[action]}
        return {"episode": self.name, "kind": self.kind, "frames": self.frames, **errors}

    @property
    def change_points(self) -> float:
        """After less before, mean over the actions that are judged: below 0 is better."""
        changes = [after - before for before, after in zip(self.before.values(), self.after.values(), strict=True)
                   if before is not None and after is not None]  # fmt: skip
        return float(np.mean(changes)) if changes else 0.0


def chance_of(changes: Sequence[float]) -> float:
    """How often differences of random sign have a mean at least as far from 0, two-sided. 1 for none.

    Of ways that are drawn, the one that was found is one more: chance is never 0.
    """
    found = np.asarray(changes, float)
    if not len(found):
        return 1.0
    if len(found) <= EXACT:
        signs = np.array(list(product((-1.0, 1.0), repeat=len(found))))
    else:
        drawn = np.random.default_rng(0).choice([-1.0, 1.0], (DRAWN, len(found)))
        signs = np.vstack([np.ones(len(found)), drawn])
    least = abs(found.sum()) * (1 - 1e-9)  # sums differ in their last bit by the order in which they are made
    return float((np.abs(signs @ found) >= least).mean())


def verdict(judged: Sequence[Judged]) -> dict[str, Any]:
    """{"better": true, false, or None where that cannot be said, "why", "rule", "kinds": of each its figures}."""
    kinds: dict[str, Any] = {}
    for kind in KINDS:
        changes = [each.change_points for each in judged if each.kind == kind]
        kinds[kind] = {
            "episodes": len(changes),
            "better": sum(c < 0 for c in changes),
            "worse": sum(c > 0 for c in changes),
            "change_points": float(np.mean(changes)) if changes else None,
            "chance": chance_of(changes) if changes else None,
        }
    better, why = _said(kinds)
    rule = (
        f"better: on new held-out episodes nearer to the human than chance explains (randomisation test over episodes, "
        f"below {CHANCE:g}), and on old ones not further away in that sense; at least {LEAST_EPISODES} of each"
    )
    return {"better": better, "why": why, "rule": rule, "kinds": kinds}


def _said(kinds: Mapping[str, Any]) -> tuple[bool | None, str]:
    few = [f"{kinds[k]['episodes']} {k}" for k in KINDS if kinds[k]["episodes"] < LEAST_EPISODES]
    if few:
        return None, (
            f"not to be said whether it is better: held out were only {' and '.join(few)} episodes, and below "
            f"{LEAST_EPISODES} of a kind chance explains everything; record more, or let it drive"
        )
    moved = {kind: kinds[kind]["change_points"] for kind in KINDS if kinds[kind]["chance"] < CHANCE}
    if moved.get("old", 0) > 0:
        return False, f"not better: on the old episodes it is {moved['old']:.2f} points further from the human"
    if moved.get("new", 0) > 0:
        return False, f"worse: on the new episodes it is {moved['new']:.2f} points further from the human"
    if "new" not in moved:
        return None, "not to be said whether it is better: on the new episodes the difference is within chance"
    return (
        True,
        f"better: on the new episodes it is {-moved['new']:.2f} points nearer to the human, and no worse on the old",
    )


def summary(content: Mapping[str, Any]) -> str:
    """finetune.json as people read it."""
    metrics = content["metrics"]
    learned = metrics["learned_from"]
    lines = [
        f"learned from {learned['demonstrations']} frames of old demonstrations, {learned['new_demonstrations']} of "
        f"new ones and {learned['corrections']} of corrections; {learned['not_imitated']} that no human drove left out"
    ]
    if rows := metrics["held_out"]:
        actions = [key[len("after_") : -len("_pct")] for key in rows[0] if key.startswith("after_")]
        lines.append(f"errors on held-out episodes, % of the recorded range, before and after ({', '.join(actions)})")
        for row in rows:
            pairs = (
                f"{shown_pct(row[f'before_{a}_pct']).strip()} to {shown_pct(row[f'after_{a}_pct']).strip()}"
                for a in actions
            )
            lines.append(f"{row['kind']} {row['episode']}: {'; '.join(pairs)}")
    for kind, each in metrics["verdict"]["kinds"].items():
        if each["episodes"]:
            lines.append(
                f"{kind}: {each['better']} of {each['episodes']} better, {each['worse']} worse, on average by "
                f"{each['change_points']:+.2f} points; chance alone: {each['chance']:.2g}"
            )
    return "\n".join([*lines, metrics["verdict"]["why"], *metrics["warnings"]])

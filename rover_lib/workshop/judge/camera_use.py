"""Check whether a policy uses its camera, or only repeats its last action, which is right most of the time.

    seen = look(fp32, report, split.held_out)
    for warning in seen.warnings(): ...

The policy's state is its last action. So some frames are planned once more with the picture of another frame, which
hardly moves the plans of a policy that copies its state, and with their own picture a tick earlier: errors are told in
ms of such a delay.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rover_lib.onboard.errors import PolicyError
from rover_lib.workshop.judge.compare import Fidelity
from rover_lib.workshop.judge.recorded_range import FLOOR_PCT, follows, format_pct
from rover_lib.workshop.notebook_table import Table
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.samples import pick_evenly

FRAMES = 48  # each is planned twice more, in FP32 only: a minute for a policy of full size
WAYS = ("by_picture", "apart", "by_100_ms")  # another frame's picture, its state too; the own picture so much older


@dataclass(frozen=True)
class Looking:
    """How much plans change, as a mean over frames and steps, in % of the recorded range: by action, then by WAYS.

    None for an action that is not judged. by_100_ms is 0 for one that hardly follows the camera, or if no frame has an
    earlier one.
    """

    frames: int
    moved_pct: dict[str, dict[str, float] | None]

    def summary(self) -> dict[str, Any]:
        """Return the changes as `<action>_<way>_pct`, for compare.json."""
        summary: dict[str, Any] = {"frames": self.frames}
        for action, change in self.moved_pct.items():
            summary |= {f"{action}_{way}_pct": change[way] if change else None for way in WAYS}
        return summary

    def table(self) -> Table:
        """Return the changes as a table for people."""
        rows = []
        for action, change in self.moved_pct.items():
            rows.append((action, *(format_pct(change[way] if change else None).strip() for way in WAYS)))
        return Table(("a plan moves by", "another picture", "another state too", "100 ms of delay"), rows)

    def warnings(self) -> list[str]:
        """Return what to know before anybody drives with this policy, if an action does not follow the camera."""
        rated = {action: change for action, change in self.moved_pct.items() if change}
        if rated and all(change["apart"] < FLOOR_PCT for change in rated.values()):
            return ["this policy plans the same whatever it is shown, do not drive it"]
        blind = [a for a, change in rated.items() if not follows(change["by_picture"], change["apart"])]
        if rated and len(blind) == len(rated):
            return ["this policy ignores its camera and copies its state, do not drive it"]
        return [f"{action} hardly follows the camera" for action in blind]


def look(policy: Any, report: Fidelity, recorded: Sequence[Any] = (), progress: Progress = silent) -> Looking:
    """Swap pictures and states between the frames of a comparison whose reference is `policy`.

    Each frame is swapped with the one half of all frames away, which is from another drive if there are several.
    recorded: all samples of these drives, for the picture before each. Raises PolicyError for fewer than two frames.
    """
    rows = pick_evenly(range(len(report.samples)), FRAMES)
    if len(rows) < 2:
        raise PolicyError("there are no two frames to swap", remedy="record more, or hold out a larger share")
    partners = np.roll(rows, len(rows) // 2).tolist()
    by_frame = {(s.episode, s.row): s for s in recorded}
    changes = list[list[np.ndarray]]()
    older = [np.zeros(len(report.action_names))]
    for row, other in progress(list(zip(rows, partners, strict=True)), desc="swapping", total=len(rows)):
        sample = report.samples[row]
        plan = report.reference[row].astype(np.float64)
        by_picture = policy.predict_chunk(report.samples[other].frame_bgr(), sample.state)
        changes.append([np.abs(other_plan - plan).mean(0) for other_plan in (by_picture, report.reference[other])])
        before = by_frame and by_frame.get((sample.episode, sample.row - 1))
        if before and sample.time_s > before.time_s:
            late = policy.predict_chunk(before.frame_bgr(), sample.state)
            older.append(np.abs(late - plan).mean(0) / (sample.time_s - before.time_s))
    means = np.vstack([np.mean(changes, axis=0), 0.1 * np.mean(older[1:] or older, axis=0)])  # (ways, actions)
    moved_pct: dict[str, dict[str, float] | None] = {}
    for i, action in enumerate(report.action_names):
        pct = report.pct(action)
        by_way = dict(zip(WAYS, (means[:, i] * (pct or 0)).tolist(), strict=True))
        by_way["by_100_ms"] *= follows(by_way["by_picture"], by_way["apart"])
        moved_pct[action] = None if pct is None else by_way
    return Looking(len(rows), moved_pct)

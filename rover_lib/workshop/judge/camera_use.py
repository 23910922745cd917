"""Check whether a policy uses its camera, or only repeats its last action, which is right most of the time.

    seen = look(fp32, report)
    for warning in seen.warnings(): ...

The policy's state is its last action. So for each frame it plans twice more: with the state of another frame, and with
the picture of another frame. The plans of a policy that only copies change with the state and not with the picture.
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

FRAMES = 24  # each is planned twice more, in FP32 only: half a minute for a policy of full size
OLDER_FRAMES = 48  # each is planned once more: plans of neighbours differ little, so it takes more of them
WAYS = ("by_picture", "by_state", "apart")  # another frame's picture, another frame's state, both


@dataclass(frozen=True)
class Looking:
    """How much plans change, as a mean over frames and steps, in % of the recorded range: by action, then by WAYS.

    None for an action that is not judged. per_ms_pct: by action, for each ms that the picture is older; None for one
    that hardly follows the camera, or if no frame has an earlier one.
    """

    frames: int
    moved_pct: dict[str, dict[str, float] | None]
    per_ms_pct: dict[str, float | None]

    def summary(self) -> dict[str, Any]:
        """Return the changes as `<action>_<way>_pct`, for compare.json."""
        summary: dict[str, Any] = {"frames": self.frames}
        for action, moved in self.moved_pct.items():
            summary |= {f"{action}_{way}_pct": moved[way] if moved else None for way in WAYS}
            summary[f"{action}_per_ms_pct"] = self.per_ms_pct[action]
        return summary

    def table(self) -> Table:
        """Return the changes as a table for people."""
        rows = []
        for action, moved in self.moved_pct.items():
            per_ms = self.per_ms_pct[action]
            delayed = f"{per_ms:.4f} %" if per_ms else "does not move"
            rows.append((action, *(format_pct(moved[way] if moved else None).strip() for way in WAYS), delayed))
        return Table(("a plan moves by", "another picture", "another state", "both", "each ms of delay"), rows)

    def warnings(self) -> list[str]:
        """Return what to know before anybody drives with this policy, if an action does not follow the camera."""
        judged = {action: moved for action, moved in self.moved_pct.items() if moved}
        if judged and all(moved["apart"] < FLOOR_PCT for moved in judged.values()):
            return ["this policy plans the same whatever it is shown, do not drive it"]
        blind = [a for a, moved in judged.items() if not follows(moved["by_picture"], moved["apart"])]
        if judged and len(blind) == len(judged):
            return ["this policy ignores its camera and copies its state, do not drive it"]
        return [f"{action} hardly follows the camera" for action in blind]


def look(
    policy: Any, report: Fidelity, recorded: Sequence[Any] = (), frames: int = FRAMES, progress: Progress = silent
) -> Looking:
    """Swap pictures and states between the frames of a comparison whose reference is `policy`.

    Each frame is swapped with the one half of all frames away, which is from another drive if there are several.
    recorded: all samples of these drives, for the picture before each. Raises PolicyError for fewer than two frames.
    """
    rows = pick_evenly(range(len(report.samples)), frames)
    if len(rows) < 2:
        raise PolicyError("there are no two frames to swap", remedy="record more, or hold out a larger share")
    others = np.roll(rows, len(rows) // 2).tolist()
    moved: list[tuple[np.ndarray, ...]] = []
    for row, other in progress(list(zip(rows, others, strict=True)), desc="swapping", total=len(rows)):
        sample, another, plan = report.samples[row], report.samples[other], report.reference[row].astype(np.float64)
        by_picture = policy.predict_chunk(another.frame_bgr(), sample.state)
        by_state = policy.predict_chunk(sample.frame_bgr(), another.state)
        moved.append(tuple(np.abs(p - plan).mean(axis=0) for p in (by_picture, by_state, report.reference[other])))
    means = np.mean(moved, axis=0)  # (ways, actions)
    per_ms = _moved_per_ms(policy, report, recorded)
    moved_pct: dict[str, dict[str, float] | None] = {}
    per_ms_pct: dict[str, float | None] = {}
    for i, action in enumerate(report.action_names):
        pct = report.pct(action)
        moved = moved_pct[action] = None if pct is None else dict(zip(WAYS, (means[:, i] * pct).tolist(), strict=True))
        followed = moved and pct and follows(moved["by_picture"], moved["apart"])
        per_ms_pct[action] = float(per_ms[i] * pct) if followed and per_ms is not None and per_ms[i] > 0 else None
    return Looking(len(rows), moved_pct, per_ms_pct)


def _moved_per_ms(policy: Any, report: Fidelity, recorded: Sequence[Any]) -> np.ndarray | None:
    """Return how far a plan moves for each ms that its picture is older and the state the same, (A,); None: unknown."""
    known, age_ms = {(s.episode, s.row): s for s in recorded}, 0.0
    moved = np.zeros(len(report.action_names))
    for row in pick_evenly(range(len(report.samples)), OLDER_FRAMES):
        sample = report.samples[row]
        before = known.get((sample.episode, sample.row - 1)) if known else None
        if before and sample.time_s > before.time_s:
            age_ms += 1e3 * (sample.time_s - before.time_s)
            older = policy.predict_chunk(before.frame_bgr(), sample.state)
            moved += np.abs(older.astype(np.float64) - report.reference[row]).mean(0)
    return moved / age_ms if age_ms else None

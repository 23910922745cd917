"""Check whether a policy uses its camera, or only repeats its last action, which is right most of the time.

    seen = look(fp32, report)
    for warning in seen.warnings(): ...

The policy's state is its last action. So for each frame it plans twice more: with the state of another frame, and with
the picture of another frame. The plans of a policy that only copies change with the state and not with the picture.
Such a policy looks good on recordings, but on a car it leaves the track.
"""

import math
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


@dataclass(frozen=True, eq=False)
class Looking:
    """How much plans change, as a mean over frames and steps, in units of each action.

    by_picture: with another frame's picture and the frame's own state. by_state: with another frame's state and the
    frame's own picture. apart: the difference between the plans of the two frames. Each is (A,) float64.
    """

    report: Fidelity
    frames: int
    by_picture: np.ndarray
    by_state: np.ndarray
    apart: np.ndarray

    def summary(self) -> dict[str, Any]:
        """Return the changes by action and unit, for compare.json. The percentages of an unjudged action are None."""
        summary: dict[str, Any] = {"frames": self.frames}
        for i, action in enumerate(self.report.action_names):
            for name, moved in (("by_picture", self.by_picture), ("by_state", self.by_state), ("apart", self.apart)):
                summary[f"{action}_{name}_pct"] = self.report.in_pct(float(moved[i]), action)
                if math.isfinite(us := self.report.us(action)):
                    summary[f"{action}_{name}_us"] = float(moved[i]) * us
        return summary

    def table(self) -> Table:
        """Return the changes as a table for people."""
        moves = self.by_picture, self.by_state, self.apart
        rows = [(a, *(self._pct(moved, i) for moved in moves)) for i, a in enumerate(self.report.action_names)]
        return Table(("a plan moves by", "another picture", "another state", "both"), rows)

    def warnings(self) -> list[str]:
        """Return what to know before anybody drives with this policy, if an action does not follow the camera."""
        names = enumerate(self.report.action_names)
        judged = [(i, a, pct) for i, a in names if (pct := self.report.pct(a)) is not None]
        if judged and all(self.apart[i] * pct < FLOOR_PCT for i, _, pct in judged):
            return ["this policy plans the same whatever it is shown, do not drive it"]
        blind = [(i, a) for i, a, pct in judged if not follows(self.by_picture[i] * pct, self.apart[i] * pct)]
        if judged and len(blind) == len(judged):
            return [f"this policy ignores its camera: {self._moves(blind)}; it copies its state, do not drive it"]
        return [f"{action} hardly follows the camera: {self._moves([(i, action)])}" for i, action in blind]

    def _moves(self, actions: list[tuple[int, str]]) -> str:
        told = []
        for i, a in actions:
            by_picture, by_state = self._pct(self.by_picture, i), self._pct(self.by_state, i)
            told.append(f"another picture moves {a} by {by_picture}, another state by {by_state}")
        return ", ".join(told)

    def _pct(self, moved: np.ndarray, i: int) -> str:
        return format_pct(self.report.in_pct(float(moved[i]), self.report.action_names[i])).strip()


def look(policy: Any, report: Fidelity, frames: int = FRAMES, progress: Progress = silent) -> Looking:
    """Swap pictures and states between the frames of a comparison whose reference is `policy`.

    Each frame is swapped with the one half of all frames away, which is from another drive if there are several. Raises
    PolicyError for fewer than two frames.
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
    by_picture, by_state, apart = np.mean(moved, axis=0)
    return Looking(report, len(rows), by_picture, by_state, apart)

"""Judge a policy while it learns, on recordings of other drives: each action beside a guess without eyes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rover_lib.workshop.judge.guesses import frame_errors, least_blind_errors
from rover_lib.workshop.judge.recorded_range import hardly_varies

LEARNED = 0.95  # of the best guess's error: an action that is no nearer to the driver was not learned
SMALLEST_RANGE = 0.02  # of an action that hardly changes, as errors are divided by the range
MORE = "What helps: more time (--minutes), and more recordings of the same track in other light"
HELPS = {
    "throttle": "What helps: recordings whose throttle is held, or follows the road and not the day or the battery",
}


@dataclass(frozen=True)
class Judges:
    """What judges a policy. All arrays are by action, (A,).

    names: of the actions. ranges: between the least and the largest action to learn from; errors count in it.
    blind_pct: error of the best guess without eyes, in % of the range. varies: whether an action varies, or is held.
    """

    names: Sequence[str]
    chunks: np.ndarray  # (n, C, A)
    is_pad: np.ndarray  # (n, C)
    ranges: np.ndarray
    blind_pct: np.ndarray
    varies: np.ndarray

    @classmethod
    def of(
        cls, names: Sequence[str], learned: np.ndarray, learned_pad: np.ndarray, chunks: np.ndarray, is_pad: np.ndarray
    ) -> "Judges":
        """learned, learned_pad: what is learned from, (n, C, A) and (n, C); chunks, is_pad: what judges."""
        actions = learned[~learned_pad]
        acted = chunks[~is_pad]
        ranges = np.maximum(np.ptp(actions, axis=0), SMALLEST_RANGE)
        blind_pct = 100 * least_blind_errors(learned, learned_pad, chunks, is_pad) / ranges
        # By what is learned from: what hardly varies there, and is held here, is held by the verdict too.
        varies = [np.ptp(acted[:, i]) > 0 and not hardly_varies(name, actions[:, i]) for i, name in enumerate(names)]
        return cls(names, chunks, is_pad, ranges, blind_pct, np.array(varies))

    def errors_pct(self, plans: np.ndarray) -> np.ndarray:
        """Return (A,): how far plans, (n, C, A), are from what was recorded, in % of each action's range."""
        return 100 * np.nanmean(frame_errors(plans, self.chunks, self.is_pad), axis=0) / self.ranges

    def overall_pct(self, errors_pct: Sequence[float] | np.ndarray) -> float:
        """Return the mean error of the actions that vary, of all if none does: that of a held one says nothing."""
        errors = np.asarray(errors_pct)
        return float(errors[self.varies].mean() if self.varies.any() else errors.mean())

    def words(self, errors_pct: np.ndarray) -> str:
        """Say how far each action is off, beside the best guess without eyes."""
        words = []
        for name, error, blind in zip(self.names, errors_pct, self.blind_pct, strict=True):
            words.append(f"{name} {error:.1f} % off (a guess without eyes {blind:.1f} %)")
        return ", ".join(words)

    def summary(self, errors_pct: np.ndarray) -> dict[str, dict[str, Any]]:
        """Return by action its error, the best guess's, whether it varies, and whether it was learned."""
        summary = {}
        for name, error, blind, varies in zip(self.names, errors_pct, self.blind_pct, self.varies, strict=True):
            errors = {"error_pct": float(error), "blind_pct": float(blind)}
            summary[name] = errors | {"varies": bool(varies), "learned": bool(error < LEARNED * blind)}
        return summary


def not_learned(actions: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return a sentence for each action that varies and was not learned, and what helps. actions: of `summary`."""
    sentences = []
    for name, summary in actions.items():
        if summary["varies"] and not summary["learned"]:
            errors = f"{summary['error_pct']:.1f} % off, a guess without eyes {summary['blind_pct']:.1f} %"
            sentences.append(f"{name} was not learned: {errors}. {HELPS.get(name, MORE)}")
    return sentences

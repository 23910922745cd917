"""Hold a policy against its driver, beside guesses that need no eyes: a policy that is no better does not drive.

    judged = against_guesses(report, parts.calibration)
    for warning in judged.warnings(): ...

The guesses are a constant action (the better of mean and median), the last action again and again, and the mean plan,
step by step, of the recordings that the policy could learn from. A guess is beaten if the policy is nearer to the
driver in every judged action, and surely so in their mean, each in percent of its recorded range: as few episodes say
little, that is asked of many draws of the held-out ones (a bootstrap).
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from typing import Any

import numpy as np

from rover_lib.workshop.judge.compare import Fidelity
from rover_lib.workshop.notebook_table import Table
from rover_lib.workshop.recordings.samples import Sample

DRAWS = 2000
LEAST_EPISODES = 4  # of fewer, pieces are drawn instead, each as long as a plan
SURE_PCT = 95
MEAN, MEDIAN, MEAN_PLAN = "the mean action", "the median action", "the mean plan"  # guesses that need no eyes


@dataclass(frozen=True)
class Guess:
    """One guess: its error by action, and by how much the policy is better: the mean, and the ends of the interval.

    All in percent of the recorded range. The interval has SURE_PCT % of the draws.
    """

    errors_pct: dict[str, float]
    better: float
    low: float
    high: float
    beaten: bool

    def lead(self) -> str:
        return f"{self.better:.1f} points ({self.low:.1f} to {self.high:.1f})"


@dataclass(frozen=True)
class Judged:
    """The result of `against_guesses`. drawn: how many episodes or pieces of them were drawn from, in words."""

    errors_pct: dict[str, float]
    guesses: dict[str, Guess]
    drawn: str

    def table(self) -> Table:
        """The policy and the guesses beside each other, for people."""
        rows = [("the policy", *(f"{e:.2f} %" for e in self.errors_pct.values()), "")]
        for name, g in self.guesses.items():
            rows.append((name, *(f"{e:.2f} %" for e in g.errors_pct.values()), g.lead()))
        return Table(("", *self.errors_pct, "the policy is better by"), rows)

    def warnings(self) -> list[str]:
        """A sentence for each guess that is not beaten."""
        what = "this policy is no better than a guess without eyes"
        lost = {name: g for name, g in self.guesses.items() if not g.beaten}
        return [f"{what}: {name} (better by {g.lead()} over {self.drawn})" for name, g in lost.items()]

    def summary(self) -> dict[str, Any]:
        """The same as plain JSON types, for compare.json."""
        return {**asdict(self), "warnings": self.warnings()}


def blind_plans(chunks: np.ndarray, is_pad: np.ndarray) -> dict[str, np.ndarray]:
    """Return the plans, (C, A) each, that need no eyes, of what a policy could learn from.

    chunks: (n, C, A) recorded actions; is_pad: (n, C) bool, steps past the end of a recording.
    """
    actions, shape = chunks[~is_pad].astype(np.float64), chunks.shape[1:]
    # At a step that no plan reaches, the mean action stands.
    padded = np.broadcast_to(is_pad[..., None], chunks.shape)
    steps = np.ma.masked_array(chunks.astype(np.float64), padded).mean(0).filled(actions.mean(0))
    constants = {MEAN: actions.mean(0), MEDIAN: np.median(actions, 0)}
    return {name: np.broadcast_to(value, shape) for name, value in constants.items()} | {MEAN_PLAN: steps}


def frame_errors(plans: np.ndarray, recorded: np.ndarray, is_pad: np.ndarray) -> np.ndarray:
    """Return (n, A): each frame's mean absolute error over its recorded steps. plans: (n, C, A), or one for all."""
    errors = np.abs(plans.astype(np.float64) - recorded) * ~is_pad[..., None]
    return errors.sum(1) / (~is_pad).sum(1)[:, None]


def least_blind_errors(
    learned: np.ndarray, learned_pad: np.ndarray, recorded: np.ndarray, is_pad: np.ndarray
) -> np.ndarray:
    """Return (A,): by action, the mean error on recorded chunks of the best plan without eyes, in the action's unit.

    learned, learned_pad: what a policy could learn from; recorded, is_pad: what judges it: (n, C, A) and (n, C).
    """
    errors = [frame_errors(plan, recorded, is_pad).mean(0) for plan in blind_plans(learned, learned_pad).values()]
    return np.asarray(errors).min(0)


def against_guesses(report: Fidelity, learned: Sequence[Sample], seed: int = 0) -> Judged | None:
    """Hold the FP32 plans of a comparison and the guesses against the driver.

    learned: samples of other episodes, which the policy could learn from; the guesses know no others. None if there
    are none, or no action is judged.
    """
    units = {a: pct for a in report.action_names if (pct := report.pct(a)) is not None}
    if not units or not learned:
        return None
    learned_chunks, learned_pads = np.stack([s.chunk for s in learned]), np.stack([s.is_pad for s in learned])
    judged = [i for i, a in enumerate(report.action_names) if a in units]

    def errors_of(plans: np.ndarray) -> np.ndarray:
        """(n, judged actions): each frame's mean error over its recorded steps, in percent of the recorded range."""
        return frame_errors(plans, report.recorded, report.is_pad)[:, judged] * list(units.values())

    own = errors_of(report.reference)
    blind = {name: errors_of(plan) for name, plan in blind_plans(learned_chunks, learned_pads).items()}
    found = {"a constant action": min((blind[MEAN], blind[MEDIAN]), key=lambda e: e.mean())}
    states = np.stack([s.state for s in report.samples])
    if states.shape[1] == len(report.action_names):
        found["the last action again"] = errors_of(states[:, None])
    found[MEAN_PLAN] = blind[MEAN_PLAN]
    drawn, pieces = _pieces(report)
    draws = np.random.default_rng(seed).integers(0, len(pieces), (DRAWS, len(pieces)))
    counts = np.array([len(p) for p in pieces])
    guesses, own_pct = {}, dict(zip(units, own.mean(0).tolist(), strict=True))
    for name, errors in found.items():
        gain = (errors - own).mean(1)
        sums = np.array([gain[p].sum() for p in pieces])
        means = sums[draws].sum(1) / counts[draws].sum(1)
        low, high = np.percentile(means, [(100 - SURE_PCT) / 2, (100 + SURE_PCT) / 2]).tolist()
        errors_pct = dict(zip(units, errors.mean(0).tolist(), strict=True))
        beaten = low > 0 and all(own_pct[action] < error for action, error in errors_pct.items())
        guesses[name] = Guess(errors_pct, float(gain.mean()), low, high, beaten)
    return Judged(own_pct, guesses, drawn)


def _pieces(report: Fidelity) -> tuple[str, list[np.ndarray]]:
    """Return what is drawn from, in words, and for each piece the numbers of its frames."""
    samples = report.samples
    groups = groupby(range(len(samples)), lambda row: samples[row].episode)
    episodes = [np.array(list(rows)) for _, rows in groups]
    if len(episodes) >= LEAST_EPISODES:
        return f"{len(episodes)} episodes", episodes
    chunk = report.reference.shape[1]
    pieces = []
    for rows in episodes:
        numbers = [samples[row].row // chunk for row in rows]
        pieces += [rows[np.array(numbers) == n] for n in dict.fromkeys(numbers)]
    return f"{len(pieces)} pieces of {len(episodes)} episode{'s' if len(episodes) > 1 else ''}", pieces

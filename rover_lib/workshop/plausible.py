"""Do a policy's numbers fit the recordings? The wrong statistics raise nothing: they steer.

    fit = fits(checkpoint, samples, recordings.action_range())
    for warning in fit.warnings(): ...

The policy plans on a few recorded frames. What it predicts must lie where the recorded actions do, and what it is told
of its state must be of the size that it was trained on, once both are normalised by the checkpoint's statistics.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np

from rover_lib.workshop.act import ACT, inputs_of, predictions
from rover_lib.workshop.cells import Table
from rover_lib.workshop.checkpoint import Checkpoint
from rover_lib.workshop.compare import thinned
from rover_lib.workshop.judge import Range, constant_actions
from rover_lib.workshop.samples import Sample, frame_rate_hz, is_another_rate

FRAMES = 12  # planned in FP32: ten seconds for a policy of full size
BEYOND = 0.5  # of the recorded range, past either end: further than a policy overshoots
MOST_BEYOND_PCT = 5.0
LEAST_SPREAD = 0.1  # of the recorded spread: what moves less is no driver's
LARGEST_STATE = 10.0  # standard deviations; those of other units are hundreds


@dataclass(frozen=True)
class Action:
    """One action's numbers: recorded and predicted ends, how much is predicted beyond, and the spreads' ratio.

    beyond_pct: of the predicted values, past the recorded range by more than BEYOND of it.
    """

    name: str
    recorded: Range
    predicted: Range
    beyond_pct: float
    spread: float


@dataclass(frozen=True)
class Fit:
    """What `fits` found. largest_state: (S,) by name, of the normalised recorded states, None if they stay raw.
    plans_hz: the policy's steps a second. other_rates_hz: frames a second, by episode, where they are others.
    """

    frames: int
    actions: tuple[Action, ...]
    largest_state: dict[str, float] | None
    plans_hz: float
    other_rates_hz: dict[str, float]

    def table(self) -> Table:
        """A table for people: where actions were recorded, and where this policy's lie on the same frames."""
        spans = (
            (a.name, *(f"{low:.3g} to {high:.3g}" for low, high in (a.recorded, a.predicted))) for a in self.actions
        )
        return Table(("", "recorded", "predicted"), list(spans))

    def warnings(self) -> list[str]:
        """A sentence for each number that does not fit; the remedy is always the same one."""
        remedy = "are these the recordings, and the statistics, that it was trained with?"
        warnings = []
        for a in self.actions:
            if a.beyond_pct > MOST_BEYOND_PCT:
                what = f"{a.beyond_pct:.0f} % of its predictions are far outside of what was recorded"
                warnings.append(f"{a.name}: {what} ({a.predicted[0]:.3g} to {a.predicted[1]:.3g}); {remedy}")
            elif a.spread < LEAST_SPREAD:
                what = f"its predictions vary {100 * a.spread:.0f} % as much as what was recorded"
                warnings.append(f"{a.name}: {what}; {remedy}")
        for name, largest in (self.largest_state or {}).items():
            if not largest <= LARGEST_STATE:
                what = f"the policy is told up to {largest:.3g} standard deviations"
                warnings.append(f"state {name}: {what}; {remedy}")
        if self.other_rates_hz:
            episode, found_hz = next(iter(self.other_rates_hz.items()))
            others = f" and {len(self.other_rates_hz) - 1} more" if len(self.other_rates_hz) > 1 else ""
            what = f"the policy plans {self.plans_hz:g} steps a second, and {episode}{others} has {found_hz:.1f} frames"
            warnings.append(f"{what}: the car would drive at another speed than the human did")
        return warnings

    def summary(self) -> dict[str, Any]:
        """The same as plain JSON types, for load.json."""
        actions = {
            a.name: {"predicted": list(a.predicted), "beyond_pct": a.beyond_pct, "spread": a.spread}
            for a in self.actions
        }
        return {"frames": self.frames, "actions": actions, "warnings": self.warnings()}


def fits(checkpoint: Checkpoint, samples: Sequence[Sample], action_range: Mapping[str, Range]) -> Fit:
    """Plan on a few of the samples in FP32 and hold the plans against what was recorded there.

    samples: of whole episodes, one after the other; the rate of each is held against the policy's. An action that never
    changes in the recordings is left out: nobody knows how far it may go.
    """
    config, few = checkpoint.config, thinned(samples, FRAMES)
    plans = predictions(ACT(config, checkpoint.weights), [inputs_of(s, config) for s in few]).numpy()
    known = ~np.stack([s.is_pad for s in few])
    recorded = np.stack([s.chunk for s in few])
    actions = []
    for i, (name, (low, high)) in enumerate(action_range.items()):
        if name in constant_actions(action_range):
            continue
        values, margin = plans[..., i], BEYOND * (high - low)
        beyond = (values < low - margin) | (values > high + margin)
        spread = float(values[known].std() / max(recorded[..., i][known].std(), 1e-12))
        ends = float(values.min()), float(values.max())
        actions.append(Action(name, (low, high), ends, 100 * float(beyond.mean()), spread))
    largest = None
    if (norm := config.state_norm) is not None:
        states = np.stack([s.state for s in samples]) * np.asarray(norm.scale) + np.asarray(norm.shift)
        largest = dict(zip(config.state_names, np.abs(states).max(0).tolist(), strict=True))
    return Fit(len(few), tuple(actions), largest, config.rate_hz, _other_rates_hz(samples, config.rate_hz))


def _other_rates_hz(samples: Sequence[Sample], plans_hz: float) -> dict[str, float]:
    rates = {name: frame_rate_hz(list(episode)) for name, episode in groupby(samples, key=lambda s: s.episode)}
    return {name: found for name, found in rates.items() if found is not None and is_another_rate(found, plans_hz)}

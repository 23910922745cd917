"""Check that a policy's numbers fit the recordings: wrong statistics raise no error, the car just drives badly.

    fit = fits(checkpoint, samples, recordings.action_range())
    for warning in fit.warnings(): ...

The policy plans on a few recorded frames. Its predictions must lie in the range of the recorded actions. And the
recorded states, normalised by the checkpoint's statistics, must be about as large as in training.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np

from rover_lib.workshop.act import ACT, inputs_of, predictions
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint
from rover_lib.workshop.judge.recorded_range import HELD_OFF, Range, hardly_varies, usual_size
from rover_lib.workshop.notebook_table import Table
from rover_lib.workshop.recordings.samples import Sample, frame_rate_hz, is_another_rate, pick_evenly, stack_chunks

FRAMES = 12  # planned in FP32, which takes ten seconds for a policy of full size
BEYOND = 0.5  # a prediction lies beyond if it passes either end by this share of the range; a good policy does not
MOST_BEYOND_PCT = 5.0
LEAST_SPREAD = 0.1  # a policy whose predictions vary by less than this share of the recorded spread does not drive
LARGEST_STATE = 10.0  # standard deviations; in wrong units there are hundreds
REMEDY = "are these the recordings, and the statistics, that it was trained with?"
OURS = "it was trained here and has learned too little of it: train longer, on more recordings"  # with its statistics


@dataclass(frozen=True)
class Fit:
    """The result of `fits`.

    recorded: range by action. actions: {predicted: [least, most], beyond_pct, spread, held} by action: the percentage
    of predicted values that lie outside the recorded range by more than BEYOND of it, their spread divided by the
    recorded one, and whether that hardly varies, so that the spread says nothing. largest_state: by name, the largest
    normalised recorded state. plans_hz: steps per second of the policy's plans. other_rates_hz: frames per second of
    each episode that has another rate. remedy: for numbers that do not fit.
    """

    frames: int
    recorded: Mapping[str, Range]
    actions: dict[str, dict[str, Any]]
    largest_state: dict[str, float]
    plans_hz: float
    other_rates_hz: dict[str, float]
    remedy: str = REMEDY

    def table(self) -> Table:
        """A table for people: the ranges of the recorded actions, and of the policy's actions on the same frames."""
        rows = []
        for name, fit in self.actions.items():
            ranges = (self.recorded[name], fit["predicted"])
            rows.append((name, *(f"{low:.3g} to {high:.3g}" for low, high in ranges)))
        return Table(("", "recorded", "predicted"), rows)

    def warnings(self) -> list[str]:
        """A sentence for each number that does not fit."""
        warnings = []
        for name, fit in self.actions.items():
            problem = ""
            if fit["beyond_pct"] > MOST_BEYOND_PCT:
                problem = f"{fit['beyond_pct']:.0f} % of its predictions are far outside of what was recorded"
            elif fit["spread"] < LEAST_SPREAD and not fit["held"]:
                problem = f"its predictions vary {100 * fit['spread']:.0f} % as much as what was recorded"
            if problem:
                warnings.append(f"{name}: {problem}; {self.remedy}")
        for name, largest in self.largest_state.items():
            if not largest <= LARGEST_STATE:
                problem = f"the policy is told up to {largest:.3g} standard deviations"
                warnings.append(f"state {name}: {problem}; {self.remedy}")
        for episode, found_hz in list(self.other_rates_hz.items())[:1]:
            problem = f"the policy plans {self.plans_hz:g} steps a second, and {episode} has {found_hz:.1f} frames"
            warnings.append(f"{problem}: the car would drive at another speed than the human did")
        return warnings

    def summary(self) -> dict[str, Any]:
        """The same values as plain JSON types, for load.json."""
        return {"frames": self.frames, "actions": self.actions, "warnings": self.warnings()}


def fits(checkpoint: Checkpoint, samples: Sequence[Sample], action_range: Mapping[str, Range]) -> Fit:
    """Plan on a few of the samples in FP32 and compare the plans with the recorded actions.

    samples: of whole episodes, one after the other; each episode's rate is compared with the policy's. An action that
    never changes in the recordings is left out, because its possible range is not known.
    """
    config = checkpoint.config
    tried = pick_evenly(samples, FRAMES)
    plans = predictions(ACT(config, checkpoint.weights), [inputs_of(s, config) for s in tried]).numpy()
    recorded, is_pad = stack_chunks(tried)
    actions = {}
    for i, (name, (low, high)) in enumerate(action_range.items()):
        if not high > low:
            continue
        values = plans[..., i]
        acted = recorded[..., i][~is_pad]
        constant = hardly_varies(name, acted)
        margin = max(BEYOND * (high - low), HELD_OFF * usual_size(acted) if constant else 0)
        beyond = (values < low - margin) | (values > high + margin)
        actions[name] = {
            "predicted": [float(values.min()), float(values.max())],
            "beyond_pct": 100 * float(beyond.mean()),
            "spread": float(values[~is_pad].std() / max(acted.std(), 1e-12)),
            "held": constant,
        }
    largest: dict[str, float] = {}
    if (norm := config.state_norm) is not None:
        states = np.stack([s.state for s in samples]) * np.asarray(norm.scale) + np.asarray(norm.shift)
        largest = dict(zip(config.state_names, np.abs(states).max(0).tolist(), strict=True))
    others_hz = {}
    for name, episode in groupby(samples, key=lambda s: s.episode):
        found_hz = frame_rate_hz(list(episode))
        if found_hz is not None and is_another_rate(found_hz, config.rate_hz):
            others_hz[name] = found_hz
    remedy = OURS if checkpoint.report.get("written_here") else REMEDY
    return Fit(len(tried), action_range, actions, largest, config.rate_hz, others_hz, remedy)

"""Find whether a checkpoint speaks the formula of older firmware, and convert its units if it does.

A policy of such recordings plans 0.1687 where it means "stopped", which is 222 us here. Its plans are held against both
readings of the recordings. If the files' fit better, its normalisation converts states and actions.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain

import numpy as np

from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.pwm import Channel
from rover_lib.workshop.act_config import Affine
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint, normalisation, planned_error
from rover_lib.workshop.recordings.controls import OLD
from rover_lib.workshop.recordings.samples import ACTION_NAMES, Recordings, Sample, car_of, pick_evenly

FRAMES = 8  # planned twice, in FP32
BETTER = 0.5  # the files' reading must leave at most this share of the error; one of the two is off by 222 us


def in_todays_units(policy: Checkpoint, recordings: Recordings, samples: Sequence[Sample]) -> Checkpoint:
    """Return the policy, in the units of today's actions if it was trained on others.

    Recordings of the recorded car that follow today's formula may be newer than what the policy learned from: then OLD
    is tried. samples: to plan on.
    """
    if policy.config.action_names != ACTION_NAMES or policy.config.state_names != ACTION_NAMES:
        return policy
    car = car_of(recordings.samples)
    recorded = {n: OLD[n] for n in chain.from_iterable(e.formulas for e in recordings.episodes)}
    # Throttle tells the two readings apart: standing still is 0 in one of them only.
    tried = [recorded] if recorded else []
    if car.drives_like(Car()) and recordings.layout.rate_hz is None and OLD not in tried:
        tried.append(OLD)
    samples_tried = pick_evenly(samples, FRAMES)
    best = policy
    best_error = BETTER * planned_error(policy, samples_tried, 1) if tried else 0.0
    for formulas in tried:
        converted = _in_units_of(policy, car, formulas)
        if (error := planned_error(converted, samples_tried, 1)) <= best_error:
            best = converted
            best_error = error
    return best


def _in_units_of(policy: Checkpoint, car: Car, formulas: Mapping[str, Channel]) -> Checkpoint:
    """Return the policy with today's actions outside, and those of the formulas inside."""
    # What a file says is gain * action + offset.
    channels = [car.pwm.channel(name) for name in ACTION_NAMES]
    learned = [formulas.get(c.name, c) for c in channels]
    neutral, span = np.array([(f.neutral_pct, f.span_pct) for f in learned]).T
    gains = np.array([c.span_pct for c in channels]) / span
    offsets = (np.array([c.neutral_pct for c in channels]) - neutral) / span
    same = Affine((1.0, 1.0), (0.0, 0.0))
    state = policy.config.state_norm or same
    action = policy.config.action_unnorm or same
    scale = np.array(action.scale)
    shift = np.array(action.shift)
    config = replace(
        policy.config,
        state_norm=_affine(np.array(state.scale) * gains, np.array(state.scale) * offsets + np.array(state.shift)),
        action_unnorm=_affine(scale / gains, (shift - offsets) / gains),
    )
    formula_list = ", ".join(f"{name} = (duty % - {f.neutral_pct:g}) / {f.span_pct:g}" for name, f in formulas.items())
    words = normalisation(config) | {"units": f"trained on actions of older firmware ({formula_list}), and converted"}
    return replace(policy, config=config, report=policy.report | {"normalisation": words})


def _affine(scale: np.ndarray, shift: np.ndarray) -> Affine:
    return Affine(tuple(scale.tolist()), tuple(shift.tolist()))

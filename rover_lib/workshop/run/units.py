"""Find whether a checkpoint speaks the formula of older firmware, and convert its units if it does.

A policy that was trained on such recordings as they are plans 0.1687 where it means "stopped", which is 222 us here.
Its plans are held against both readings of the recordings: today's actions, and what the files say. If the files' fit
better, states and actions are converted by the policy's normalisation, which the artifact's manifest carries.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from rover_lib.onboard.car.car import Car
from rover_lib.workshop.act import ACT, ActConfig, Affine, inputs_of, predictions
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint, normalisation
from rover_lib.workshop.recordings.formula import OLD, Formula
from rover_lib.workshop.recordings.lerobot_dataset import is_dataset
from rover_lib.workshop.recordings.samples import ACTION_NAMES, Recordings, Sample, car_of, pick_evenly

FRAMES = 8  # planned twice, in FP32
Units = Mapping[str, Sequence[float]]  # by action, neutral_pct and span_pct of the formula that the policy speaks
BETTER = 0.5  # the files' reading must leave at most this share of the error; one of the two is off by 222 us


def in_todays_units(
    policy: Checkpoint, recordings: Recordings, samples: Sequence[Sample], known: Units | None = None
) -> Checkpoint:
    """Return the policy, in the units of today's actions if it was trained on others.

    These are what the recordings had before they were recomputed. Recordings of the recorded car that follow today's
    formula may be newer than what the policy learned from: then those of OLD are tried. samples: of the recordings, to
    plan on; a LeRobotDataset has no other units. known: what an earlier call found, as its report's "units" say, so
    that nothing is planned again.
    """
    if policy.config.action_names != ACTION_NAMES or policy.config.state_names != ACTION_NAMES:
        return policy
    car = car_of(recordings.samples)
    if known is not None:
        formulas = {n: Formula(at, span, OLD[n].low, OLD[n].high) for n, (at, span) in known.items()}
        return _in_units_of(policy, car, formulas) if formulas else policy
    few = pick_evenly(samples, FRAMES)
    recorded: dict[str, Formula] = {n: f for e in recordings.episodes for n, f in e.formulas.items()}
    tried = [recorded] if recorded else []
    if car.drives_like(Car()) and not is_dataset(recordings.root) and OLD not in tried:
        tried.append(OLD)
    best, least = policy, BETTER * _error(policy, few) if tried else 0.0
    for formulas in tried:
        converted = _in_units_of(policy, car, formulas)
        if (error := _error(converted, few)) <= least:
            best, least = converted, error
    return best


def _in_units_of(policy: Checkpoint, car: Car, formulas: Mapping[str, Formula]) -> Checkpoint:
    """Return the policy with today's actions outside, and those of the formulas inside."""
    # What a file says is gain * action + offset.
    gains, offsets = [], []
    for name in ACTION_NAMES:
        channel = car.pwm.channel(name)
        formula = formulas.get(name, Formula.of(channel))
        gains.append(channel.span_pct / formula.span_pct)
        offsets.append((channel.neutral_pct - formula.neutral_pct) / formula.span_pct)
    converted = replace(policy, config=_convert(policy.config, np.array(gains), np.array(offsets)))
    said = ", ".join(f"{name} = {formula}" for name, formula in formulas.items())
    words = normalisation(converted.config) | {"units": f"trained on actions of older firmware ({said}), and converted"}
    units = {name: [formula.neutral_pct, formula.span_pct] for name, formula in formulas.items()}
    return replace(converted, report=policy.report | {"normalisation": words, "units": units})


def _convert(config: ActConfig, gains: np.ndarray, offsets: np.ndarray) -> ActConfig:
    def values(norm: Affine | None) -> tuple[np.ndarray, np.ndarray]:
        return (np.ones(2), np.zeros(2)) if norm is None else (np.array(norm.scale), np.array(norm.shift))

    def affine(scale: np.ndarray, shift: np.ndarray) -> Affine:
        return Affine(tuple(scale.tolist()), tuple(shift.tolist()))

    scale, shift = values(config.state_norm)
    state = affine(scale * gains, scale * offsets + shift)
    scale, shift = values(config.action_unnorm)
    return replace(config, state_norm=state, action_unnorm=affine(scale / gains, (shift - offsets) / gains))


def _error(policy: Checkpoint, samples: Sequence[Sample]) -> float:
    """The mean error of throttle, which tells the two readings apart: standing still is 0 in one of them only."""
    plans = predictions(ACT(policy.config, policy.weights), [inputs_of(s, policy.config) for s in samples]).numpy()
    known = ~np.stack([s.is_pad for s in samples])
    return float(np.abs(plans - np.stack([s.chunk for s in samples]))[known][:, 1].mean())

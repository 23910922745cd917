"""A checkpoint that was trained on older firmware's actions, and one that was not, on the same recordings."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from rover_lib.onboard.car.car import read_car
from rover_lib.onboard.car.pwm import PwmCalibration
from rover_lib.workshop.act import ACT, inputs_of, predictions
from rover_lib.workshop.recordings.controls import OLD
from rover_lib.workshop.recordings.episodes import load_recordings
from rover_lib.workshop.run.units import in_todays_units
from tests.helpers.episodes import OLD as WAS
from tests.helpers.episodes import edit, rewritten
from tests.helpers.recorded import record_drives

PWM = PwmCalibration()


@pytest.fixture
def old_recordings(tmp_path):
    """Drives as older firmware wrote them."""
    for folder in record_drives(tmp_path).iterdir():
        edit(folder, rewritten(WAS))
    return load_recordings(tmp_path)


def speaks(tiny, neutral, gain):
    """The policy, whose plans are near the given throttle and follow its own head by `gain`."""
    weights = dict(tiny.weights)
    weights["action_head.weight"] = gain * weights["action_head.weight"]
    weights["action_head.bias"] = torch.tensor([0.0, neutral])
    return replace(tiny, weights=weights)


def plans(policy, samples):
    return predictions(ACT(policy.config, policy.weights), [inputs_of(s, policy.config) for s in samples]).numpy()


def test_a_policy_of_older_actions_is_converted_once(tiny, old_recordings):
    """Its 0.1687 is a stopped car, and would have been 222 us."""
    policy = speaks(tiny, neutral=0.1687 + 0.05 * 0.8313, gain=1e-3)
    found = in_todays_units(policy, old_recordings, old_recordings.samples)
    assert "converted" in found.report["normalisation"]["units"]
    few = old_recordings.samples[:3]
    was, now = plans(policy, few), plans(found, few)
    assert now[..., 1] == pytest.approx(0.05, abs=0.01)
    for name, i in (("steering", 0), ("throttle", 1)):  # both mean the same pulse
        channel, formula = PWM.channel(name), OLD[name]
        duties = channel.neutral_pct + channel.span_pct * now[..., i].astype(np.float64)
        said = (duties - formula.neutral_pct) / formula.span_pct
        assert said == pytest.approx(was[..., i], abs=2e-3)  # but for its state, which is converted too
    assert in_todays_units(found, old_recordings, old_recordings.samples) is found
    state = found.config.state_norm
    assert np.array([0, 0]) * state.scale + state.shift == pytest.approx([(6.83 - 7) / 2.42, 11.81 / 70])


def test_policies_of_todays_and_of_older_actions_on_newer_recordings(tiny, old_recordings, tmp_path):
    """Nothing in newer recordings says that there ever was another formula."""
    today, older = speaks(tiny, neutral=0.05, gain=1e-3), speaks(tiny, neutral=0.2, gain=1e-3)
    newer = load_recordings(record_drives(tmp_path / "today"))
    doubtful = speaks(tiny, neutral=0.15, gain=1e-3)  # converted, it would be nearer by a quarter only
    for policy, recordings in ((today, old_recordings), (doubtful, old_recordings), (today, newer)):
        assert in_todays_units(policy, recordings, recordings.samples) is policy
    assert "converted" in in_todays_units(older, newer, newer.samples).report["normalisation"]["units"]
    crawler = read_car("lab/cars/crawler.yml")
    of_it = [replace(e, samples=tuple(replace(s, car=crawler) for s in e.samples)) for e in newer.episodes]
    another = replace(newer, episodes=tuple(of_it))
    assert in_todays_units(older, another, another.samples) is older

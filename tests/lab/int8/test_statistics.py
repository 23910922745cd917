from dataclasses import replace

import pytest
import torch
from policies import memory_samples

from lab.int8.statistics import STATISTICS, bring_statistics
from rover_lib.workshop.act import ACT, inputs_of, predictions
from rover_lib.workshop.int8.frames import ODD, describe_odd
from rover_lib.workshop.int8.observe import calibrate


@pytest.mark.slow
def test_brought_statistics_make_a_few_frames_odd_by_the_products_own_measure(tiny):
    """And in float the policy plans nearly as before, so that INT8 alone is judged."""
    norm, times = STATISTICS["layer4, most"]
    samples = memory_samples(60)
    changed = bring_statistics(tiny.weights, tiny.config, samples, norm, times)
    assert not torch.equal(changed[f"backbone.{norm}.running_mean"], tiny.weights[f"backbone.{norm}.running_mean"])

    elsewhere = replace(tiny, weights=changed, sha256="elsewhere")
    before, after = (calibrate(c, samples) for c in (tiny, elsewhere))
    assert not describe_odd(before.frames, before.seen)
    odd = describe_odd(after.frames, after.seen)
    assert odd["block"] == "backbone.layer4" and odd["times"] > 2 * ODD and 3 < odd["share_pct"] < 15

    inputs = [inputs_of(s, tiny.config) for s in samples]
    own, other = (predictions(ACT(tiny.config, w), inputs) for w in (tiny.weights, changed))
    assert (own - other).abs().mean() < 0.1 * own.std()

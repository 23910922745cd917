"""Leaving out against what it must do: nothing where nothing is, something where something is."""

import dataclasses
from types import SimpleNamespace

import pytest
import torch
import torch.nn.functional as F
from policies import memory_samples

from rover_lib.onboard.errors import QuantizeError
from rover_lib.onboard.stage import read_stage
from rover_lib.workshop import ablation, act
from rover_lib.workshop import quantize as q
from rover_lib.workshop.ablation import Int8Products, Transformer, int8_attention, leave_out, omissible, without
from rover_lib.workshop.act import ACT

RANGE = {"steering": (-0.5, 0.5), "throttle": (0.0, 0.1)}
SAMPLES = memory_samples(3, seed=1)


def test_names_are_complete_and_of_this_policy(tiny):
    assert omissible(tiny.config) == [
        "encoder.0",
        "decoder.0",
        "decoder.1",
        *(b for b in act.blocks(tiny.config) if b.startswith(("encoder.", "decoder."))),
        *(f"encoder.0.attention.head.{i}" for i in range(4)),
        *(f"decoder.0.cross_attention.head.{i}" for i in range(4)),
        *(f"decoder.1.attention.head.{i}" for i in range(4)),
        *(f"decoder.1.cross_attention.head.{i}" for i in range(4)),
    ]
    model = ACT(tiny.config, tiny.weights)
    for name in ("encoder.1", "decoder.0.attention", "encoder.0.attention.head.4", "backbone.layer1"):
        with pytest.raises(QuantizeError, match="cannot be left out of this policy"), without(model, name):
            pass


def test_features_that_are_remembered_change_nothing(tiny):
    transformer = Transformer(tiny, SAMPLES)
    model = ACT(tiny.config, tiny.weights)
    expected = q.predictions(model, (q.inputs_of(s, tiny.config) for s in SAMPLES))
    assert torch.equal(transformer.predictions(), transformer.full)
    assert torch.equal(transformer.full, expected)
    assert not torch.equal(expected[0], expected[1])


def test_what_was_left_out_is_back_afterwards(tiny):
    transformer = Transformer(tiny, SAMPLES[:1])
    for name in omissible(tiny.config):
        with without(transformer.model, name):
            assert not torch.equal(transformer.predictions(), transformer.full), name
        assert torch.equal(transformer.predictions(), transformer.full), name


def _changed(tiny, edit):
    weights = {k: v.clone() for k, v in tiny.weights.items()}
    edit(weights)
    return dataclasses.replace(tiny, weights=weights)


def test_a_head_that_the_output_projection_ignores_costs_no_accuracy(tiny):
    def edit(weights):
        weights["encoder.layers.0.self_attn.out_proj.weight"][:, 16:32] = 0  # head 1 of 4, dim 64

    rows = {r["name"]: r for r in leave_out(_changed(tiny, edit), SAMPLES, RANGE)}
    assert list(rows) == omissible(tiny.config)
    ignored, used = rows["encoder.0.attention.head.1"], rows["encoder.0.attention.head.2"]
    assert ignored["steering_mae_pct"] == ignored["throttle_mae_pct"] == 0
    assert min(used["steering_mae_pct"], used["throttle_mae_pct"]) > 1e-3


def test_halves_that_add_nothing_cost_no_accuracy(tiny):
    def edit(weights):
        for name in ("encoder.layers.0.linear2", "decoder.layers.1.multihead_attn.out_proj"):
            weights[f"{name}.weight"].zero_()
            weights[f"{name}.bias"].zero_()

    rows = {r["name"]: r for r in leave_out(_changed(tiny, edit), SAMPLES, RANGE)}
    for name in ("encoder.0.feed_forward", "decoder.1.cross_attention"):
        assert rows[name]["steering_mae_pct"] == rows[name]["throttle_mae_pct"] == 0
    for name in ("encoder.0.attention", "decoder.1.feed_forward"):
        assert rows[name]["steering_mae_pct"] > 1e-3


def test_a_left_out_layer_is_a_policy_without_it(tiny):
    """Against a checkpoint that has one decoder layer less: the last one of it."""
    with without(model := ACT(tiny.config, tiny.weights), "decoder.1"):
        found = model(*q.inputs_of(SAMPLES[0], tiny.config))
    weights = {k: v for k, v in tiny.weights.items() if not k.startswith("decoder.layers.1.")}
    shorter = ACT(dataclasses.replace(tiny.config, decoder_layers=1), weights)
    torch.testing.assert_close(found, shorter(*q.inputs_of(SAMPLES[0], tiny.config)))


def test_the_first_decoder_layer_left_out_is_a_policy_that_starts_with_the_second(tiny):
    with without(model := ACT(tiny.config, tiny.weights), "decoder.0"):
        found = model(*q.inputs_of(SAMPLES[0], tiny.config))
    second = "decoder.layers.1."
    weights = {k: v for k, v in tiny.weights.items() if not k.startswith("decoder.layers.")}
    weights |= {"decoder.layers.0." + k.removeprefix(second): v for k, v in tiny.weights.items() if second in k}
    shorter = ACT(dataclasses.replace(tiny.config, decoder_layers=1), weights)
    torch.testing.assert_close(found, shorter(*q.inputs_of(SAMPLES[0], tiny.config)), atol=1e-5, rtol=1e-4)


def test_costs_add_up(tiny):
    rows = {r["name"]: r for r in leave_out(tiny, SAMPLES[:1], RANGE)}
    macs = act.multiply_accumulates(ACT(tiny.config, tiny.weights))
    assert rows["decoder.1"]["macs_g"] * 1e9 == pytest.approx(sum(n for b, n in macs.items() if "decoder.1." in b))
    assert rows["decoder.1"]["share_pct"] == pytest.approx(100e9 * rows["decoder.1"]["macs_g"] / sum(macs.values()))
    heads = [r["macs_g"] for name, r in rows.items() if name.startswith("decoder.1.attention.head")]
    assert len(heads) == 4
    assert sum(heads) == pytest.approx(rows["decoder.1.attention"]["macs_g"])


def test_nothing_can_be_judged_without_samples(tiny, calibration):
    with pytest.raises(QuantizeError, match="needs held-out samples"):
        leave_out(tiny, [], RANGE)
    static = q.quantize(tiny, q.Scheme("static"), calibration)
    with pytest.raises(QuantizeError, match="needs calibration and held-out samples"):
        int8_attention(tiny, static, SAMPLES, [], RANGE)


# --- INT8 products ----------------------------------------------------------------------------------------------------


def _attention(products: str, query, key, value):
    module = Int8Products(products, "minmax")
    module(query, key, value)
    module.freeze()
    return module(query, key, value)


@pytest.mark.parametrize("products", ablation.PRODUCTS)
def test_rounded_products_are_near_the_float_ones(products):
    torch.manual_seed(0)
    query, key, value = (torch.randn(1, 2, n, 8) for n in (5, 9, 9))
    exact = F.scaled_dot_product_attention(query, key, value)
    error = (_attention(products, query, key, value) - exact).abs().max()
    assert 0 < error < 0.05 * exact.abs().max()


def test_flat_attention_is_lost_by_rounding_the_softmax_only():
    torch.manual_seed(0)
    query, key, value = torch.zeros(1, 1, 4, 8), torch.randn(1, 1, 700, 8), torch.rand(1, 1, 700, 8)
    exact = F.scaled_dot_product_attention(query, key, value)  # the mean value: each weight is 1/700
    assert _attention("softmax", query, key, value).abs().max() == 0
    torch.testing.assert_close(_attention("exponential", query, key, value), exact, atol=3e-3, rtol=0)


def test_int8_attention_starts_from_the_static_policy(tiny, calibration):
    static = q.quantize(tiny, q.Scheme("static"), calibration)
    rows = {r.pop("name"): r for r in int8_attention(tiny, static, memory_samples(6), SAMPLES, RANGE)}
    blocks = ["encoder.0.attention", "decoder.0.cross_attention", "decoder.1.attention", "decoder.1.cross_attention"]
    assert list(rows) == ["none", *blocks, "all"]
    inputs = [q.inputs_of(s, tiny.config) for s in SAMPLES]
    reference = q.predictions(ACT(tiny.config, tiny.weights), inputs)
    assert rows["none"] == pytest.approx(q.mae_pct(q.predictions(static.module, inputs), reference, RANGE))
    for block in (*blocks, "all"):
        assert rows[block] != rows["none"], block
    with pytest.raises(QuantizeError, match="found a dynamic one"):
        int8_attention(tiny, q.quantize(tiny, q.Scheme("dynamic"), calibration), SAMPLES, SAMPLES, RANGE)
    with pytest.raises(QuantizeError, match="'bf16' are not known"):
        int8_attention(tiny, static, SAMPLES, SAMPLES, RANGE, products="bf16")


def test_the_report_is_of_the_runs_held_out_frames(tiny, tmp_path, monkeypatch):
    recordings = SimpleNamespace(action_range=lambda: RANGE)
    opened = SimpleNamespace(checkpoint=tiny, recordings=recordings, parts=SimpleNamespace(held_out=SAMPLES))
    monkeypatch.setattr(ablation, "opened", lambda run_dir: opened)
    content = ablation.report(tmp_path, 2)
    assert read_stage(tmp_path / "leave_out.json", "leave_out") == content
    assert content["params"] == {"frames": 2}
    rows = content["metrics"]["rows"]
    assert [r["name"] for r in rows] == omissible(tiny.config)
    lines = ablation.table(content).splitlines()
    assert len(lines) == 3 + len(rows)
    worst = max(rows, key=lambda r: max(r["steering_mae_pct"], r["throttle_mae_pct"]))
    assert lines[-1].startswith(worst["name"] + " ")

"""Quantization: exact where it claims to be, acting where it claims to act, loud where it cannot."""

import functools
import gc
import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from policies import TINY, lerobot_policy, memory_samples, saved

from rover_lib.onboard.artifact.manifest import LARGEST_TOLERANCE
from rover_lib.onboard.errors import ArtifactError
from rover_lib.onboard.policy.load import load_policy
from rover_lib.workshop import act
from rover_lib.workshop.act import ACT, inputs_of, predictions
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint
from rover_lib.workshop.int8 import observe
from rover_lib.workshop.int8 import quantize as q
from rover_lib.workshop.int8.choose import Chooser, best_of, float_costs_pct
from rover_lib.workshop.int8.export import export
from rover_lib.workshop.int8.observe import (
    Calibration,
    RangeObserver,
    calibrate,
    restore_observed,
    set_ranges,
)
from rover_lib.workshop.int8.quantize import quantize
from rover_lib.workshop.int8.scales import apply_channel_scales, channel_maxima, projections
from rover_lib.workshop.int8.scheme import ENGINE, OBSERVERS, SMALLEST_SCALE, Scheme

RANGE = {"steering": (-0.5, 0.5), "throttle": (0.0, 0.5)}


def inputs(checkpoint, count=4, seed=3):
    return [inputs_of(s, checkpoint.config) for s in memory_samples(count, *checkpoint.config.image_sizes[0], seed)]


@pytest.fixture(scope="module")
def made(tiny, calibration):
    """The tiny policy quantized by a scheme, and left as it is; of 70 MB each, the last two are not made again."""
    return functools.lru_cache(2)(lambda scheme: quantize(tiny, scheme, calibration))


@pytest.mark.slow
@pytest.mark.parametrize(
    "variant", [{}, {"pre_norm": True, "n_encoder_layers": 2}, {"feedforward_activation": "gelu"}], ids=str
)
def test_channel_scales_are_exact_in_float(variant, tmp_path):
    saved(lerobot_policy(**(TINY | variant)), tmp_path)
    checkpoint = load_checkpoint(tmp_path)
    seen = inputs(checkpoint, 3)
    for smooth, for_int8 in itertools.product((0.0, 0.5, 1.0), (False, True)):
        model = ACT(checkpoint.config, checkpoint.weights, for_int8=for_int8)
        before = predictions(model, seen)
        maxima = channel_maxima(model, seen)
        apply_channel_scales(model, maxima, smooth)
        assert any(b is not None for n, b in model.named_buffers() if n.endswith("v_in"))
        assert (predictions(model, seen) - before).abs().max() < 1e-5


def test_channel_scales_even_out_an_outlier_channel(tiny):
    """One channel of the last feed-forward's output fifty times the rest: what cost the throttle 2.8 %."""
    weights = {k: v.clone() for k, v in tiny.weights.items()}
    weights["decoder.layers.1.linear2.weight"][5] *= 50
    loud = replace(tiny, weights=weights, sha256="loud")
    name = "decoder.1.feed_forward.down"
    seen = calibrate(loud, memory_samples(8)).channels[name]

    def spread(x):
        return (x.max() / x.median()).item()

    assert spread(seen["out_max"]) > 10
    assert spread(seen["out_max_scaled"]) < 3


@pytest.mark.parametrize("kind", ["symmetric", "affine"])
@pytest.mark.parametrize("mode", ["dynamic", "static", "mixed"])
@pytest.mark.slow
def test_acts_on_every_layer_and_stays_close(tiny, made, mode, kind):
    quantized = made(Scheme(mode, kind, float_blocks=("backbone.stem",) if mode == "mixed" else ()))
    convs = [n for n, m in ACT(tiny.config, tiny.weights).named_modules() if isinstance(m, torch.nn.Conv2d)]
    expected_dynamic = len(projections(ACT(tiny.config, tiny.weights)))
    expected = {"dynamic": expected_dynamic, "static": expected_dynamic + len(convs)}
    expected["mixed"] = expected["static"] - 1
    assert quantized.report["int8_modules"] == expected[mode]
    assert set(quantized.report["embeddings"]) == {"encoder_1d_feature_pos_embed", "decoder_pos_embed"}
    x = inputs(tiny)
    reference = predictions(ACT(tiny.config, tiny.weights), x)
    error = (predictions(quantized.module, x) - reference).abs()
    assert 0 < error.mean() < 0.1 * reference.std()


def slow_layers():
    """Layers that torch would not run on the fast kernels, made by hand: (what the guard says, policy)."""

    torch.backends.quantized.engine = ENGINE  # weights are packed for it

    def linear(per_channel: bool):
        w = torch.randn(16, 16).clamp(-1, 1)
        if per_channel:
            w = torch.quantize_per_channel(
                w, torch.full((16,), 0.02), torch.zeros(16, dtype=torch.long), 0, torch.qint8
            )
        else:
            w = torch.quantize_per_tensor(w.index_fill(0, torch.tensor(0), -9.0), 0.02, 0, torch.qint8)
            assert w.int_repr().min() == -128
        m = q.int8.Linear(16, 16)
        m.set_weight_bias(w, torch.zeros(16))
        m.scale, m.zero_point = 0.1, 0
        return m

    def conv(zero_point: int = 0, scale: float = 0.1):
        w = torch.randn(16, 16, 1, 1).clamp(-1, 1)
        m = q.int8.Conv2d(16, 16, 1)
        points = torch.full((16,), zero_point)
        m.set_weight_bias(torch.quantize_per_channel(w, torch.full((16,), 0.02), points, 0, torch.qint8), None)
        m.scale, m.zero_point = scale, 0
        return m

    tokens, picture = torch.randn(1, 4, 16), torch.randn(1, 16, 3, 3)
    yield "a linear with a scale per channel", linear(True), tokens, torch.qint8
    yield r"not qint8 in \[-127, 127\]", linear(False), tokens, torch.qint8
    yield "input is quint8, not qint8", conv(), picture, torch.quint8
    yield "a zero point is not 0", conv(zero_point=3), picture, torch.qint8
    yield r"ratio of .*, outside", conv(scale=2**-12), picture, torch.qint8


class Sandwich(torch.nn.Module):
    def __init__(self, inner, dtype, scale=0.05):
        super().__init__()
        self.inner, self.dtype, self.scale = inner, dtype, scale

    def forward(self, x):
        return self.inner(torch.quantize_per_tensor(x, self.scale, 0, self.dtype)).dequantize()


@pytest.mark.parametrize(("reason", "layer", "x", "dtype"), slow_layers())
def test_the_guard_names_a_layer_that_misses_the_fast_kernels(reason, layer, x, dtype):
    scale = 2000.0 if "ratio" in reason else 0.05
    with pytest.raises(ArtifactError, match=f"1 of 1 layers would miss the fast kernels: inner: .*{reason}"):
        q.check_fast(Sandwich(layer, dtype, scale), (x,))


@pytest.mark.slow
def test_int8_layer_equals_torchs_fake_quantize(tiny, calibration, made):
    """The first layer's INT8 output against quantize -> float convolution -> quantize, to one step."""
    quantized = made(Scheme("static"))
    prepared = restore_observed(tiny, Scheme("static"), calibration)
    seen = {}
    conv = quantized.module.get_submodule("backbone.stem.0")
    hook = conv.register_forward_hook(lambda m, args, out: seen.update(x=args[0], y=out))
    quantized.module(*inputs(tiny, 1)[0])
    hook.remove()
    x, y = seen["x"], seen["y"]
    plain = prepared.get_submodule("backbone.stem.0")
    float_conv = plain[0] if isinstance(plain, torch.nn.Sequential) else plain
    w = conv.weight().dequantize()
    z = torch.relu(
        torch.nn.functional.conv2d(x.dequantize(), w, float_conv.bias, float_conv.stride, float_conv.padding)
    )
    z = torch.fake_quantize_per_tensor_affine(z, y.q_scale(), y.q_zero_point(), -128, 127)
    assert (y.dequantize() - z).abs().max() <= 1.01 * y.q_scale()


def test_a_mode_that_changed_nothing_is_an_error(tiny, calibration, monkeypatch):
    monkeypatch.setattr(observe, "_pattern", lambda block, relu: "no such module")
    with pytest.raises(ArtifactError):
        quantize(tiny, Scheme("static"), calibration)
    with pytest.raises(ArtifactError, match="nothing was quantized"):
        q.check_acted({}, ["a"])
    with pytest.raises(ArtifactError, match="1 of 2 layers stayed float: b"):
        q.check_acted({"a": torch.nn.Identity()}, ["a", "b"])


def test_refusals(tiny, calibration, tmp_path):
    (tmp_path / "bad.pt").write_bytes(b"x")
    sized = replace(tiny, config=replace(tiny.config, image_sizes=((96, 160),)))
    still = {"steering": (0.0, 0.0), "throttle": (0.0, 0.0)}
    refused = {
        "no_block": lambda: quantize(tiny, Scheme("mixed", float_blocks=("no_block",)), calibration),
        "made with smooth": lambda: quantize(tiny, Scheme(smooth=None), calibration),
        "another checkpoint": lambda: quantize(replace(tiny, sha256="other"), Scheme(), calibration),
        "made with images": lambda: quantize(sized, Scheme(), calibration),
        "needs samples": lambda: calibrate(tiny, []),
        "choosing needs": lambda: Chooser(tiny, calibration, [], RANGE),
        "never change": lambda: Chooser(tiny, calibration, memory_samples(1), still),
        "02_calibrate": lambda: Calibration.load(tmp_path / "none.pt"),
        "not a calibration": lambda: Calibration.load(tmp_path / "bad.pt"),
        "saw nothing": lambda: observer().calculate_qparams(),
        "mode 'int4'": lambda: Scheme("int4"),
        "smooth must be": lambda: Scheme(smooth=1.5),
        "percentile": lambda: Scheme(percentile=0.0),
    }
    for words, act_on in refused.items():
        with pytest.raises(ArtifactError, match=words):
            act_on()


def test_non_finite_activations_are_an_error(tiny):
    weights = {k: v.clone() for k, v in tiny.weights.items()}
    weights["backbone.conv1.weight"] *= 1e38
    with pytest.raises(ArtifactError, match="NaN or Inf"):
        calibrate(replace(tiny, weights=weights), memory_samples(1))


@pytest.mark.slow
def test_inspect_layers_sees_clipping(tiny, calibration):
    quantized = quantize(tiny, Scheme(observer="minmax"), calibration)
    rows = {r["name"]: r for r in q.inspect_layers(quantized, tiny, calibration, memory_samples(12))}
    assert len(rows) == quantized.report["int8_modules"]
    # The calibration's own samples, min-max: nothing is clipped, and every layer carries a signal.
    assert max(r["clipped_pct"] for r in rows.values()) < 0.5
    assert min(r["snr_db"] for r in rows.values()) > 5
    assert not q.warn_of_clipping(list(rows.values()), 1.0)
    conv = quantized.module.get_submodule("backbone.layer1.0.body.0")
    conv.scale = float(conv.scale) / 4
    rows = q.inspect_layers(quantized, tiny, calibration, memory_samples(2))
    row = next(r for r in rows if r["name"] == "backbone.layer1.0.body.0")
    assert row["clipped_pct"] > 1
    assert any("layer1.0.body.0" in w for w in q.warn_of_clipping(rows, 1.0))


@pytest.mark.slow
def test_chooses_by_error(tiny, calibration):
    chooser = Chooser(tiny, calibration, memory_samples(3, seed=8), RANGE)
    scheme, table = chooser.observer(Scheme())
    assert set(table) == set(OBSERVERS) - {"frames"}  # no frame is odd
    least = min(max(row.values()) for row in table.values())
    assert max(table[scheme.observer].values()) == least or scheme.observer == "minmax"
    sensitivity = chooser.sensitivity(scheme)
    assert list(sensitivity) == act.blocks(tiny.config)
    assert all(max(e.values()) > 0 for e in sensitivity.values())  # each block alone does something
    costs = float_costs_pct(tiny)
    assert 0 < sum(costs.values()) <= 100 * 3.2  # all in float, but for the head: 4.2 times the instructions
    few = dict(list(sensitivity.items())[::2])  # each block takes a conversion
    mixed, steps = chooser.mixed(scheme, few, budget_pct=1e-6, max_cost_pct=60)
    errors = [max(s["steering_mae_pct"], s["throttle_mae_pct"]) for s in steps]
    assert errors == sorted(errors, reverse=True) and len(set(errors)) == len(errors) > 1
    assert mixed.mode == "mixed" and list(mixed.float_blocks) == steps[-1]["float_blocks"]
    assert steps[-1]["cost_pct"] == pytest.approx(sum(costs[b] for b in mixed.float_blocks))
    assert steps[-1]["cost_pct"] <= 60
    for limits in ({"budget_pct": 100, "max_cost_pct": 60}, {"budget_pct": 1e-6, "max_cost_pct": 0}):
        plain, steps = chooser.mixed(scheme, sensitivity, **limits)
        assert plain.float_blocks == () and len(steps) == 1  # nothing is needed, and nothing is free


@pytest.mark.parametrize(
    ("errors", "chosen"),
    [
        ({"histogram": (0.1, 0.27), "minmax": (0.1, 0.3), "percentile": (0.1, 0.35)}, "minmax"),  # hardly better
        ({"histogram": (0.1, 0.23), "minmax": (0.1, 0.3), "percentile": (0.1, 0.25)}, "histogram"),
        ({"histogram": (0.2, None), "minmax": (0.3, None)}, "histogram"),  # throttle never changes: not judged
        ({"histogram": (0.2, None), "minmax": (0.21, None)}, "minmax"),
        ({"histogram": (0.1, 0.3), "percentile": (0.1, 0.29)}, "percentile"),
    ],
)
def test_an_observer_that_clips_must_win_clearly(errors, chosen):
    table = {name: dict(zip(("steering", "throttle"), row, strict=True)) for name, row in errors.items()}
    assert best_of({name: Scheme(observer=name) for name in errors}, table) == chosen


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["symmetric", "affine"])
def test_one_conversion_takes_the_ranges_of_every_scheme(tiny, calibration, made, kind):
    """To the last bit as if each were converted: choosing converts once, as conversions took most of its time."""
    schemes = [Scheme(kind=kind), Scheme(kind=kind, observer="minmax"), Scheme(kind=kind)]
    graph, x = restore_observed(tiny, schemes[1], calibration), inputs(tiny)
    policy = q.Rangeable(graph, tiny.config, schemes[1])
    for scheme in schemes:
        set_ranges(graph, scheme, calibration)
        policy.take()
        assert torch.equal(predictions(policy.module, x), predictions(made(scheme).module, x))


@pytest.mark.slow
def test_choosing_holds_no_policy_that_it_has_judged(tiny, calibration):
    chooser = Chooser(tiny, calibration, memory_samples(1, seed=8), RANGE)

    def alive() -> int:
        return sum(isinstance(thing, torch.fx.GraphModule) for thing in gc.get_objects())

    gc.collect()
    before = alive()
    gc.disable()  # which collects when it likes, and would hide what is held
    try:
        chooser.sensitivity(Scheme("static"))
        assert alive() <= before + 4, "the observed graph and the last policy, each with its graph's own module"
    finally:
        gc.enable()


@pytest.mark.slow
def test_an_action_that_never_changes_takes_no_part_in_choosing(tiny, calibration):
    chooser = Chooser(tiny, calibration, memory_samples(2, seed=8), {"steering": (-0.5, 0.5), "throttle": (0.06, 0.06)})
    assert [w.partition(",")[0] for w in chooser.warnings] == ["throttle never changes in these recordings"]
    scheme, table = chooser.observer(Scheme(), ["minmax", "histogram"])
    assert all(row["throttle_mae_pct"] is None and row["steering_mae_pct"] > 0 for row in table.values())
    blocks = {"backbone.stem": table["minmax"], "image_project": table["histogram"]}
    mixed, steps = chooser.mixed(scheme, blocks, budget_pct=100, max_cost_pct=60)
    assert mixed.float_blocks == () and len(steps) == 1 and steps[0]["throttle_mae_pct"] is None


finite = st.floats(-1e4, 1e4, allow_nan=False, width=32)


def observer(choice="minmax"):
    return RangeObserver(dtype=torch.qint8, quant_min=-128, quant_max=127, choice=choice, percentile=99.0)


@settings(deadline=None, max_examples=50)
@given(st.lists(st.lists(finite, min_size=1, max_size=50), min_size=1, max_size=5), st.sampled_from(OBSERVERS))
def test_an_observers_range_is_within_what_it_saw(batches, choice):
    o = observer(choice)
    for b in batches:
        o(torch.tensor(b))
    values = np.concatenate([np.asarray(b, np.float32) for b in batches])
    low, high = o.range()
    assert min(values.min(), 0) - 1e-3 <= low <= 0 <= high <= max(values.max(), 0) + 1e-3
    assert o.histogram.sum() == len(values)  # no value falls off when the limit doubles
    scale, zero = o.calculate_qparams()
    assert scale >= SMALLEST_SCALE and -128 <= zero <= 127


def test_the_least_squares_range_is_the_best_of_all_pairs():
    """By the definition: of each pair of ends, the error of every value that is rounded or clipped."""
    o = observer("histogram")
    o(torch.from_numpy(np.random.default_rng(0).laplace(size=100_000).astype(np.float32)))
    x, weight = o._centres().double(), (o.histogram / o.histogram.sum()).double()

    def error(low, high):
        clipped = torch.where(x > high, x - high, torch.where(x < low, low - x, torch.zeros_like(x)))
        return ((high - low) / 255) ** 2 / 12 + float(clipped**2 @ weight)

    shares = np.linspace(1, 0.1, 31)
    pairs = [(o.min_val.item() * a, o.max_val.item() * b) for a in shares for b in shares]
    assert o.range() == pytest.approx(min(pairs, key=lambda pair: error(*pair)), rel=1e-6)
    assert o.range()[1] < 0.9 * o.max_val.item(), "it clips what is rare"


def test_growing_the_histogram_keeps_it_exact():
    one, two = observer(), observer()
    small, large = torch.linspace(-1, 1, 1001), torch.linspace(-4, 4, 1001)
    one(small), one(large)
    two(large)  # its limit is 4 from the start
    two(small)
    assert one.limit == two.limit == 4
    # A value on the border of two bins may fall on either side, nothing moves further.
    assert (one.histogram.cumsum(0) - two.histogram.cumsum(0)).abs().max() <= 2


def test_percentile_and_histogram_drop_a_lone_outlier():
    x = torch.cat([torch.linspace(-1, 1, 100_000), torch.tensor([50.0])])
    seen = [observer(choice) for choice in ("minmax", "percentile", "histogram")]
    for each in seen:
        each(x)
    minmax, percentile, histogram = (each.range()[1] for each in seen)
    assert minmax == 50 and percentile < 1.1 and histogram < 50


@pytest.mark.slow
def test_a_policy_that_loses_much_by_int8_is_an_artifact_all_the_same(tiny, calibration, tmp_path):
    """What it loses is for the gates to judge; what may differ on a car stays within what a reader takes."""
    bias = tiny.weights["action_head.bias"] + torch.tensor([0.0, 0.5])
    off = ACT(tiny.config, {**tiny.weights, "action_head.bias": bias})
    export(q.QuantizedPolicy(Scheme(), tiny.config, off, {}), tiny, tmp_path / "a.pt", memory_samples(2), calibration)
    manifest = load_policy(tmp_path / "a.pt").manifest
    assert manifest["parity"]["tolerance"]["throttle"] == LARGEST_TOLERANCE["int8"]


def test_a_badly_written_graph_sets_no_tolerance_for_itself(tiny, calibration, tmp_path, monkeypatch):
    bias = tiny.weights["action_head.bias"] + torch.tensor([0.1, 0.0])
    off = ACT(tiny.config, {**tiny.weights, "action_head.bias": bias})  # steering may differ, throttle may not

    def badly_written(module, config):
        return SimpleNamespace(predict=lambda inputs: predictions(module, inputs) + torch.tensor([0.0, 0.5]))

    monkeypatch.setattr("rover_lib.workshop.int8.export.TorchScript", badly_written)
    policy = q.QuantizedPolicy(Scheme(), tiny.config, off, {})
    with pytest.raises(ArtifactError, match="throttle of the written graph differs"):
        export(policy, tiny, tmp_path / "a.pt", memory_samples(2), calibration)
    assert not (tmp_path / "a.pt").exists()

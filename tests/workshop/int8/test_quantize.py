"""Quantization: exact where it claims to be, acting where it claims to act, loud where it cannot."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rover_lib.onboard.artifact.manifest import LARGEST_TOLERANCE, read_manifest
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.errors import ArtifactError
from rover_lib.onboard.policy.load import load_policy
from rover_lib.workshop.act import ACT, blocks, inputs_of, multiply_accumulates, predictions
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint
from rover_lib.workshop.int8 import observe
from rover_lib.workshop.int8 import quantize as q
from rover_lib.workshop.int8.choose import Chooser, best_of, float_costs_pct, mae_pct
from rover_lib.workshop.int8.export import Exporter
from rover_lib.workshop.int8.observe import Calibration, RangeObserver, calibrate, restore_observed
from rover_lib.workshop.int8.quantize import quantize
from rover_lib.workshop.int8.scales import (
    _input_scale,
    _output_scale,
    apply_channel_scales,
    channel_maxima,
    projections,
)
from rover_lib.workshop.int8.scheme import ENGINE, OBSERVERS, SMALLEST_SCALE, Scheme
from rover_lib.workshop.recordings.episodes import load_recordings
from tests.helpers.policies import TINY, lerobot_policy, memory_samples, saved
from tests.helpers.recorded import record_drives

RANGE = {"steering": (-0.5, 0.5), "throttle": (0.0, 0.5)}


def inputs(checkpoint, count=4, seed=3):
    return [inputs_of(s, checkpoint.config) for s in memory_samples(count, *checkpoint.config.image_sizes[0], seed)]


@pytest.fixture(scope="module")
def static(tiny, calibration):
    return quantize(tiny, Scheme(), calibration)


# Channel scales


@pytest.mark.slow
@pytest.mark.parametrize(
    "variant", [{"pre_norm": True, "n_encoder_layers": 2}, {"feedforward_activation": "gelu"}], ids=str
)
def test_channel_scales_are_exact_in_float(variant, tmp_path):
    saved(lerobot_policy(**(TINY | variant)), tmp_path)
    checkpoint = load_checkpoint(tmp_path)
    seen = inputs(checkpoint, 3)
    for smooth, for_int8 in ((0.0, False), (0.5, True), (1.0, False)):
        model = ACT(checkpoint.config, checkpoint.weights, for_int8=for_int8)
        before = predictions(model, seen)
        apply_channel_scales(model, channel_maxima(model, seen), smooth)
        assert any(b is not None for n, b in model.named_buffers() if n.endswith("v_in"))
        assert (predictions(model, seen) - before).abs().max() < 1e-5


@pytest.mark.parametrize("smooth", [0.0, 1.0])
def test_smooth_1_evens_out_activations_and_0_weights(tiny, smooth):
    model, seen, name = ACT(tiny.config, tiny.weights), inputs(tiny, 3), "encoder.0.feed_forward.up"
    maxima, one_by_one = channel_maxima(model, seen), [channel_maxima(model, [x])[name] for x in seen]
    for key, found in maxima[name].items():
        assert torch.equal(found, torch.stack([each[key] for each in one_by_one]).amax(0))
    apply_channel_scales(model, maxima, smooth)
    even, uneven = channel_maxima(model, seen)[name]["in_max"], model.get_submodule(name).weight.abs().amax(0)
    if smooth == 0:
        even, uneven = uneven, even
    assert even.max() / even.min() < 1.01 < 1.2 < uneven.max() / uneven.min()


# What becomes INT8


@pytest.mark.parametrize("mode", ["dynamic", "mixed"])
@pytest.mark.slow
def test_acts_on_every_layer_and_stays_close(tiny, calibration, mode):
    in_float = ("backbone.stem",) if mode == "mixed" else ()
    quantized = quantize(tiny, Scheme(mode, float_blocks=in_float), calibration)
    model = ACT(tiny.config, tiny.weights)
    convs = [m for m in model.modules() if isinstance(m, torch.nn.Conv2d)]
    expected = len(projections(model)) + (0 if mode == "dynamic" else len(convs)) - len(in_float)
    assert quantized.report["int8_modules"] == expected == len(q.int8_layers(quantized.module))
    x = inputs(tiny)
    reference = predictions(model, x)
    assert 0 < (predictions(quantized.module, x) - reference).abs().mean() < 0.1 * reference.std()


def test_weights_have_a_scale_per_channel_and_use_every_step(static):
    for layer in q.int8_layers(static.module).values():
        weight = layer.weight()
        assert weight.qscheme() == torch.per_channel_affine
        assert (weight.int_repr().flatten(1).abs().amax(1) == 127).float().mean() > 0.9  # but where the scale is least


def slow_layers():
    """Layers that torch would not run on the fast kernels, made by hand: (layer, input, its dtype, its scale)."""
    torch.backends.quantized.engine = ENGINE  # weights are packed for it
    steps, zeros = torch.full((16,), 0.02), torch.zeros(16, dtype=torch.long)

    def conv(zero_point: int = 0, scale: float = 0.1, largest: float = 1.0):
        w = torch.randn(16, 16, 1, 1).clamp(-1, 1) * largest
        m = q.int8.Conv2d(16, 16, 1)
        m.set_weight_bias(torch.quantize_per_channel(w, steps, zeros + zero_point, 0, torch.qint8), None)
        m.scale, m.zero_point = scale, 0
        return m

    picture = torch.randn(1, 16, 3, 3)
    yield conv(largest=9.0), picture, torch.qint8, 0.05  # -128 is in it
    yield conv(), picture, torch.quint8, 0.05
    yield conv(zero_point=3), picture, torch.qint8, 0.05
    yield conv(scale=2**-12), picture, torch.qint8, 2000.0


@pytest.mark.parametrize(("layer", "x", "dtype", "scale"), slow_layers())
def test_the_guard_names_a_layer_that_misses_the_fast_kernels(layer, x, dtype, scale):
    with pytest.raises(ArtifactError, match="1 of 1 layers would miss the fast kernels: 1"):
        q.check_fast(torch.nn.Sequential(q.int8.Quantize(scale, 0, dtype), layer, q.int8.DeQuantize()), (x,))


def test_a_mode_that_changed_nothing_is_an_error(tiny, calibration, monkeypatch):
    monkeypatch.setattr(observe, "_pattern", lambda block, relu: "no such module")
    with pytest.raises(ArtifactError):
        quantize(tiny, Scheme("static"), calibration)
    for layers in ({}, {"a": torch.nn.Identity()}):
        with pytest.raises(ArtifactError):
            q.check_acted(layers, ["a", "b"])


def test_refusals(tiny, calibration, tmp_path):
    (tmp_path / "bad.pt").write_bytes(b"x")
    sized = replace(tiny, config=replace(tiny.config, image_sizes=((96, 160),)))
    weights = tiny.weights | {"backbone.conv1.weight": tiny.weights["backbone.conv1.weight"] * 1e38}
    still = {"steering": (0.0, 0.0), "throttle": (0.0, 0.0)}
    for act_on in (
        lambda: quantize(tiny, Scheme("mixed", float_blocks=("no_block",)), calibration),
        lambda: restore_observed(tiny, Scheme(smooth=None), calibration),
        lambda: restore_observed(replace(tiny, sha256="other"), Scheme(), calibration),
        lambda: restore_observed(sized, Scheme(), calibration),
        lambda: calibrate(tiny, []),
        lambda: calibrate(replace(tiny, weights=weights), memory_samples(1)),  # not finite
        lambda: Chooser(tiny, calibration, [], RANGE),
        lambda: Chooser(tiny, calibration, memory_samples(1), still),
        lambda: Calibration.load(tmp_path / "none.pt"),
        lambda: Calibration.load(tmp_path / "bad.pt"),
        lambda: RangeObserver(choice="minmax").calculate_qparams(),  # it saw nothing
        lambda: Scheme("int4"),
        lambda: Scheme(smooth=1.5),
        lambda: Scheme(wider=(("image_project", 2.0),)),
    ):
        with pytest.raises(ArtifactError):
            act_on()


@pytest.mark.slow
def test_clipping_at_either_end_counts(tiny, calibration):
    quantized, few = quantize(tiny, Scheme(observer="minmax"), calibration), memory_samples(12)[:4]
    assert q.most_clipped(quantized, tiny, calibration, few)["clipped_pct"] < 0.5  # they calibrated
    layer = quantized.module.get_submodule("image_project")  # its values have both signs
    layer.scale = float(layer.scale) / 4
    low, high = ((end - layer.zero_point + beyond) * layer.scale for end, beyond in ((-128, -0.5), (127, 0.5)))
    given, graph = [], restore_observed(tiny, Scheme(observer="minmax"), calibration)
    graph.get_submodule("image_project").register_forward_hook(lambda m, args, out: given.append(out))
    graph(*inputs_of(few[0], tiny.config))
    below, above = (beyond.float().mean().item() for beyond in (given[0] < low, given[0] > high))
    assert below > 0.01 and above > 0.01
    found = q.most_clipped(quantized, tiny, calibration, few[:1])
    assert found == {"layer": "image_project", "clipped_pct": pytest.approx(100 * (below + above))}


# Choosing


@pytest.fixture(scope="module")
def chooser(tiny, calibration):
    return Chooser(tiny, calibration, memory_samples(3, seed=8), RANGE)


def test_an_error_is_a_weighted_mean_in_percent_of_the_range():
    errors, weights = torch.tensor([[0.1, 0.1], [0.3, 0.0]]), torch.tensor([3.0, 1.0])
    found = mae_pct(errors, weights, RANGE | {"throttle": (0.0, 0.25)})
    assert found == pytest.approx({"steering_mae_pct": 15.0, "throttle_mae_pct": 30.0})


def test_a_frames_error_is_the_mean_of_its_plans_steps(tiny, chooser):
    off = torch.linspace(0, 0.02, tiny.config.chunk)[None, :, None]

    class Off(torch.nn.Module):
        def forward(self, *x):
            return predictions(ACT(tiny.config, tiny.weights), [x]) - off

    assert chooser.error(Off()) == pytest.approx({"steering_mae_pct": 1.0, "throttle_mae_pct": 2.0}, rel=1e-3)


@pytest.mark.slow
def test_each_block_alone_does_something(tiny, chooser):
    sensitivity = chooser.sensitivity(Scheme(observer="minmax"))
    assert list(sensitivity) == blocks(tiny.config) and all(max(e.values()) > 0 for e in sensitivity.values())
    assert 300 < sum(float_costs_pct(tiny).values()) <= 100 * 3.2  # all in float: 4.2 times the instructions


@pytest.fixture
def by_hand(chooser, monkeypatch):
    """Mixed, where a block that stays in float takes as much off an error of 3 % as given: {block: (taken, cost)}."""
    module = "rover_lib.workshop.int8.choose"
    monkeypatch.setattr(f"{module}.convert", lambda graph, config, scheme: scheme.float_blocks)

    def mixed(given, **limits):
        def error(in_float):
            return {"steering_mae_pct": 3.0 - sum(given[block][0] for block in in_float)}

        monkeypatch.setattr(chooser, "error", error)
        monkeypatch.setattr(f"{module}.float_costs_pct", lambda _: {block: cost for block, (_, cost) in given.items()})
        sensitivity = {block: {"steering_mae_pct": abs(taken)} for block, (taken, _) in given.items()}
        return chooser.mixed(Scheme(), sensitivity, **limits)

    return mixed


@pytest.mark.parametrize(
    ("budget_pct", "max_cost_pct", "in_float"),
    [
        (3.0, 99, ()),  # nothing is needed
        (1.5, 99, ("much",)),
        (0.0, 99, ("much", "dear", "little")),  # by squared error per instruction; what makes it worse stays INT8
        (0.0, 20, ("much", "little")),
        (0.0, 10, ("much",)),  # a cost at the limit is allowed
    ],
)
def test_mixed_leaves_in_float_what_gains_most_for_its_cost(by_hand, budget_pct, max_cost_pct, in_float):
    given = {"little": (0.1, 5.0), "dear": (0.9, 50.0), "much": (1.6, 10.0), "worse": (-0.5, 1.0)}
    mixed, steps = by_hand(given, budget_pct=budget_pct, max_cost_pct=max_cost_pct)
    assert mixed.mode == "mixed" and mixed.float_blocks == in_float == tuple(steps[-1]["float_blocks"])
    assert steps[-1]["cost_pct"] == pytest.approx(sum(given[b][1] for b in in_float))
    errors = [step["steering_mae_pct"] for step in steps]
    assert errors == sorted(errors, reverse=True) and len(steps) == 1 + len(in_float)


def test_mixed_that_gains_nothing_is_static_and_says_so(by_hand, chooser):
    """It once left two blocks in float for 0.230 to 0.226 %, and nobody was told."""
    mixed, (static,) = by_hand({"little": (0.2, 5.0), "worse": (-0.5, 1.0)}, budget_pct=0.0, max_cost_pct=99)
    assert mixed.float_blocks == () and static["float_blocks"] == []
    assert chooser.warnings.pop() == "mixed gains nothing by little in float: 3.000 to 2.800 %"


@pytest.mark.parametrize(
    ("errors", "chosen"),
    [
        ({"histogram": (0.1, 0.27), "minmax": (0.1, 0.3)}, "minmax"),  # hardly better
        ({"histogram": (0.1, 0.23), "minmax": (0.1, 0.3)}, "histogram"),
        ({"histogram": (0.2, None), "minmax": (0.3, None)}, "histogram"),  # throttle never changes: not judged
    ],
)
def test_an_observer_that_clips_must_win_clearly(errors, chosen):
    keys = "steering_mae_pct", "throttle_mae_pct"
    table = {name: dict(zip(keys, row, strict=True)) for name, row in errors.items()}
    assert best_of({name: Scheme(observer=name) for name in errors}, table) == chosen


# Observers

finite = st.floats(-1e4, 1e4, allow_nan=False, width=32)


@settings(deadline=None, max_examples=50)
@given(st.lists(st.lists(finite, min_size=1, max_size=50), min_size=1, max_size=5), st.sampled_from(OBSERVERS))
def test_an_observers_range_is_within_what_it_saw(batches, choice):
    o = RangeObserver(choice=choice)
    for b in batches:
        o(torch.tensor(b))
    values = np.concatenate([np.asarray(b, np.float32) for b in batches])
    low, high = o.range()
    least, most = min(values.min(), 0), max(values.max(), 0)
    assert least - 1e-3 <= low <= 0 <= high <= most + 1e-3
    if choice == "minmax":
        assert (low, high) == (least, most)
    assert o.histogram.sum() == len(values)  # no value falls off when the limit doubles
    scale, zero = o.calculate_qparams()
    assert scale >= SMALLEST_SCALE and -128 <= zero <= 127


@pytest.mark.parametrize("positive", [False, True])
def test_the_least_squares_range_is_the_best_of_all_pairs(positive):
    """By the definition: of each pair of ends around 0, the error of every value that is rounded or clipped."""
    o = RangeObserver(choice="histogram")
    rng = np.random.default_rng(0)
    values = 0.95 + 0.01 * np.abs(rng.standard_t(3, 100_000)) if positive else rng.laplace(size=100_000)
    o(torch.from_numpy(values.astype(np.float32)))
    x, weight = o._centres().double(), (o.histogram / o.histogram.sum()).double()

    def error(low, high):
        clipped = torch.where(x > high, x - high, torch.where(x < low, low - x, torch.zeros_like(x)))
        return ((high - low) / 255) ** 2 / 12 + float(clipped**2 @ weight)

    shares = np.linspace(1, 0.1, 31)
    pairs = [(min(o.min_val.item() * a, 0), o.max_val.item() * b) for a in shares for b in shares]
    assert o.range() == pytest.approx(min(pairs, key=lambda pair: error(*pair)), rel=1e-6)
    assert o.range()[1] < 0.9 * o.max_val.item(), "it clips what is rare"


# Export


def off_by(checkpoint, *by):
    """Static INT8 whose actions are this far from FP32's."""
    bias = checkpoint.weights["action_head.bias"] + torch.tensor(by)
    act = ACT(checkpoint.config, {**checkpoint.weights, "action_head.bias": bias})
    return q.QuantizedPolicy(Scheme(), act, {})


@pytest.mark.slow
def test_an_artifact_says_what_it_is(tiny, calibration, tmp_path):
    """Its rate, its car, its camera's shape, and how far it may differ: twice its own error, never too much."""
    described = Car().description()
    described["steering"] = {"period_us": 20000, "left_us": 1900, "neutral_us": 1500, "right_us": 1100}
    car = Car.of(described)
    recorded = load_recordings(record_drives(tmp_path / "drives", drives=1)).samples[::6]
    policy = replace(tiny, config=replace(tiny.config, rate_hz=12.0, image_sizes=((72, 96),)))
    exporter = Exporter(policy, [replace(s, car=car) for s in recorded])
    exporter.export(off_by(policy, 0.02, 0.5), tmp_path / "a.pt", calibration)
    found = load_policy(tmp_path / "a.pt")
    assert found.rate_hz == 12 and found.car.drives_like(car) and not found.car.drives_like(Car())
    assert found.manifest["cameras"][0]["recorded"] == [54, 96]
    tolerance = found.manifest["parity"]["tolerance"]
    assert tolerance["steering"] == pytest.approx(0.04, rel=1e-3)
    assert tolerance["throttle"] == LARGEST_TOLERANCE["int8"]  # what it loses is for the gates to judge
    assert found.manifest["calibration"]["samples"] == 12 and found.manifest["mode"] == "static"
    act = exporter.float_policy
    assert found.manifest["gmac"] == pytest.approx(sum(multiply_accumulates(act).values()) / 1e9)
    assert found.manifest["weights_mb"] == pytest.approx(4 * sum(p.numel() for p in act.parameters()) / 1e6)
    Exporter(tiny, memory_samples(2)).export(ACT(tiny.config, tiny.weights), tmp_path / "b.pt")
    assert "car" not in read_manifest(tmp_path / "b.pt")
    assert read_manifest(tmp_path / "b.pt")["parity"]["tolerance"]["steering"] == pytest.approx(1e-4)


def test_a_tolerance_by_hand(tiny):
    """FP32's grows with an action beyond 1; INT8's is a multiple of its largest error, and never less than FP32's."""
    exporter = Exporter(tiny, memory_samples(2))
    exporter.parity = {"vectors": 2, "fp32": 0.001, "int8_errors": 3}
    exporter.float_actions = torch.tensor([[[0.5, 40.0]], [[-0.5, 20.0]]])
    actions = exporter.float_actions + torch.tensor([[[0.1, 0.01]], [[-0.2, 0.0]]])
    for policy, wanted in ((exporter.float_policy, [0.001, 0.04001]), (off_by(tiny, 0, 0), [0.6, 0.04001])):
        found = exporter._tolerance(policy, actions, np.array([0, 1]))
        assert [*found.values()] == pytest.approx(wanted, rel=1e-4)
    assert exporter._tolerance(policy, actions[1:], np.array([1]))["throttle"] == pytest.approx(0.02)


def test_a_badly_written_graph_sets_no_tolerance_for_itself(tiny, calibration, tmp_path, monkeypatch):
    """Steering may differ here, throttle may not."""

    def badly_written(module, config):
        return SimpleNamespace(run=lambda inputs: [predictions(module, [inputs]) + torch.tensor([0.0, 0.5])])

    monkeypatch.setattr("rover_lib.workshop.int8.export.TorchScript", badly_written)
    with pytest.raises(ArtifactError, match="throttle of the written graph differs"):
        Exporter(tiny, memory_samples(2)).export(off_by(tiny, 0.1, 0.0), tmp_path / "a.pt", calibration)
    assert not (tmp_path / "a.pt").exists()


def test_scales_by_hand():
    """The same code writes and reads them, so that a wrong one would still be exact in float."""
    assert _output_scale(torch.tensor([2.0, 1.0, 0.0])).tolist() == [1.0, 0.5, 1 / 64]
    # w^(1-a) / x^a, times what leaves the largest input, 4, as it was
    for smooth, wanted in ((0.0, [1.0, 1.0]), (0.5, [1.0, 2.0]), (1.0, [1.0, 4.0])):
        found = _input_scale(torch.tensor([4.0, 1.0]), [torch.tensor([[1.0, -1.0], [0.5, 0.5]])], smooth)
        assert found.tolist() == pytest.approx(wanted)
    observer = RangeObserver(choice="minmax")
    observer(torch.tensor([-1.0, 0.5, 3.0]))
    scale, zero_point = observer.calculate_qparams()
    assert scale.item() == pytest.approx(4 / 255) and zero_point.item() == -64  # -128 + 63.75, rounded

"""The kit for Hailo's compiler: its networks against the policy, its files against what it says of them."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from hailo_kit import FRAMES, normalised, opened
from policies import TINY, lerobot_policy, memory_samples, smooth_frame

from rover_hailo import int8_estimate as stand_in
from rover_hailo.chips import CHIPS, estimate
from rover_hailo.description import files
from rover_hailo.kit import write_kit
from rover_hailo.networks import networks
from rover_lib.onboard.errors import QuantizeError
from rover_lib.workshop.act import ACT, ActConfig, Affine, imagenet, inputs_of

DOCS = Path(__file__).parents[2] / "docs" / "hailo.md"


@pytest.fixture(scope="module")
def checkpoint(tiny):
    return normalised(tiny)


@pytest.fixture
def kit(hailo_kit):
    return hailo_kit


def session(model: onnx.ModelProto | Path) -> onnxruntime.InferenceSession:
    content = model.read_bytes() if isinstance(model, Path) else model.SerializeToString()
    return onnxruntime.InferenceSession(content)


def pictures(policy: ACT, frames: list[torch.Tensor]) -> dict[str, np.ndarray]:
    """Frames as the model script normalises them: the definition, (pixel / 255 - mean) / std."""
    named = {}
    for camera, norm, frame in zip(policy.config.cameras, policy.config.image_norm, frames, strict=True):
        x = frame.permute(2, 0, 1)[None].double() / 255
        x = x * torch.tensor(norm.scale)[:, None, None] + torch.tensor(norm.shift)[:, None, None]
        named[f"frame_{camera}"] = x.float().numpy()
    return named


def both_splits(policy: ACT, state: torch.Tensor, frames: list[torch.Tensor]) -> list[np.ndarray]:
    """(1, C, A) raw actions from `backbone` with its transformer, and from `whole`."""
    front, whole, rest = networks(policy)
    seen = pictures(policy, frames)
    features = session(front.model).run(None, seen)
    named = {f"features_{c}": f[0].transpose(1, 2, 0) for c, f in zip(policy.config.cameras, features, strict=True)}
    (split,) = session(rest).run(None, {"state": state.numpy(), **named})
    given = {"state": policy.state_norm(state)[:, :, None, None].numpy(), **seen}
    (actions,) = session(whole.model).run(None, given)
    return [split, policy.action_unnorm(torch.from_numpy(actions)).numpy()]


SHAPES = {
    "tiny": {"image_sizes": ((72, 128),), "names": ("steering", "throttle")},
    "two cameras, six joints": {"image_sizes": ((72, 128), (64, 96)), "names": tuple("abcdef")},
    "pre-norm, gelu": {"image_sizes": ((72, 128),), "names": ("a", "b"), "pre_norm": True, "activation": "gelu"},
}


def policy_of(image_sizes, names, **config) -> ACT:
    """LeRobot's random weights; states, actions and the colours of each camera normalised differently."""
    cameras = tuple(f"cam_{i}" for i in range(len(image_sizes)))
    lerobot = lerobot_policy(
        {f"observation.images.{c}": size for c, size in zip(cameras, image_sizes, strict=True)},
        states=len(names),
        actions=len(names),
        **TINY,
        pre_norm=config.get("pre_norm", False),
        feedforward_activation=config.get("activation", "relu"),
    )
    of_numbers = [Affine(tuple(s + 0.5 * i for i in range(len(names))), (0.1,) * len(names)) for s in (1.5, 0.3)]
    act = ActConfig(
        cameras=cameras,
        image_sizes=image_sizes,
        state_names=names,
        action_names=names,
        dim=TINY["dim_model"],
        heads=TINY["n_heads"],
        feedforward=TINY["dim_feedforward"],
        encoder_layers=1,
        decoder_layers=2,
        vae_layers=1,
        image_norm=(imagenet(), Affine((2.0,) * 3, (-1.0,) * 3))[: len(cameras)],
        state_norm=of_numbers[0],
        action_unnorm=of_numbers[1],
        **config,
    )
    return ACT(act, {name.removeprefix("model."): tensor for name, tensor in lerobot.state_dict().items()})


@pytest.mark.slow
@pytest.mark.parametrize("name", SHAPES)
def test_both_splits_in_onnx_runtime_are_the_policy(name):
    model = policy_of(**SHAPES[name])
    rng = np.random.default_rng(0)
    frames = [torch.from_numpy(smooth_frame(rng, *size)) for size in model.config.image_sizes]
    state = torch.from_numpy(rng.normal(size=(1, len(model.config.state_names))).astype(np.float32))
    with torch.inference_mode():
        expected = model(state, *frames).numpy()
    assert expected.std() > 1e-2
    for actions in both_splits(model, state, frames):
        assert np.abs(actions - expected).max() < 1e-5 * max(1, np.abs(expected).max())


@pytest.mark.slow
def test_networks_have_fixed_shapes_of_few_ranks_and_known_operators(checkpoint):
    front, whole, rest = networks(ACT(checkpoint.config, checkpoint.weights))
    for model in (front.model, whole.model, rest):
        onnx.checker.check_model(model, full_check=True)
        inferred = onnx.shape_inference.infer_shapes(model, strict_mode=True).graph
        values = [*inferred.input, *inferred.output, *inferred.value_info]
        assert len(values) > 10
        for value in values:
            sizes = [d.dim_value for d in value.type.tensor_type.shape.dim]
            assert all(sizes), value.name
            assert len(sizes) <= 4, value.name
        assert [o.version for o in model.opset_import] == [17]
    for network in (front, whole):
        made = {n.name for n in network.model.graph.node}
        assert set(network.outputs.values()) | set(network.sixteen_bit) <= made
        assert all(len(shape) == 4 and shape[0] == 1 for shape in network.inputs.values())
    # Residual sums: two in the encoder's layer and in the first decoder layer, whose self-attention is a constant;
    # three in the second. Beside them eight shortcuts, and positions: encoder, memory, twice in that decoder layer.
    assert len(whole.sixteen_bit) == 2 + 2 + 3
    assert len(whole.sums) == len(whole.sixteen_bit) + 8 + 4
    assert whole.operators["Softmax"] == 4 and whole.operators["Identity"] == 0


def test_kit_has_every_file_that_it_lists_and_that_the_docs_name(kit, checkpoint):
    made = {p.name for p in kit.iterdir()}
    assert made == set(files(checkpoint.config))
    assert all(name in (kit / "KIT.md").read_text() for name in made)
    patterns = re.findall(r"(?<![\w/])(?:KIT\.md|[\w<>]+\.(?:onnx|sh|npy|npz))\b", DOCS.read_text())
    assert {"KIT.md", "compile_hailo8.sh"} <= set(patterns)
    for pattern in patterns:
        form = re.escape(pattern).replace("<chip>", f"({'|'.join(CHIPS)})").replace("<network>", "(backbone|whole)")
        form = form.replace("<camera>", f"({'|'.join(checkpoint.config.cameras)})")
        assert any(re.fullmatch(form, name) for name in made), f"docs/hailo.md names {pattern}"


def test_calibration_set_is_the_recordings_and_what_the_first_part_makes_of_them(kit, checkpoint):
    policy = ACT(checkpoint.config, checkpoint.weights)
    (camera,) = checkpoint.config.cameras
    frames, states, features = (
        np.load(kit / f"calibration_{n}.npy") for n in (f"frame_{camera}", "state", f"features_{camera}")
    )
    assert frames.shape == (FRAMES, 72, 128, 3) and frames.dtype == np.uint8
    for i, sample in enumerate(memory_samples(FRAMES)):
        _, frame = inputs_of(sample, checkpoint.config)
        assert np.array_equal(frames[i], frame.numpy())
        assert np.allclose(states[i, 0, 0], sample.state * np.array([2, 3]) + np.array([0.1, -0.2]), atol=1e-6)
        with torch.inference_mode():
            wanted = policy.image_project(policy.backbone(policy.image_input[0](frame)))[0].permute(1, 2, 0)
        assert np.abs(features[i] - wanted.numpy()).max() < 1e-4 * wanted.abs().max()


def test_model_scripts_normalise_and_name_layers(kit):
    for chip in CHIPS:
        script = (kit / f"backbone_{chip}.alls").read_text()
        mean, std = (json.loads(x) for x in re.search(r"normalization\((\[.*?\]), (\[.*?\])\)", script).groups())
        norm = imagenet()  # pixel / 255 * scale + shift
        assert np.allclose([-m / s for m, s in zip(mean, std, strict=True)], norm.shift, atol=1e-4)
        assert np.allclose([255 / s for s in std], norm.scale, rtol=1e-5)
        assert f"calibset_size={FRAMES}" in script
        whole = (kit / f"whole_{chip}.alls").read_text()
        # the eight shortcuts and the first positions are ew_add1 to 9, as the first of the zoo's DETR is ew_add9
        assert "[whole/ew_add10, whole/ew_add11, whole/ew_add13" in whole
        assert ("layer_norm" in whole) == (CHIPS[chip].compiler == "3")
        assert f'compile.py" {chip} ' in (kit / f"compile_{chip}.sh").read_text()


def test_int8_stand_in_acts_and_sets_the_tolerance(kit):
    networks = json.loads((kit / "kit.json").read_text())["networks"]
    for network in networks.values():
        assert 1e-3 < network["stand_in_error"] < 0.2
        for action, error in network["stand_in_actions"].items():
            assert 1e-5 < error < 0.1
            assert network["tolerance"][action] == min(max(1e-4, 5 * error), 0.3)


def test_estimate_is_the_arithmetic_of_the_zoos_figures(checkpoint):
    _, whole, _ = networks(ACT(checkpoint.config, checkpoint.weights))
    like_detr = replace(whole, macs=int(61.87e9 / 2))
    assert estimate(like_detr, CHIPS["hailo8"]).slow_ms == pytest.approx(1000 / 30, rel=1e-3)
    like_resnet = replace(whole, macs=int(3.64e9 / 2), sixteen_bit=[])
    assert estimate(like_resnet, CHIPS["hailo8l"]).fast_ms == pytest.approx(1000 / 915, rel=1e-3)


def test_too_few_frames_or_a_folder_that_exists_are_refused_and_leave_nothing(checkpoint, tmp_path):
    with pytest.raises(QuantizeError, match="set of 1024 frames is wanted, 6 are usable"):
        write_kit(opened(checkpoint), tmp_path / "kit")
    assert not list(tmp_path.iterdir())
    (tmp_path / "kit").mkdir()
    (tmp_path / "link").symlink_to("gone")  # onto which no folder can be moved
    for name in ("kit", "link"):
        with pytest.raises(QuantizeError, match="exists already"):
            write_kit(opened(checkpoint), tmp_path / name, samples=FRAMES)


@pytest.mark.slow
def test_a_failure_on_the_way_leaves_nothing(checkpoint, tmp_path, monkeypatch):
    def fails(*_, **__):
        raise QuantizeError("no")

    monkeypatch.setattr(stand_in, "int8", fails)
    with pytest.raises(QuantizeError):
        write_kit(opened(checkpoint), tmp_path / "kit", samples=FRAMES)
    assert not list(tmp_path.iterdir())

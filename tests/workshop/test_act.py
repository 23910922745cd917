"""The inference-only ACT against LeRobot's own forward."""

import numpy as np
import pytest
import torch
from lerobot.policies.act.processor_act import make_act_pre_post_processors
from policies import TINY, lerobot_policy, smooth_frame
from torch.utils.flop_counter import FlopCounterMode

from rover_lib.onboard.preprocess import normalise
from rover_lib.workshop.act import ACT, block_of, blocks, example_inputs, multiply_accumulates
from rover_lib.workshop.checkpoint import load_checkpoint

FULL = {"n_decoder_layers": 7, "chunk_size": 32}
SHAPES = {
    "the user's": {"cameras": {"observation.images.cam_front": (360, 640)}, **FULL},
    "tiny": TINY,
    "resnet34": {**TINY, "vision_backbone": "resnet34"},
    "dim 256, 4 heads, feed-forward 777": {**TINY, "dim_model": 256, "n_heads": 4, "dim_feedforward": 777},
    "pre-norm": {**TINY, "pre_norm": True, "n_encoder_layers": 2, "n_decoder_layers": 3},
    "no VAE": {**TINY, "use_vae": False},
    "other latent": {**TINY, "latent_dim": 16},
    "two cameras of two sizes": {
        **TINY,
        "cameras": {"observation.images.left": (96, 128), "observation.images.right": (128, 96)},
    },
    "one decoder layer, chunk 100": {**TINY, "n_decoder_layers": 1, "chunk_size": 100},
    "dilation": {**TINY, "vision_backbone": "resnet50", "replace_final_stride_with_dilation": True},
    "gelu": {**TINY, "feedforward_activation": "gelu"},
    "state and action of 6": {**TINY, "states": 6, "actions": 6},
    "odd image": {**TINY, "cameras": {"observation.images.cam_front": (75, 131)}},
}


def saved(policy, folder, stats=None):
    policy.save_pretrained(folder)
    inner, outer = make_act_pre_post_processors(policy.config, stats)
    inner.save_pretrained(folder)
    outer.save_pretrained(folder)
    return inner, outer


def observation(policy, seed=0):
    rng = np.random.default_rng(seed)
    frames = {k: smooth_frame(rng, *f.shape[1:]) for k, f in policy.config.image_features.items()}
    state = rng.normal(size=policy.config.robot_state_feature.shape).astype(np.float32)
    return frames, state


def imagenet_stats(policy):
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    return {k: {"mean": mean[:, None, None], "std": std[:, None, None]} for k in policy.config.image_features}


@pytest.mark.parametrize("as_conv", [False, True], ids=["linear", "conv"])
@pytest.mark.parametrize("name", SHAPES)
def test_equals_lerobot(name, as_conv, tmp_path):
    policy = lerobot_policy(**SHAPES[name])
    saved(policy, tmp_path, imagenet_stats(policy))
    checkpoint = load_checkpoint(tmp_path)
    model = ACT(checkpoint.config, checkpoint.weights, as_conv=as_conv)
    for seed in range(2):
        frames, state = observation(policy, seed)
        batch = {k: torch.from_numpy(normalise(f))[None] for k, f in frames.items()}
        with torch.inference_mode():
            expected = policy.predict_action_chunk(batch | {"observation.state": torch.from_numpy(state)[None]})
            found = model(torch.from_numpy(state)[None], *(torch.from_numpy(f) for f in frames.values()))
        assert found.shape == expected.shape
        assert expected.std() > 1e-3  # a constant answer would prove nothing
        assert (found - expected).abs().max() < 1e-5


@pytest.mark.parametrize("mode", ["MEAN_STD", "MIN_MAX", "QUANTILES", "QUANTILE10", "IDENTITY"])
def test_lerobots_processors_end_up_inside(mode, tmp_path):
    from lerobot.configs.types import NormalizationMode

    norm = {k: NormalizationMode(mode) for k in ("STATE", "ACTION")} | {"VISUAL": NormalizationMode.MEAN_STD}
    policy = lerobot_policy(**TINY, normalization_mapping=norm)
    low, high = torch.tensor([-0.3, 0.1]), torch.tensor([0.9, 0.4])
    numbers = {"mean": (low + high) / 2, "std": high - low}
    numbers |= {"min": low, "max": high, "q01": low, "q99": high, "q10": low, "q90": high}
    stats = imagenet_stats(policy) | {"observation.state": numbers, "action": numbers}
    inner, outer = saved(policy, tmp_path, stats)
    checkpoint = load_checkpoint(tmp_path)
    frames, state = observation(policy)
    ((key, frame),) = frames.items()
    raw = {key: torch.from_numpy(frame).permute(2, 0, 1).float() / 255, "observation.state": torch.from_numpy(state)}
    with torch.inference_mode():
        expected = outer(policy.predict_action_chunk(inner(raw))[0])
        found = ACT(checkpoint.config, checkpoint.weights)(torch.from_numpy(state)[None], torch.from_numpy(frame))[0]
    assert (found - expected).abs().max() < 1e-5


def test_counts_the_full_policys_arithmetic():
    """15.02 G multiply-accumulates in LeRobot's own forward, as torch counts them; ours does less, never more."""
    policy = lerobot_policy(**SHAPES["the user's"])
    from rover_lib.workshop.checkpoint import _config_from

    weights = {k.removeprefix("model."): v for k, v in policy.state_dict().items()}
    shape = {"cameras": ("cam_front",), "image_sizes": ((360, 640),), "chunk": 32, "dim": 512, "heads": 8}
    shape |= {"feedforward": 3200, "encoder_layers": 4, "decoder_layers": 7, "backbone": "resnet18"}
    config = _config_from("x", weights, **shape)
    counts = multiply_accumulates(ACT(config, weights))
    batch = {"observation.images.cam_front": torch.zeros(1, 3, 360, 640), "observation.state": torch.zeros(1, 2)}
    with FlopCounterMode(display=False) as counter, torch.inference_mode():
        policy.predict_action_chunk(batch)
    theirs = counter.get_total_flops() / 2
    assert theirs / 1e9 == pytest.approx(15.02, abs=0.15)
    assert 0.97 * theirs < sum(counts.values()) <= theirs
    backbone = sum(n for b, n in counts.items() if b.startswith("backbone"))
    assert backbone / 1e9 == pytest.approx(8.5, abs=0.1)


def test_every_module_belongs_to_a_block(tiny):
    model = ACT(tiny.config, tiny.weights)
    counted = set(multiply_accumulates(model))
    assert counted == {*blocks(tiny.config), "head", "state_project"}
    assert block_of("decoder.1.feed_forward.up") == "decoder.1.feed_forward"
    assert [tuple(x.shape) for x in example_inputs(tiny.config)] == [(1, 2), (72, 128, 3)]

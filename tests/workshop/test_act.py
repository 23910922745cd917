"""Compare the inference-only ACT with LeRobot's own forward."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.utils.flop_counter import FlopCounterMode

from rover_lib.onboard.policy.preprocess import IMAGENET_MEAN, IMAGENET_STD
from rover_lib.workshop.act import (
    ACT,
    ActConfig,
    Affine,
    Columns,
    Pixels,
    block_of,
    blocks,
    conv,
    example_inputs,
    fits_columns,
    multiply_accumulates,
    of_columns,
)
from rover_lib.workshop.act_config import imagenet
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint
from tests.helpers.policies import FULL, TINY, lerobot_config, lerobot_policy, normalise, saved_processors, smooth_frame

SHAPES = {
    "the user's": FULL,
    "the user's widths and picture": {**FULL, "n_encoder_layers": 1, "n_decoder_layers": 2, "n_vae_encoder_layers": 1},
    "tiny": TINY,
    "resnet34": {**TINY, "vision_backbone": "resnet34"},
    "pre-norm": {**TINY, "pre_norm": True, "n_encoder_layers": 2, "n_decoder_layers": 3},
    "no VAE": {**TINY, "use_vae": False},
    "two cameras of two odd sizes": {
        **TINY,
        "cameras": {"observation.images.left": (75, 131), "observation.images.right": (128, 96)},
    },
    "one decoder layer, other latent and chunk": {**TINY, "n_decoder_layers": 1, "chunk_size": 100, "latent_dim": 16},
    "dilation": {**TINY, "vision_backbone": "resnet50", "replace_final_stride_with_dilation": True},
    "gelu, state and action of 6": {**TINY, "feedforward_activation": "gelu", "states": 6, "actions": 6},
}


def observation(policy, seed=0):
    rng = np.random.default_rng(seed)
    frames = {k: smooth_frame(rng, *f.shape[1:]) for k, f in policy.config.image_features.items()}
    state = rng.normal(size=policy.config.robot_state_feature.shape).astype(np.float32)
    return frames, state


def image_stats(policy, mean=IMAGENET_MEAN):
    stats = {"mean": torch.tensor(mean)[:, None, None], "std": torch.tensor(IMAGENET_STD)[:, None, None]}
    return {k: stats for k in policy.config.image_features}


# LeRobot pads with normalised zeros. With this mean, zero is a whole pixel, so columns can be exact at the border too.
WHOLE_MEAN = (124 / 255, 116 / 255, 104 / 255)


# All of the user's layers take 2 GB, and say no more than the other shapes' one to three do at smaller widths.
MARKS = {"the user's": pytest.mark.release, "tiny": ()}


@pytest.mark.parametrize("name", [pytest.param(n, marks=MARKS.get(n, pytest.mark.slow)) for n in SHAPES])
def test_equals_lerobot(name, tmp_path):
    policy = lerobot_policy(**SHAPES[name])
    policy.save_pretrained(tmp_path)
    for for_int8, mean in ((False, IMAGENET_MEAN), (True, WHOLE_MEAN)):
        saved_processors(policy, tmp_path, image_stats(policy, mean))
        checkpoint = load_checkpoint(tmp_path)
        model = ACT(checkpoint.config, checkpoint.weights, for_int8=for_int8)
        assert all(isinstance(m, Columns if for_int8 else Pixels) for m in model.image_input)
        frames, state = observation(policy, seed=int(for_int8))
        batch = {k: torch.from_numpy(normalise(f, mean))[None] for k, f in frames.items()}
        with torch.inference_mode():
            expected = policy.predict_action_chunk(batch | {"observation.state": torch.from_numpy(state)[None]})
            ours = model(torch.from_numpy(state)[None], *(torch.from_numpy(f) for f in frames.values()))
        assert ours.shape == expected.shape
        assert expected.std() > 1e-3  # a constant answer would prove nothing
        assert (ours - expected).abs().max() < 1e-5
        del model  # a policy of the user's size has 270 MB of it


@pytest.mark.parametrize(
    ("mean", "std", "columns"),
    [
        (IMAGENET_MEAN, IMAGENET_STD, True),
        ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), True),
        ((-0.1, 0.5, 0.5), (0.5, 0.5, 0.5), False),  # no colour normalises to zero
        ((0.5, 0.5, 1.01), (0.5, 0.5, 0.5), False),
    ],
)
def test_columns_are_the_pixels_where_the_border_can_be_a_colour(mean, std, columns):
    """Away from the border, the first convolution gives the same over columns as over normalised pixels."""
    norm = Affine(tuple(1 / s for s in std), tuple(-m / s for m, s in zip(mean, std, strict=True)))
    assert fits_columns(replace(ActConfig(), image_norm=(norm,))) == columns
    assert not fits_columns(replace(ActConfig(), image_norm=(norm, Affine((3.0,) * 3, (-1.0,) * 3))))  # two cameras'
    if not columns:
        return
    torch.manual_seed(0)
    plain = torch.nn.Conv2d(3, 8, 7, 2, 3).requires_grad_(False)
    over_columns = conv(*of_columns(plain.weight, plain.bias, norm), (2, 1), 0)
    for size in ((36, 64), (35, 61), (7, 8)):
        frame = torch.randint(0, 256, (*size, 3), dtype=torch.uint8)
        expected = plain(Pixels(norm)(frame))
        ours = over_columns(Columns(norm, *size)(frame))
        assert ours.shape == expected.shape
        gap = (ours - expected).abs()
        assert gap[..., 2:-2, 2:-2].numel() == 0 or gap[..., 2:-2, 2:-2].max() < 1e-5
        assert gap.max() < 0.5 / 255 / min(std) * plain.weight.abs().sum((1, 2, 3)).max() + 1e-5


def test_quantized_columns_are_the_float_ones_exactly():
    columns = Columns(imagenet(), 35, 61)
    frame = torch.arange(35 * 61 * 3).remainder(256).to(torch.uint8).reshape(35, 61, 3)
    expected = columns(frame)
    columns.quantized = True
    ours = columns(frame)
    assert ours.dtype == torch.qint8 and ours.is_contiguous(memory_format=torch.channels_last)
    assert (ours.dequantize() - expected).abs().max() < 1e-6


@pytest.mark.slow
def test_counts_the_full_policys_arithmetic():
    """torch counts 15.02 G multiply-accumulates in LeRobot's own forward; ours may do fewer, never more."""
    from lerobot.policies.act.modeling_act import ACTPolicy

    with torch.device("meta"):  # LeRobot's needs no numbers
        policy = ACTPolicy(lerobot_config(**FULL)).eval()
        batch = {"observation.images.cam_front": torch.zeros(1, 3, 360, 640), "observation.state": torch.zeros(1, 2)}
    with FlopCounterMode(display=False) as counter, torch.inference_mode(), torch.device("meta"):
        policy.predict_action_chunk(batch)
    weights = {k.removeprefix("model."): torch.ones(1).expand(v.shape) for k, v in policy.state_dict().items()}
    counts = multiply_accumulates(ACT(ActConfig(), weights))
    theirs = counter.get_total_flops() / 2
    assert theirs / 1e9 == pytest.approx(15.02, abs=0.15)
    assert 0.97 * theirs < sum(counts.values()) <= theirs


def test_every_module_belongs_to_a_block(tiny):
    model = ACT(tiny.config, tiny.weights)
    counts = multiply_accumulates(model)
    assert set(counts) == {*blocks(tiny.config), "head", "state_project"}
    # By hand: width 64, 128 within; 32 steps; a picture of 72x128 is 3x4 tokens, beside a latent and a state.
    assert counts["backbone.stem"] == 36 * 64 * 64 * 3 * 7 * 7
    assert counts["encoder.0.feed_forward"] == 14 * 2 * 64 * 128
    assert counts["decoder.1.feed_forward"] == 32 * 2 * 64 * 128
    projections, products = (32 + 14 + 14 + 32) * 64 * 64, 2 * 32 * 14 * 64
    assert counts["decoder.1.cross_attention"] == projections + products
    assert (counts["head"], counts["state_project"]) == (32 * 64 * 2, 2 * 64)
    assert block_of("decoder.1.feed_forward.up") == "decoder.1.feed_forward"
    assert [tuple(x.shape) for x in example_inputs(tiny.config)] == [(1, 2), (72, 128, 3)]

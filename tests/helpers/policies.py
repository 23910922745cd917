"""Policies and samples that are small enough for tests; the policies are made by the same tools as real ones."""

# LeRobot takes ten seconds to import, and every process that collects tests would pay for it: import it in functions.

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import torch

from rover_lib.onboard.policy.preprocess import IMAGENET_MEAN, IMAGENET_STD

if TYPE_CHECKING:
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy

    from rover_lib.workshop.checkpoint.checkpoint import Checkpoint

TINY = {
    "dim_model": 64, "n_heads": 4, "dim_feedforward": 128, "n_encoder_layers": 1, "n_decoder_layers": 2,
    "n_vae_encoder_layers": 1, "chunk_size": 32,
}  # fmt: skip
FULL = {"cameras": {"observation.images.cam_front": (360, 640)}, "n_decoder_layers": 7, "chunk_size": 32}


def smooth_frame(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    coarse = rng.random((5, 9, 3)).astype(np.float32)
    return (cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC).clip(0, 1) * 255).astype(np.uint8)


def lerobot_config(cameras: dict[str, tuple[int, int]], states: int = 2, actions: int = 2, **config) -> "ACTConfig":
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.act.configuration_act import ACTConfig

    config.setdefault("n_action_steps", config.get("chunk_size", 100))
    return ACTConfig(
        input_features={
            **{k: PolicyFeature(FeatureType.VISUAL, (3, *size)) for k, size in cameras.items()},
            **({"observation.state": PolicyFeature(FeatureType.STATE, (states,))} if states else {}),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (actions,))},
        pretrained_backbone_weights=None,
        device="cpu",
        **config,
    )


def lerobot_policy(
    cameras: dict[str, tuple[int, int]] | None = None, states: int = 2, actions: int = 2, seed: int = 0, **config
) -> "ACTPolicy":
    """Return LeRobot's own policy with random weights, in eval mode.

    The statistics of its frozen batch norms are set from pictures, so that its features do not vanish.
    """
    from lerobot.policies.act.modeling_act import ACTPolicy
    from torchvision.ops.misc import FrozenBatchNorm2d

    cameras = cameras or {"observation.images.cam_front": (72, 128)}
    torch.manual_seed(seed)
    policy = ACTPolicy(lerobot_config(cameras, states, actions, **config)).eval()
    rng = np.random.default_rng(seed)
    h, w = next(iter(cameras.values()))
    x = np.stack([smooth_frame(rng, h, w) for _ in range(2)]).transpose(0, 3, 1, 2).astype(np.float32) / 64 - 2

    def adopt(module: FrozenBatchNorm2d, args: tuple) -> None:
        module.running_mean.copy_(args[0].mean((0, 2, 3)))
        module.running_var.copy_(args[0].var((0, 2, 3)))
        module.weight.uniform_(0.5, 1.5)  # a scale of 1 would hide a folding error
        module.bias.normal_(0, 0.1)

    hooks = [
        m.register_forward_pre_hook(adopt) for m in policy.model.backbone.modules() if isinstance(m, FrozenBatchNorm2d)
    ]
    with torch.no_grad():
        policy.model.backbone(torch.from_numpy(x))
        for p in policy.parameters():  # biases of 0 and norms of 1 would hide errors too
            if p.dim() == 1:
                p.add_(torch.randn_like(p) * 0.05)
    for hook in hooks:
        hook.remove()
    return policy


def saved(policy: "ACTPolicy", folder: Path, stats: dict | None = None) -> tuple:
    policy.save_pretrained(folder)
    return saved_processors(policy, folder, stats)


def saved_processors(policy: "ACTPolicy", folder: Path, stats: dict | None) -> tuple:
    """Save and return LeRobot's two processors. A feature without statistics gets the mode IDENTITY: not normalised."""
    from lerobot.configs.types import NormalizationMode
    from lerobot.policies.act.processor_act import make_act_pre_post_processors

    for kind, name in (("VISUAL", "images"), ("STATE", "state"), ("ACTION", "action")):
        if not any(name in key for key in stats or ()):
            policy.config.normalization_mapping[kind] = NormalizationMode.IDENTITY
    inner, outer = make_act_pre_post_processors(policy.config, stats)
    inner.save_pretrained(folder)
    outer.save_pretrained(folder)
    return inner, outer


def saved_normalised(policy: "ACTPolicy", folder: Path) -> tuple:
    """Save a policy whose inputs and outputs are all normalised by mean and deviation, and return its processors."""
    low, high = torch.tensor([-0.3, 0.1]), torch.tensor([0.9, 0.4])
    numbers = {"mean": (low + high) / 2, "std": high - low, "min": low, "max": high}
    colours = {"mean": (0.5, 0.4, 0.3), "std": (0.2, 0.3, 0.25), "min": (0.0, 0.1, 0.05), "max": (1.0, 0.9, 0.95)}
    stats = {
        "observation.images.cam_front": {k: torch.tensor(v)[:, None, None] for k, v in colours.items()},
        "observation.state": numbers,
        "action": numbers,
    }
    return saved(policy, folder, stats)


def check_is(checkpoint, policy: "ACTPolicy", inner, outer) -> None:
    """Check that a checkpoint's actions equal LeRobot's, processors included, within 1e-5, and are not all the same."""
    from rover_lib.workshop.act import ACT

    (sample,) = memory_samples(1)
    frame, state = cv2.cvtColor(sample.picture, cv2.COLOR_BGR2RGB), torch.from_numpy(sample.state)
    (key,) = policy.config.image_features
    raw = {key: torch.from_numpy(frame).permute(2, 0, 1).float() / 255, "observation.state": state}
    with torch.inference_mode():
        expected = outer(policy.predict_action_chunk(inner(raw))[0])
        ours = ACT(checkpoint.config, checkpoint.weights)(state[None], torch.from_numpy(frame))[0]
    assert (ours - expected).abs().max() < 1e-5 * min(expected.abs().max(), 1)
    assert expected.std() > 1e-3


def trainer_config(policy: "ACTPolicy") -> dict:
    c = policy.config
    _, height, width = next(iter(c.image_features.values())).shape
    return {
        "image_width": width, "image_height": height, "n_obs_steps": 1, "chunk_size": c.chunk_size,
        "n_action_steps": c.chunk_size, "hidden_size": c.dim_model, "n_encoder_layers": c.n_encoder_layers,
        "n_decoder_layers": c.n_decoder_layers, "n_heads": c.n_heads, "feedforward_dim": c.dim_feedforward,
        "dropout": 0.1, "kl_weight": 10.0, "vision_encoder": c.vision_backbone, "pretrained_backbone": True,
        "learning_rate": 1e-4, "betas": [0.9, 0.999], "device": "cuda", "seed": 42,
    }  # fmt: skip


def trainer_content(policy: "ACTPolicy") -> dict:
    """Return what the user's trainer saves, including the optimizer's state and a numpy scalar."""
    optimizer = torch.optim.AdamW([policy.model.action_head.weight], lr=1e-4)
    policy.model.action_head.weight.grad = torch.ones_like(policy.model.action_head.weight)
    optimizer.step()
    return {
        "epoch": 7,
        "model_state_dict": policy.state_dict(),
        "optimizer_state_dict": optimizer.state_dict(),
        "scheduler_state_dict": {"last_epoch": 7},
        "best_val_loss": np.mean([0.1, 0.2]),
        "config": trainer_config(policy),
    }


def of_a_cars_size(path: Path) -> Path:
    """Write a trainer's file of a tiny policy whose actions are as large as a car's and differ from frame to frame."""
    policy = lerobot_policy(**TINY)
    with torch.no_grad():
        policy.model.action_head.weight.mul_(torch.tensor([[0.05], [0.005]]))
        policy.model.action_head.bias.copy_(torch.tensor([0.0, 0.05]))
    torch.save(trainer_content(policy), path)
    return path


INNER = re.compile(r"(backbone\.layer\d\.\d)\.(?:conv1\.weight|bn1\.weight|bn1\.bias|conv2\.weight)")


def with_few_channels(weights: dict[str, torch.Tensor], kept: int) -> dict[str, torch.Tensor]:
    """The weights with all but each kept-th channel inside the backbone's blocks zero, as --backbone-channels does."""
    thin = {name: value.clone() for name, value in weights.items()}
    for name in filter(INNER.fullmatch, thin):
        channels = thin[name].transpose(0, 1) if "conv2" in name else thin[name]  # it reads them
        channels[torch.arange(len(channels)) % kept > 0] = 0
    return thin


def dazzled_by_white(checkpoint: "Checkpoint") -> "Checkpoint":
    """The same policy, but a channel of its first layer answers only to white pictures, and far above the others."""
    weights = {k: v.clone() for k, v in checkpoint.weights.items()}
    gain, white = 1000.0, 2.2  # a normalised white pixel is 2.2 to 2.6
    weights["backbone.conv1.weight"][0] = gain / weights["backbone.conv1.weight"][0].numel()
    for name, value in (("weight", 1.0), ("bias", -white * gain), ("running_mean", 0.0), ("running_var", 1.0)):
        weights[f"backbone.bn1.{name}"][0] = value
    return replace(checkpoint, weights=weights, sha256="dazzled")


@dataclass(frozen=True, eq=False)
class MemorySample:
    """A sample like a recorded one, but without files."""

    state: np.ndarray
    picture: np.ndarray
    row: int = 0
    episode: str = "memory"
    block: str = ""

    def frame_bgr(self, least: int = 0) -> np.ndarray:
        return self.picture


def memory_samples(count: int, height: int = 72, width: int = 128, seed: int = 0) -> list[MemorySample]:
    rng = np.random.default_rng(seed)
    return [
        MemorySample(rng.uniform(-0.5, 0.5, 2).astype(np.float32), smooth_frame(rng, height, width), row)
        for row in range(count)
    ]


def normalise(frames: np.ndarray, mean: Sequence[float] = IMAGENET_MEAN) -> np.ndarray:
    """What LeRobot expects of pictures, (..., height, width, 3) uint8 RGB: (..., 3, height, width) float32."""
    x = (frames.astype(np.float32) / np.float32(255) - np.float32(mean)) / np.float32(IMAGENET_STD)
    return np.ascontiguousarray(np.moveaxis(x, -1, -3))

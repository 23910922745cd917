"""Checkpoints out: a policy's weights as the trainer's best_model.pth, and as LeRobot's pretrained_model/ folder.

`origin`, plain JSON, says where the weights come from; in LeRobot's folder also how many steps of a plan make a second.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from torch import Tensor

from rover_lib.onboard.errors import CheckpointError
from rover_lib.onboard.stage import atomic_path, sha256_of
from rover_lib.workshop.act import ActConfig, Affine
from rover_lib.workshop.act_config import imagenet, lerobot_act
from rover_lib.workshop.checkpoint.contents import RATE_HZ
from rover_lib.workshop.checkpoint.lerobot import ORIGIN

Weights = dict[str, Tensor]
DROPOUT = 0.1  # LeRobot's default, as the user's trainer has it; its checkpoints name what follows, too
KL_WEIGHT = 10.0
WEIGHT_DECAY = 1e-4
BETAS = (0.9, 0.999)
GRAD_CLIP = 1.0
EPS = 1e-8  # what LeRobot's normaliser adds to a standard deviation


def trainer_can_hold(config: ActConfig) -> bool:
    """Whether the trainer's format can hold it: 30 steps a second, ImageNet's normalisation of one camera, no other."""
    normal = config.image_norm == (imagenet(),) and config.state_norm is None and config.action_unnorm is None
    return normal and config.rate_hz == RATE_HZ


def write_trainer(
    path: Path, config: ActConfig, weights: Weights, best_val_loss: float, origin: dict[str, Any], **settings: Any
) -> None:
    """One file in the format of the user's trainer, without an optimizer's state, which was of another loss.

    config: one that `trainer_can_hold`. weights: by LeRobot's names without the leading `model.`. settings: as
    `trainer_config` wants them. Raises as `atomic_path`.
    """
    content = {
        "epoch": 0,
        "model_state_dict": {f"model.{name}": weight.cpu() for name, weight in weights.items()},
        "optimizer_state_dict": {},
        "scheduler_state_dict": {},
        "best_val_loss": np.float64(best_val_loss),
        "config": trainer_config(config, **settings) | {"use_vae": config.vae_layers > 0, "origin": origin},
    }
    save_torch(path, content)


def save_torch(path: Path, content: Any) -> None:
    """Write what torch.load reads, the same bytes for the same content: torch would name it by the file.

    Atomically; raises as `atomic_path`.
    """
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        torch.save(content, file)


def write_lerobot(folder: Path, config: ActConfig, weights: Weights, origin: dict[str, Any]) -> None:
    """A folder that LeRobot's ACTPolicy.from_pretrained and its processors load. weights: as for `write_trainer`.

    Raises CheckpointError on a full disk.
    """
    # here, because it takes ten seconds to import
    from lerobot.configs.types import NormalizationMode
    from lerobot.policies.act.processor_act import make_act_pre_post_processors

    policy = lerobot_act(config, weights)
    normed = {"VISUAL": True, "STATE": config.state_norm is not None, "ACTION": config.action_unnorm is not None}
    policy.config.normalization_mapping = {
        kind: NormalizationMode.MEAN_STD if acts else NormalizationMode.IDENTITY for kind, acts in normed.items()
    }
    stats = {
        f"observation.images.{name}": _statistics(norm, (3, 1, 1))
        for name, norm in zip(config.cameras, config.image_norm, strict=True)
    }
    if config.state_norm is not None:
        stats["observation.state"] = _statistics(config.state_norm, (-1,))
    if (scaled := config.action_unnorm) is not None:
        stats["action"] = {"mean": torch.tensor(scaled.shift), "std": torch.tensor(scaled.scale)}
    folder.mkdir(parents=True, exist_ok=True)
    try:
        policy.save_pretrained(folder)
    except SafetensorError as error:
        raise CheckpointError(f"{folder}: cannot be written whole", remedy="is the disk full?") from error
    for processor in make_act_pre_post_processors(policy.config, stats):
        processor.save_pretrained(folder)
    (folder / ORIGIN).write_text(json.dumps(origin | {"rate_hz": config.rate_hz}, indent=2) + "\n")


def write_both(
    folder: Path, config: ActConfig, weights: Weights, best_val_loss: float, origin: dict[str, Any], **settings: Any
) -> dict[str, str]:
    """pretrained_model/ in a folder, and best_model.pth where `trainer_can_hold`. Arguments as of `write_trainer`.

    Returns sha256 by name: of the weights' file of the one, and of the other.
    """
    files = {"model.safetensors": folder / "pretrained_model" / "model.safetensors"}
    write_lerobot(folder / "pretrained_model", config, weights, origin)
    if trainer_can_hold(config):
        files["best_model.pth"] = folder / "best_model.pth"
        write_trainer(files["best_model.pth"], config, weights, best_val_loss, origin, **settings)
    return {name: sha256_of(path) for name, path in files.items()}


def find_written(folder: Path) -> Path:
    """What `write_both` left there for `load_checkpoint`: the trainer's file where there is one."""
    trainers = folder / "best_model.pth"
    return trainers if trainers.is_file() else folder / "pretrained_model"


def _statistics(norm: Affine, shape: tuple[int, ...]) -> dict[str, Tensor]:
    """Mean and standard deviation whose normalisation, LeRobot's eps included, is x * scale + shift."""
    scale, shift = torch.tensor(norm.scale, dtype=torch.float64), torch.tensor(norm.shift, dtype=torch.float64)
    return {"mean": (-shift / scale).float().reshape(shape), "std": (1 / scale - EPS).float().reshape(shape)}


def trainer_config(size: ActConfig, **known: Any) -> dict[str, Any]:
    """Return the config of the user's trainer as a plain dict, key for key.

    known: learning_rate, batch_size, data_dir and output_dir (by name only: a checkpoint is shown to others), device,
    seed, and rate_hz, written if it is not the trainer's 30.
    """
    ((height, width),) = size.image_sizes
    rate_hz = known.pop("rate_hz", RATE_HZ)
    shape = {
        "image_width": width, "image_height": height, "n_obs_steps": 1, "chunk_size": size.chunk,
        "n_action_steps": size.chunk, "hidden_size": size.dim, "n_encoder_layers": size.encoder_layers,
        "n_decoder_layers": size.decoder_layers, "n_heads": size.heads, "feedforward_dim": size.feedforward,
        "dropout": DROPOUT, "kl_weight": KL_WEIGHT, "vision_encoder": size.backbone,
        "pretrained_backbone": True,  # as the trainer writes it, whatever the weights came from
    }  # fmt: skip
    training = {
        "weight_decay": WEIGHT_DECAY, "betas": BETAS, "grad_clip": GRAD_CLIP, "num_epochs": 1, "train_split": 0.75,
        "log_freq": 1, "save_freq": 1, "num_workers": 0,
    }  # fmt: skip
    return shape | training | known | ({} if rate_hz == RATE_HZ else {"rate_hz": rate_hz})

"""Read a checkpoint, the trainer's best_model.pth or what `lerobot-train` leaves, and check it before it is used.

Nothing in a file is ever executed. `trainer` and `lerobot` read the two formats.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rover_lib.onboard.car.picture import is_squeezed
from rover_lib.onboard.checked import is_whole
from rover_lib.onboard.errors import CheckpointError
from rover_lib.onboard.stage import sha256_of
from rover_lib.workshop import hub
from rover_lib.workshop.act import ActConfig, Affine
from rover_lib.workshop.checkpoint.contents import TWO_ACTIONS, Contents, check_weights, tensor_bytes
from rover_lib.workshop.checkpoint.lerobot import lerobot_folder, read_lerobot
from rover_lib.workshop.checkpoint.trainer import read_trainer
from rover_lib.workshop.recordings.samples import Layout
from rover_lib.workshop.untrusted import quote, quote_all

FEATURE_PX = 32  # a ResNet sees one feature for 32 pixels a side


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint whose config and weights agree. `weights` have LeRobot's names without the leading `model.`."""

    path: Path
    format: str  # "trainer" or "lerobot"
    config: ActConfig
    weights: dict[str, Tensor] = field(repr=False)
    sha256: str  # of the trainer's file, or of model.safetensors
    report: dict[str, Any] = field(repr=False)

    @property
    def identity(self) -> str:
        """A hash, in hex digits, of everything that decides what the policy computes.

        A trainer's file holds all of it, so its sha256 is the answer. In LeRobot's folder the config and the statistics
        are separate files beside the weights: with other statistics it is another policy, but `sha256` stays the same.
        """
        if self.format == "trainer":
            return self.sha256
        config = asdict(self.config)
        if config["sees_state"]:  # as nearly all do: their hashes are of before there were others
            del config["sees_state"]
        content = json.dumps([self.sha256, config], sort_keys=True)
        return hashlib.sha256(content.encode()).hexdigest()

    def at_size(self, height: int, width: int) -> "Checkpoint":
        """Return the same weights for images of another size, in pixels: none of ACT's weights depends on it.

        Positions are normalised to the feature map, so the policy runs at any size; how well it still drives must be
        measured. Raises CheckpointError for several cameras, for a side of less than one feature (32 pixels), and if
        the aspect ratio changes by more than 5 %, because the picture would be squeezed.
        """
        if len(self.config.cameras) != 1:
            raise CheckpointError(
                f"{self.path}: has {len(self.config.cameras)} cameras", remedy="another size is only known for one"
            )
        if not all(is_whole(side, FEATURE_PX) for side in (height, width)):
            raise CheckpointError(
                "an image size is two whole numbers of pixels, neither smaller than one feature of the backbone",
                found=f"{quote(width)}x{quote(height)}",
                remedy=f"use at least {FEATURE_PX}",
            )
        ((trained_height, trained_width),) = self.config.image_sizes
        if is_squeezed((width, height), (trained_width, trained_height)):
            raise CheckpointError(
                f"an image of {width}x{height} has another aspect ratio than {trained_width}x{trained_height}, which "
                "the policy was trained with",
                remedy="choose one that squeezes the picture by less than 5 %",
            )
        return replace(self, config=replace(self.config, image_sizes=((height, width),)))

    def recorded_as(self, layout: Layout) -> "Checkpoint":
        """Return the same policy with the recordings' names, order and rate of states and actions.

        LeRobot's checkpoints do not say what their numbers mean, in what order they come, or how many steps of a plan
        make a second; only the dataset that they were trained on does. So their weights are put into the recordings'
        order. The trainer's files, and those that we write, always have [steering, throttle] and a known rate, the
        trainer's being 30 Hz.

        Raises CheckpointError if the policy's number of cameras, states or actions is not the recordings', and, for the
        trainer's files and ours, if the recordings have another rate or other names.
        """
        c = self.config
        has = len(c.cameras), len(c.state_names) if c.sees_state else 0, len(c.action_names)
        recorded = len(layout.cameras), len(layout.state_names) if c.sees_state else 0, len(layout.action_names)
        if has != recorded:
            raise CheckpointError(
                f"{self.path}: a policy of cameras, states and actions {', '.join(map(str, has))}",
                found=f"recordings of {', '.join(map(str, recorded))}",
                remedy="give the dataset that it was trained on",
            )
        if layout.rate_hz is None:  # our own recordings
            return self
        if self.format == "lerobot" and not self.report["written_here"]:
            return self._reordered(layout, layout.rate_hz)
        if layout.rate_hz != c.rate_hz:
            raise CheckpointError(
                f"{self.path}: plans {c.rate_hz:g} steps a second",
                found=f"recordings of {layout.rate_hz:g} frames a second",
                remedy="give recordings of that rate",
            )
        numbers = (("state", c.state_names, layout.state_names), ("action", c.action_names, layout.action_names))
        for what, own, theirs in numbers[not c.sees_state :]:
            if own == TWO_ACTIONS != theirs:
                raise CheckpointError(
                    f"{self.path}: a policy whose {what} is {quote_all(own)}",
                    found=f"recordings whose {what} is {quote_all(theirs)}",
                    remedy=f"if they are the same, rename the {what} in the dataset's meta/info.json, or say so in the "
                    "order of the recordings' actions: --action-names",
                )
        return self

    def _reordered(self, layout: Layout, rate_hz: float) -> "Checkpoint":
        """Return LeRobot's policy with the order of numbers, the cameras and the rate of the dataset."""

        def reorder(norm: Affine | None, order: tuple[int, ...]) -> Affine | None:
            return norm and Affine(tuple(norm.scale[i] for i in order), tuple(norm.shift[i] for i in order))

        c, notes = self.config, list(self.report["notes"])
        cameras = c.cameras if set(c.cameras) == set(layout.cameras) else layout.cameras
        if c.cameras != cameras:
            notes.append(f"its cameras are {quote_all(c.cameras)}, and the recordings' are {quote_all(cameras)}")
        # LeRobot never resizes: a policy was trained on its dataset's pictures, whatever its config.json says, which
        # a fine-tuned one has from its base. No weight of ACT depends on their size.
        sizes = tuple(layout.image_sizes.get(name, size) for name, size in zip(cameras, c.image_sizes, strict=True))
        for name, (h, w), (height, width) in zip(cameras, c.image_sizes, sizes, strict=True):
            if (h, w) != (height, width):
                notes.append(
                    f"config.json says {w}x{h} for {name}, and the recordings are {width}x{height}: LeRobot never "
                    f"resizes, so the policy sees {width}x{height}"
                )
        weights = dict(self.weights)
        for name, order, axis in (
            ("encoder_robot_state_input_proj.weight", layout.state_order, 1),
            ("vae_encoder_robot_state_input_proj.weight", layout.state_order, 1),
            ("vae_encoder_action_input_proj.weight", layout.action_order, 1),
            ("action_head.weight", layout.action_order, 0),
            ("action_head.bias", layout.action_order, 0),
        ):
            if name in weights:
                weights[name] = weights[name].index_select(axis, torch.tensor(order))
        config = replace(
            c,
            cameras=cameras,
            image_sizes=sizes,
            # A state that is not looked at may as well be the car's.
            state_names=TWO_ACTIONS if not c.sees_state and len(layout.state_names) == 2 else layout.state_names,
            action_names=layout.action_names,
            rate_hz=rate_hz,
            state_norm=reorder(c.state_norm, layout.state_order),
            action_unnorm=reorder(c.action_unnorm, layout.action_order),
        )
        report = self.report | {"normalisation": normalisation(config), "notes": notes}
        return replace(self, config=config, weights=weights, report=report)


def load_checkpoint(path: Path | str, checked: str | None = None) -> Checkpoint:
    """Read and check a checkpoint.

    path: a trainer's .pth file; a LeRobot folder with config.json and model.safetensors; the output folder of
    `lerobot-train`, of which the last checkpoint is read, or one of its checkpoints; or the Hub's id
    user/name@revision.

    checked: the sha256 of weights that an earlier call has held against their config, which takes LeRobot seconds to be
    imported: these are not checked again.

    Raises CheckpointError, in one sentence, for a file that is missing or damaged, that would have to run code, or
    whose config and weights do not agree, and for a policy that this project cannot run.
    """
    path = hub.fetch(path, "model", CheckpointError) if hub.is_hub_id(path) else Path(path)
    if path.is_dir():
        path, notes = lerobot_folder(path) or (path, [])
        found = _checkpoint(path, "lerobot", path / "model.safetensors", checked, read_lerobot(path))
        return replace(found, report=found.report | {"notes": notes + found.report["notes"]})
    if not path.is_file():
        what = "neither a file nor a folder" if path.exists() else "not found"
        raise CheckpointError(
            f"{path}: {what}",
            remedy="give the trainer's .pth file, LeRobot's pretrained_model folder, or user/name@revision of the Hub",
        )
    return _checkpoint(path, "trainer", path, checked, read_trainer(path))


def normalisation(c: ActConfig) -> dict[str, str]:
    """Say in words what is done to each input before the policy sees it, and to its output to make it an action."""

    def numbers(values: Iterable[float]) -> str:
        return f"({', '.join(f'{v:.4g}' for v in values)})"

    def described(name: str, norm: Affine | None) -> str:
        if norm is None or (set(norm.scale), set(norm.shift)) == ({1.0}, {0.0}):
            return f"{name}, as it is"
        centre = numbers(-b / a for a, b in zip(norm.scale, norm.shift, strict=True))
        return f"({name} - {centre}) / {numbers(1 / a for a in norm.scale)}"

    words = {name: described("pixel / 255", norm) for name, norm in zip(c.cameras, c.image_norm, strict=True)}
    words["state"] = described("state", c.state_norm) if c.sees_state else "not looked at"
    out = c.action_unnorm
    words["action"] = "output, as it is" if out is None else f"output * {numbers(out.scale)} + {numbers(out.shift)}"
    return words


def _checkpoint(path: Path, kind: str, file: Path, checked: str | None, read: Contents) -> Checkpoint:
    """file: the weights'. Raises CheckpointError unless config and weights agree."""
    config, weights, extra = read
    if (sha256 := sha256_of(file)) != checked:
        check_weights(path, config, weights)
    parts: Counter[str] = Counter()
    for k, v in weights.items():
        parts["vae (training only)" if k.startswith("vae_") else k.split(".")[0].removesuffix("_embed")] += v.numel()
    total = sum(parts.values())
    acts = total - parts["vae (training only)"]
    report = {
        "format": kind,
        "file_mb": file.stat().st_size / 1e6,
        "weights_mb": tensor_bytes(weights) / 1e6,
        "parameters": total,
        "parameters_acting": acts,
        "parameters_by_part": dict(parts),
        "int8_floor_mb": acts / 1e6,
        "normalisation": normalisation(config),
        **extra,
    }
    return Checkpoint(path, kind, config, weights, sha256, report)

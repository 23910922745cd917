"""Read a checkpoint, of the trainer or of `lerobot-train`, and check it before it is used. No file's code is run."""

import hashlib
import json
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
from rover_lib.workshop.act import ActConfig, Affine
from rover_lib.workshop.checkpoint.contents import TWO_ACTIONS, Contents, check_limits, check_weights, tensor_bytes
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

        A trainer's file holds all of it. In LeRobot's folder the config and the statistics are beside the weights.
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

        How well it still drives must be measured. Raises CheckpointError for several cameras, for a side of less than
        one feature (32 pixels), and if the aspect ratio changes by more than 5 %.
        """
        trained_height, trained_width = self.config.image_sizes[0]
        sides = all(is_whole(side, FEATURE_PX) for side in (height, width))
        one = len(self.config.cameras) == 1
        if not one or not sides or is_squeezed((width, height), (trained_width, trained_height)):
            what = f"{self.path}: cannot run at {quote(width)}x{quote(height)}"
            trained = f"{len(self.config.cameras)} cameras, the first of {trained_width}x{trained_height}"
            remedy = f"one camera, whole sides of at least {FEATURE_PX}, and an aspect ratio within 5 %"
            raise CheckpointError(what, found=trained, remedy=remedy)
        return replace(self, config=replace(self.config, image_sizes=((height, width),)))

    def recorded_as(self, layout: Layout) -> "Checkpoint":
        """Return the same policy with the recordings' names, order and rate of states and actions.

        Only the dataset that LeRobot's checkpoints were trained on says what their numbers mean, in what order, and how
        many steps of a plan make a second. The trainer's files and ours have [steering, throttle] and a known rate.

        Raises CheckpointError for another number of cameras, states or actions, and, for the trainer's files and ours,
        for another rate or other names.
        """
        c = self.config
        has = len(c.cameras), len(c.state_names) if c.sees_state else 0, len(c.action_names)
        recorded = len(layout.cameras), len(layout.state_names) if c.sees_state else 0, len(layout.action_names)
        if has != recorded:
            what = f"{self.path}: a policy of cameras, states and actions {', '.join(map(str, has))}"
            found = f"recordings of {', '.join(map(str, recorded))}"
            raise CheckpointError(what, found=found, remedy="give the dataset that it was trained on")
        if layout.rate_hz is None:  # our own recordings
            return self
        if self.format == "lerobot" and not self.report["written_here"]:
            return self._reordered(layout, layout.rate_hz)
        if layout.rate_hz != c.rate_hz:
            found = f"recordings of {layout.rate_hz:g} frames a second"
            what = f"{self.path}: plans {c.rate_hz:g} steps a second"
            raise CheckpointError(what, found=found, remedy="give recordings of that rate")
        numbers = (("state", c.state_names, layout.state_names), ("action", c.action_names, layout.action_names))
        for what, own, theirs in numbers[not c.sees_state :]:
            if own == TWO_ACTIONS != theirs:
                remedy = "if they are the same, rename them in the dataset's meta/info.json, or by --action-names"
                found = f"recordings whose {what} is {quote_all(theirs)}"
                raise CheckpointError(f"{self.path}: the {what} is {quote_all(own)}", found=found, remedy=remedy)
        return self

    def _reordered(self, layout: Layout, rate_hz: float) -> "Checkpoint":
        """Return LeRobot's policy with the order of numbers, the cameras and the rate of the dataset."""

        def reorder(norm: Affine | None, order: tuple[int, ...]) -> Affine | None:
            return norm and Affine(tuple(norm.scale[i] for i in order), tuple(norm.shift[i] for i in order))

        c, notes = self.config, list(self.report["notes"])
        cameras = c.cameras if set(c.cameras) == set(layout.cameras) else layout.cameras
        if c.cameras != cameras:
            notes.append(f"its cameras are {quote_all(c.cameras)}, and the recordings' are {quote_all(cameras)}")
        # LeRobot never resizes, and a fine-tuned policy has its base's config.json. No weight depends on the size.
        sizes = tuple(layout.image_sizes.get(name, size) for name, size in zip(cameras, c.image_sizes, strict=True))
        for name, (h, w), (height, width) in zip(cameras, c.image_sizes, sizes, strict=True):
            if (h, w) != (height, width):
                note = f"config.json says {w}x{h} for {name}, and the recordings are {width}x{height}"
                notes.append(f"{note}: LeRobot never resizes, so the policy sees {width}x{height}")
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
    `lerobot-train`, of which the last checkpoint is read, or one of its checkpoints.

    checked: the sha256 of weights that an earlier call has held against their config, for which LeRobot takes seconds.

    Raises CheckpointError, in one sentence, for a file that is missing or damaged, that would have to run code, or
    whose config and weights do not agree, and for a policy that this project cannot run.
    """
    path = Path(path)
    if path.is_dir():
        path = lerobot_folder(path)
        return _checkpoint(path, "lerobot", path / "model.safetensors", checked, read_lerobot(path))
    if not path.is_file():
        remedy = "give the trainer's .pth file, or LeRobot's pretrained_model folder"
        raise CheckpointError(f"{path}: not found, or neither a file nor a folder", remedy=remedy)
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
    check_limits(path, config)
    if (sha256 := sha256_of(file)) != checked:
        check_weights(path, config, weights)
    acts = sum(weight.numel() for name, weight in weights.items() if not name.startswith("vae_"))
    report = {
        "format": kind,
        "file_mb": file.stat().st_size / 1e6,
        "weights_mb": tensor_bytes(weights) / 1e6,
        "parameters": sum(weight.numel() for weight in weights.values()),
        "parameters_acting": acts,
        "int8_floor_mb": acts / 1e6,
        "normalisation": normalisation(config),
        **extra,
    }
    return Checkpoint(path, kind, config, weights, sha256, report)

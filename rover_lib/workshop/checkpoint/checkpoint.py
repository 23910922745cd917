"""Read a checkpoint, of the trainer or of `lerobot-train`, and check it before it is used. No file's code is run."""

import hashlib
import json
import re
from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from rover_lib.onboard.artifact.manifest import RULES
from rover_lib.onboard.car.picture import is_squeezed
from rover_lib.onboard.checked import broken_rule, is_whole
from rover_lib.onboard.errors import CheckpointError
from rover_lib.onboard.stage import sha256_of
from rover_lib.workshop.act import ACT, inputs_of, predictions
from rover_lib.workshop.act_config import ACTIVATIONS, BACKBONES, ActConfig, Affine, check_shapes, imagenet
from rover_lib.workshop.checkpoint.facts import GUESS, USER, Facts
from rover_lib.workshop.checkpoint.files import COPY_AGAIN, CORRECT_IT, RATE_HZ, as_checkpoint_error, save_torch
from rover_lib.workshop.checkpoint.lerobot import SIZE_OF_BASE, lerobot_folder, read_lerobot, write_lerobot
from rover_lib.workshop.checkpoint.trainer import read_trainer, trainer_config
from rover_lib.workshop.checkpoint.weights import Weights, tensor_bytes
from rover_lib.workshop.recordings.samples import ACTION_NAMES, Layout, Sample, pick_evenly, stack_chunks
from rover_lib.workshop.untrusted import quote, quote_all

FEATURE_PX = 32  # a ResNet sees one feature for 32 pixels a side
FRAMES = 8  # on which two sizes of pictures are tried, in FP32
BETTER = 0.5  # the share of the error that the less likely size must leave at most
SAME, CLEARLY = 0.05, 1.0  # apart: statistics of the same actions; how much nearer those of another order are
FAR = 2.0  # no mean, deviation or half range of actions from -1 to 1 is as large
INFO, TRAINED_ON = "the recordings' meta/info.json", "give the dataset that it was trained on"


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint whose config and weights agree. `weights` have LeRobot's names without the leading `model.`."""

    path: Path
    format: str  # "trainer" or "lerobot"
    config: ActConfig
    weights: dict[str, Tensor] = field(repr=False)
    sha256: str  # of the trainer's file, or of model.safetensors
    report: dict[str, Any] = field(repr=False)
    facts: Facts = field(repr=False)

    @property
    def identity(self) -> str:
        """A hash, in hex digits, of everything that decides what the policy computes.

        A trainer's file holds all of it, but what files beside it or the user say. In LeRobot's folder the config and
        the statistics are beside the weights.
        """
        elsewhere = any(by == USER or re.search(r"\.(json|ya?ml):", by) for _, by in self.facts.known.values())
        if self.format == "trainer" and not elsewhere:
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
        (trained_height, trained_width), *other_sizes = self.config.image_sizes
        sides = all(is_whole(side, FEATURE_PX) for side in (height, width))
        if other_sizes or not sides or is_squeezed((width, height), (trained_width, trained_height)):
            problem = f"{self.path}: cannot run at {quote(width)}x{quote(height)}"
            trained = f"{len(self.config.cameras)} cameras, the first of {trained_width}x{trained_height}"
            remedy = f"one camera, whole sides of at least {FEATURE_PX}, and an aspect ratio within 5 %"
            raise CheckpointError(problem, found=trained, remedy=remedy)
        return replace(self, config=replace(self.config, image_sizes=((height, width),)))

    def recorded_as(self, layout: Layout, samples: Sequence[Sample] = ()) -> "Checkpoint":
        """Return the same policy with the recordings' names, order and rate of states and actions.

        The trainer's files and ours say them. LeRobot's say nothing: then the dataset that they were trained on does,
        if the statistics of the recorded samples do not deny it, or the user. samples: also to try sizes on.

        Raises CheckpointError for another number of cameras, states or actions, for another rate or names than the
        policy's own, where nothing says the order or the rate, and for keys of LeRobot's config that may matter.
        """
        c = self.config
        facts = self.facts
        has_rate = layout.rate_hz is not None
        has = len(c.cameras), len(c.state_names) if c.sees_state else 0, len(c.action_names)
        recorded = len(layout.cameras), len(layout.state_names) if c.sees_state else 0, len(layout.action_names)
        if has != recorded:
            problem = f"{self.path}: a policy of cameras, states and actions {', '.join(map(str, has))}"
            raise CheckpointError(problem, found=f"recordings of {', '.join(map(str, recorded))}", remedy=TRAINED_ON)
        guessed = [fact for fact in ("actions", "rate") if facts.source(fact) == GUESS]
        if guessed and not has_rate:  # our own recordings, which it was not trained on
            examples = {"actions": "actions=steering,throttle", "rate": "rate=30"}
            example = " ".join(examples[fact] for fact in guessed)
            # Both orders: the user must not just copy one.
            other = example.replace("steering,throttle", "throttle,steering")
            options = " or ".join(f'{USER} "{option}"' for option in dict.fromkeys((example, other)))
            problem = f"{self.path}: nothing says its {' and '.join(guessed)}"
            raise CheckpointError(problem, remedy=f"{TRAINED_ON}, or say them in its numbers' order: {options}")
        if has_rate and "rate" not in guessed and layout.rate_hz != c.rate_hz:
            actual = f"recordings of {layout.rate_hz:g} frames a second"
            problem = f"{self.path}: plans {c.rate_hz:g} steps a second"
            raise CheckpointError(problem, found=actual, remedy="give recordings of that rate")
        numbers = {"state": (c.state_names, layout.state_names), "action": (c.action_names, layout.action_names)}
        for problem, (own, theirs) in numbers.items():
            settled = "actions" not in guessed and (c.sees_state or problem == "action")
            if settled and set(own) != set(theirs) and set(ACTION_NAMES) in (set(own), set(theirs)):
                remedy = "if they are the same, rename them in the dataset's meta/info.json, or by --action-names"
                actual = f"recordings whose {problem} is {quote_all(theirs)}"
                raise CheckpointError(f"{self.path}: the {problem} is {quote_all(own)}", found=actual, remedy=remedy)
        ordered = self._reordered(layout, samples, guessed)
        of_car = set(ordered.config.action_names) == set(ACTION_NAMES)
        if of_car and (units := other_units(ordered.config)):
            remedy = "train on such actions; a throttle forward is from 0 to 1"
            raise CheckpointError(
                f"{self.path}: {units}", found=ordered.report["normalisation"]["action"], remedy=remedy
            )
        return ordered._at_trained_size(layout, samples)

    def _reordered(self, layout: Layout, samples: Sequence[Sample], guessed: Sequence[str]) -> "Checkpoint":
        """Return the policy with the order of numbers, and LeRobot's with the cameras and the rate of the dataset."""
        c = self.config
        notes = list[str]()
        states = layout.state_order
        actions = layout.action_order
        if "actions" not in guessed:
            if set(c.action_names) != set(layout.action_names):
                return self
            actions = tuple(c.action_names.index(name) for name in layout.action_names)
            states = actions if len(c.state_names) == len(actions) else tuple(range(len(c.state_names)))
        if not guessed and actions == tuple(range(len(actions))):
            return self
        ordered = self._in_order(states, actions)
        # A state that is not looked at may as well be the car's.
        state_names = ACTION_NAMES if not c.sees_state and len(layout.state_names) == 2 else layout.state_names
        config = replace(ordered.config, state_names=state_names, action_names=layout.action_names)
        facts: dict[str, tuple[Any, str]] = {"actions": (layout.action_names, self.facts.source("actions"))}
        if guessed:
            same = self._varies_as(samples, actions, "actions" in guessed)
            cameras = c.cameras
            if set(cameras) != set(layout.cameras):
                cameras = layout.cameras
                notes.append(f"its cameras are {quote_all(c.cameras)}, and the recordings' are {quote_all(cameras)}")
            if len(actions) == 2 and set(layout.action_names) != set(ACTION_NAMES):
                option = "if they are steering and throttle, name them so in their order: --action-names"
                notes.append(f"its actions are {quote_all(layout.action_names)}, which no rover has; {option}")
            rate_hz = (layout.rate_hz if "rate" in guessed else None) or c.rate_hz
            config = replace(config, cameras=cameras, rate_hz=rate_hz)
            recorded: dict[str, Any] = {"actions": config.action_names, "rate": config.rate_hz}
            facts |= {fact: (recorded[fact], INFO if same else f"{GUESS}, {INFO}") for fact in guessed}
        return ordered._told(config, facts, notes)

    def _in_order(self, states: tuple[int, ...], actions: tuple[int, ...]) -> "Checkpoint":
        """Return the policy with its numbers in another order. states, actions: for each number, where it is now."""

        def reorder(norm: Affine | None, order: tuple[int, ...]) -> Affine | None:
            return norm and Affine(tuple(norm.scale[i] for i in order), tuple(norm.shift[i] for i in order))

        c = self.config
        weights = dict(self.weights)
        for name, order, axis in (
            ("encoder_robot_state_input_proj.weight", states, 1),
            ("vae_encoder_robot_state_input_proj.weight", states, 1),
            ("vae_encoder_action_input_proj.weight", actions, 1),
            ("action_head.weight", actions, 0),
            ("action_head.bias", actions, 0),
        ):
            if name in weights:
                weights[name] = weights[name].index_select(axis, torch.tensor(order))
        c = replace(c, state_norm=reorder(c.state_norm, states), action_unnorm=reorder(c.action_unnorm, actions))
        return replace(self, config=c, weights=weights)

    def _varies_as(self, samples: Sequence[Sample], order: tuple[int, ...], guessed: bool) -> bool:
        """Whether its actions vary as the samples', whose places in the policy are `order`: then it learned from them.

        Raises CheckpointError if that clearly contradicts the order of two actions that was guessed.
        """
        theirs = self.facts.value("action std")
        if not samples or theirs is None:
            return False
        recorded = np.std([s.chunk[0].astype(np.float64) for s in samples], 0) + 1e-3
        own = np.array(theirs)[list(order)] + 1e-3
        apart = np.abs(np.log(own / recorded))
        swapped = np.abs(np.log(own[::-1] / recorded))
        if guessed and len(order) == 2 and swapped.sum() + CLEARLY < apart.sum():
            other = ",".join(ACTION_NAMES[i] for i in order[::-1])
            problem = f"{self.path}: the statistics of its actions contradict the order in {INFO}"
            raise CheckpointError(problem, remedy=f"{TRAINED_ON}, or pass the policy's: {USER} actions={other}")
        return bool(apart.max() < SAME)

    def _at_trained_size(self, layout: Layout, samples: Sequence[Sample]) -> "Checkpoint":
        """Return the policy at the size of pictures that it was trained at, where only config.json says one.

        LeRobot never resizes, and a fine-tuned policy has its base's config.json, so the recordings' size may be right;
        but one that was trained on a smaller copy needs that. No weight depends on it: both are tried on samples.
        """
        c = self.config
        tried = pick_evenly(samples, FRAMES)
        recorded = dict(layout.image_sizes)
        if tried and not recorded and len(c.cameras) == 1:
            recorded = {c.cameras[0]: tried[0].frame_bgr().shape[:2]}
        sizes = tuple(recorded.get(name, size) for name, size in zip(c.cameras, c.image_sizes, strict=True))
        pairs = list(zip(c.image_sizes, sizes, strict=True))
        squeezed = any(is_squeezed(there[::-1], own[::-1]) for own, there in pairs)
        sizes_told = ", ".join(f"{w}x{h} for pictures of {width}x{height}" for (h, w), (height, width) in pairs)
        if self.facts.source("size") != SIZE_OF_BASE or self.report["written_here"] or not layout.image_sizes:
            note = f"{GUESS}, that pictures were squeezed in training too: {sizes_told}"
            guessed = squeezed and not self.report["written_here"]  # our trainings squeeze theirs to this size
            return self._told(c, {"size": (c.image_sizes[0], note)}, [note]) if guessed else self
        if sizes == c.image_sizes:
            return self
        config = replace(c, image_sizes=sizes)
        own = other = 1.0
        if tried:
            own = planned_error(self, tried)
            other = planned_error(replace(self, config=config), tried)
        # Nobody squeezes a copy, so then the recordings' size is likelier.
        best = config if other <= BETTER * own or (squeezed and BETTER * other < own) else c
        errors = f"they are {own:.3g} and {other:.3g} off"
        note = f"{GUESS}: config.json says {sizes_told}; tried on {len(tried)} frames, {errors}"
        return self._told(best, {"size": (best.image_sizes[0], note)}, [note])

    def _told(self, config: ActConfig, known: dict[str, tuple[Any, str]], notes: Sequence[str]) -> "Checkpoint":
        """Return the same weights with another config, of which other facts are known."""
        facts = copy(self.facts)
        facts.known = facts.known | known
        facts.notes = [*facts.notes, *notes]
        return replace(self, config=config, facts=facts, report=self.report | _words(config, facts))


def planned_error(policy: Checkpoint, samples: Sequence[Sample], action: int | None = None) -> float:
    """The mean error of one action, or of all, against the recorded ones."""
    plans = predictions(ACT(policy.config, policy.weights), [inputs_of(s, policy.config) for s in samples]).numpy()
    chunks, is_pad = stack_chunks(samples)
    errors = np.abs(plans - chunks)[~is_pad]
    return float((errors if action is None else errors[:, action]).mean())


def load_checkpoint(path: Path | str, said: str = "") -> Checkpoint:
    """Read and check a checkpoint.

    path: a trainer's .pth file; a LeRobot folder with config.json and model.safetensors; the output folder of
    `lerobot-train`, of which the last checkpoint is read, or one of its checkpoints.
    said: what the user says of it by --facts.

    Raises CheckpointError, in one sentence, for a file that is missing or damaged, that would have to run code, or
    whose config and weights do not agree, and for a policy that this project cannot run.
    """
    path = Path(path)
    if path.is_dir():
        path = lerobot_folder(path)
        kind = "lerobot"
        file = path / "model.safetensors"
    elif path.is_file():
        kind = "trainer"
        file = path
    else:
        remedy = "give the trainer's .pth file, or LeRobot's pretrained_model folder"
        raise CheckpointError(f"{path}: not found, or neither a file nor a folder", remedy=remedy)
    facts = Facts(path, said)
    config, weights, extra = read_lerobot(path, facts) if kind == "lerobot" else read_trainer(path, facts)
    check_limits(path, config)
    check_weights(path, config, weights, facts.unknown)
    for key, value in facts.unknown.items():
        if kind == "lerobot" and value is not None:
            raise facts.refusal(key, value, "and nobody here knows what that does")
    if units := other_units(config):
        facts.notes.append(f"{units}: if it is a car's, rover run refuses it")
    if facts.unknown:
        facts.notes.append(f"nobody here knows what these keys mean, not used: {quote_all(facts.unknown)}")
    acts = sum(weight.numel() for name, weight in weights.items() if not name.startswith("vae_"))
    report = {
        "format": kind,
        "file_mb": file.stat().st_size / 1e6,
        "weights_mb": tensor_bytes(weights) / 1e6,
        "parameters": sum(weight.numel() for weight in weights.values()),
        "parameters_acting": acts,
        "int8_floor_mb": acts / 1e6,
        **_words(config, facts),
        **extra,
    }
    return Checkpoint(path, kind, config, weights, sha256_of(file), report, facts)


def other_units(c: ActConfig) -> str:
    """Say that two actions' statistics are of other units than a car's, or ""."""
    norm = c.action_unnorm
    if len(c.action_names) != len(ACTION_NAMES) or norm is None or max(map(abs, norm.scale + norm.shift)) <= FAR:
        return ""
    return "the statistics of its actions are of other units than a rover's, from -1 to 1"


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


def _words(c: ActConfig, facts: Facts) -> dict[str, Any]:
    """What reports say of a policy beyond its weights, and who says it."""
    sizes = ", ".join(f"{name} {w}x{h}" for name, (h, w) in zip(c.cameras, c.image_sizes, strict=True))
    words = {"size": sizes, "actions": ", ".join(c.action_names), "rate": f"{c.rate_hz:g} steps a second"}
    facts_in_words = {fact: f"{words.get(fact, value)} ({by})" for fact, (value, by) in facts.known.items()}
    guesses = [f"its {fact}: {by}" for fact, (_, by) in facts.known.items() if by.startswith(GUESS)]
    return {"known": facts_in_words, "guesses": guesses, "normalisation": normalisation(c), "notes": facts.notes}


def check_limits(path: Path, c: ActConfig) -> None:
    """Raise CheckpointError for sizes, names or a rate that no artifact's manifest may hold.

    Plans of a million steps, from a file of a few megabytes, would fill the memory with the samples of a drive.
    """
    cameras = [{"name": n, "height": h, "width": w} for n, (h, w) in zip(c.cameras, c.image_sizes, strict=True)]
    names = {"state_names": list(c.state_names), "action_names": list(c.action_names)}
    values = {"cameras": cameras, **names, "chunk": c.chunk, "rate_hz": c.rate_hz}
    if broken := broken_rule(values, {name: RULES[name] for name in values}):
        name, must, actual = broken
        raise CheckpointError(f"{path}: {name} must be {must}", found=actual, remedy=CORRECT_IT)


def check_weights(path: Path, c: ActConfig, weights: dict[str, Tensor], unknown: Iterable[str] = ()) -> None:
    """Raise CheckpointError unless LeRobot's ACT of this config has exactly these weights, and all are finite.

    What is checked first either cannot run here, or would let LeRobot build something without end. unknown: keys that
    nobody here knows, and that may be why.
    """
    for key, value, choices in (("backbone", c.backbone, BACKBONES), ("activation", c.activation, ACTIVATIONS)):
        if not isinstance(value, str) or value not in choices:
            problem = f"{path}: {key} {quote(value)} is not known here"
            raise CheckpointError(problem, remedy=f"known are {', '.join(sorted(choices))}")
    sizes = (c.chunk, c.dim, c.heads, c.feedforward, c.encoder_layers, c.decoder_layers)
    positions = tuple(weights["decoder_pos_embed.weight"].shape) if "decoder_pos_embed.weight" in weights else None
    whole = all(is_whole(size, 1) for size in sizes)  # LeRobot 0.6 lets None pass
    deep = not whole or c.encoder_layers + c.decoder_layers > len(weights)
    if deep or positions != (c.chunk, c.dim) or c.dim % 4:  # a quarter of the width for each sine and cosine
        problem = f"{path}: config and weights do not agree (decoder_pos_embed is {positions}, {len(weights)} weights)"
        actual = f"chunk, width, heads, feed-forward, encoder and decoder layers of {quote_all(sizes)}"
        raise CheckpointError(problem, found=actual, remedy=CORRECT_IT)
    keys = quote_all(unknown)
    forked = f"; nobody here knows {keys}: train with LeRobot's own ACT if that asks for other weights" if keys else ""
    with as_checkpoint_error(path, CORRECT_IT + forked):
        check_shapes(c, weights)
    if bad := [k for k, v in weights.items() if not torch.isfinite(v.float()).all()]:
        problem = f"{path}: NaN or Inf in {len(bad)} of {len(weights)} weights: {quote_all(bad)}"
        remedy = "training diverged, take an earlier checkpoint"
        if 2 * len(bad) < len(weights):  # a step with a loss of NaN makes all of them NaN
            remedy = f"is the file damaged? {COPY_AGAIN}; or {remedy}"
        raise CheckpointError(problem, remedy=remedy)


def write_both(
    folder: Path, config: ActConfig, weights: Weights, loss: float, origin: dict[str, Any], **settings: Any
) -> dict[str, str]:
    """Write pretrained_model/ into a folder, and best_model.pth where the trainer's format can hold the policy.

    That has 30 steps a second, ImageNet's normalisation of one camera, and no other. weights: by LeRobot's names
    without the leading `model.`. loss: on held-out frames. settings: as `trainer_config` wants them.

    Returns sha256 by name: of the weights' file of the one, and of the other. Raises as `atomic_path`.
    """
    paths = [folder / "pretrained_model" / "model.safetensors"]
    write_lerobot(folder / "pretrained_model", config, weights, origin)
    norms = config.image_norm, config.state_norm, config.action_unnorm
    if (*norms, config.rate_hz) == ((imagenet(),), None, None, RATE_HZ):
        content = {
            "epoch": 0,
            "model_state_dict": {f"model.{name}": weight.cpu() for name, weight in weights.items()},
            "optimizer_state_dict": {},  # the training's was of another loss
            "scheduler_state_dict": {},
            "best_val_loss": np.float64(loss),
            "config": trainer_config(config, **settings) | {"use_vae": config.vae_layers > 0, "origin": origin},
        }
        paths.append(folder / "best_model.pth")
        save_torch(paths[-1], content)
    return {path.name: sha256_of(path) for path in paths}

"""Read the folder that `lerobot-train` leaves: config.json, model.safetensors, and how each feature is normalised.

The config and the processors are read as LeRobot's classes do. What those accept without a word, such as a feature that
has no statistics and so is left as it is, is checked here.
"""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file
from torch import Tensor

from rover_lib.onboard.checked import is_whole
from rover_lib.onboard.errors import CheckpointError, printable
from rover_lib.workshop.act_config import LEROBOTS, ActConfig, Affine, lerobot_act
from rover_lib.workshop.checkpoint import files
from rover_lib.workshop.checkpoint.facts import GUESS, USER, WORDS, Facts
from rover_lib.workshop.checkpoint.weights import Weights, check_weights_are_whole, name_weights
from rover_lib.workshop.recordings.names import ACTION, CAMERA, STATE, camera_names
from rover_lib.workshop.recordings.samples import ACTION_NAMES
from rover_lib.workshop.untrusted import quote, quote_all, read_json

PRETRAINED = "pretrained_model"
CONFIG = "config.json"
ADAPTER = "adapter_config.json"
WEIGHTS, TRAINED = "model.safetensors", "train_config.json"
SIZE_OF_BASE = f"{CONFIG}:input_features"  # if it was fine-tuned
IN_WEIGHTS = r"^(un)?normalize_(inputs|outputs|targets)\.buffer_{key}\.\w+$"
Sizes = tuple[tuple[int, int], ...]
VARIES = 1e-5  # standard deviation, or half of a range; less is rounding
APART = 2.0  # deviations, or as many times as large: statistics of other numbers than the actions
KINDS = ("STATE", "VISUAL", "ENV", "ACTION", "REWARD", "LANGUAGE")  # of features
MODES = {  # of normalisation, and the statistics that each uses
    "MEAN_STD": ("mean", "std"),
    "MIN_MAX": ("min", "max"),
    "QUANTILES": ("q01", "q99"),
    "QUANTILE10": ("q10", "q90"),
    "IDENTITY": (),
}
EPS = 1e-8  # what LeRobot's normaliser adds to a standard deviation
SAME = {"type", "chunk_size", "input_features", "output_features", "normalization_mapping", "vision_backbone"}
NOT_OF_POLICY = {"policy", "optimizer", "scheduler", "eval", "wandb", "env"}  # sections of train_config.json
ORIGIN = "origin.json"  # our own notes in such a folder, because LeRobot refuses a config.json with unknown keys
# Each processor's file, and its step that normalises.
INNER = "policy_preprocessor.json", "normalizer_processor"
OUTER = "policy_postprocessor.json", "unnormalizer_processor"
HARMLESS = ("rename_observations_processor", "to_batch_processor", "device_processor")  # they change no number


def lerobot_folder(path: Path) -> Path:
    """Return the folder with a policy's config: `path` itself, or one inside, as `lerobot-train` arranges them.

    Raises CheckpointError if there is none, or no link to the last of several.
    """
    for inner in ("", PRETRAINED, f"last/{PRETRAINED}", f"checkpoints/last/{PRETRAINED}"):
        if (path / inner / "config.json").exists():
            return path / inner
    places = (f"*/{PRETRAINED}", f"checkpoints/*/{PRETRAINED}", "snapshots/*", "*.pth")
    actual = sorted(p.relative_to(path).as_posix() for p in chain.from_iterable(map(path.glob, places)))
    problem = f"{path}: no config.json, nor a link to the last checkpoint"
    remedy = "give best_model.pth, or one pretrained_model folder with config.json; merge an adapter before"
    raise CheckpointError(problem, found=quote_all(actual) or "none", remedy=remedy)


def read_lerobot(folder: Path, facts: Facts) -> files.Contents:
    """facts: what its files say is added. Raises CheckpointError for missing, damaged or other policies' files."""
    if (folder / ADAPTER).exists():
        problem = f"{folder}: {ADAPTER} is beside the weights, so that an adapter changes what they compute"
        raise CheckpointError(problem, remedy="merge it (merge_and_unload), save_pretrained, and remove its files")
    raw = _of_today(folder, _read_json(folder / CONFIG))
    settings = _act_config(folder, raw, facts)
    tensors = name_weights(folder, _read_safetensors(folder / WEIGHTS), facts.ignored)
    inside: dict[str, Tensor] = {}
    if not (folder / OUTER[0]).exists():  # of before LeRobot had processors
        for key in settings.features:
            for name in [n for n in tensors if re.search(IN_WEIGHTS.format(key=key.replace(".", "_")), n)]:
                inside[f"{key}.{name.rpartition('.')[2]}"] = tensors.pop(name)
    weights = check_weights_are_whole(facts, tensors)
    inner = Normaliser(folder, *INNER, settings, inside)
    outer = Normaliser(folder, *OUTER, settings, inside)
    origin = _read_json(folder / ORIGIN) if (folder / ORIGIN).exists() else {}  # what we noted in one that we wrote
    images = settings.images
    numbers = settings.state
    actions = settings.action
    with files.as_checkpoint_error(folder):
        sizes = _trained_sizes(folder, raw, tuple((f.shape[1], f.shape[2]) for f in images.values()), facts)
        by = ORIGIN if origin else GUESS
        if origin:
            facts.say("rate", float(origin.get("rate_hz", files.RATE_HZ)), ORIGIN)
        steps = [step for step in (inner, outer) if step.tensors]
        facts.compare("normalisation of actions", {step.where.name: step.modes.get("ACTION") for step in steps})
        for name in sorted(inner.tensors.keys() & outer.tensors.keys()):  # a training writes all into both
            facts.compare(f"'{name}'", {step.where.name: step.tensors[name].tolist() for step in (inner, outer)})
        if (spread := outer.tensors.get("action.std")) is not None:
            facts.say("action std", spread.flatten().tolist(), OUTER[0])
        pictures = tuple(inner.affine(k, "VISUAL", (3, 1, 1)) or Affine((1.0,) * 3, (0.0,) * 3) for k in images)
        config = ActConfig(
            cameras=tuple(camera_names(images)),
            image_sizes=sizes,
            state_names=files.name_numbers(numbers.shape[0] if numbers else 2, "state"),
            action_names=facts.default("actions", files.name_numbers(actions.shape[0], "action"), by),
            chunk=facts.default("chunk", settings.chunk_size, CONFIG),
            vae_layers=settings.n_vae_encoder_layers if settings.use_vae else 0,
            backbone=facts.default("backbone", settings.vision_backbone, CONFIG),
            dilation=bool(settings.replace_final_stride_with_dilation),
            rate_hz=facts.default("rate", files.RATE_HZ, by),
            image_norm=pictures,
            state_norm=inner.affine("observation.state", "STATE", numbers.shape) if numbers else None,
            sees_state=numbers is not None,
            action_unnorm=outer.affine("action", "ACTION", actions.shape, inverse=True),
            **{ours: getattr(settings, theirs) for ours, theirs in LEROBOTS.items()},
        )
        config, weights = _without_constants(config, weights, inner, facts)
        _compare_statistics(config, inner, outer, facts)
    files.check_beside(folder, facts)
    report = {"optimizer_mb": 0.0, "written_here": bool(origin)}
    return config, weights, report | {"license": settings.license, "base_model": settings.repo_id}  # on the Hub


def _without_constants(
    config: ActConfig, weights: Weights, inner: "Normaliser", facts: Facts
) -> tuple[ActConfig, Weights]:
    """Return a policy to which numbers of the state that never varied in its training are what they were then.

    Its network learned nothing from them, and their scale of 1e8 would make anything of a car's last action.
    """
    norm = config.state_norm
    if norm is None or not (constants := inner.constants("observation.state", norm)):
        return config, weights
    weights = dict(weights)
    dropped = list(constants)
    for stem in ("encoder_robot_state_input_proj", "vae_encoder_robot_state_input_proj"):
        if f"{stem}.weight" in weights:
            columns = weights[f"{stem}.weight"].clone()
            weights[f"{stem}.bias"] = weights[f"{stem}.bias"] + columns[:, dropped].sum(1) * constants[dropped[0]]
            columns[:, dropped] = 0
            weights[f"{stem}.weight"] = columns
    scale = tuple(1.0 if i in constants else factor for i, factor in enumerate(norm.scale))
    shift = tuple(0.0 if i in constants else factor for i, factor in enumerate(norm.shift))
    names = quote_all(config.state_names[i] for i in dropped)
    facts.notes.append(
        f"its state ({names}) never varied in its training, so that it learned nothing from it: whatever a car gives, "
        "the network is given what it was then; to use it, train on a state that is the last action"
    )
    return replace(config, state_norm=Affine(scale, shift)), weights


def _compare_statistics(config: ActConfig, inner: "Normaliser", outer: "Normaliser", facts: Facts) -> None:
    """Note a state of two numbers whose statistics are not those of the actions: a car's state is its last action."""
    state = inner.statistics("observation.state")
    action = outer.statistics("action")
    if config.action_names != ACTION_NAMES or not (len(state) == len(action) == 2):
        return
    for name, (mean, std), (own_mean, own_std) in zip(config.state_names, state, action, strict=True):
        alike = abs(mean - own_mean) <= APART * own_std and own_std <= APART * std and std <= APART * own_std
        if min(std, own_std) > VARIES and not alike:
            problem = "the state that it learned from was not its last action, which a car gives"
            state_words = f"{name} mean {mean:.3g}, deviation {std:.3g}"
            facts.notes.append(f"{problem}: {state_words}, and its action's {own_mean:.3g}, {own_std:.3g}")
            return


def _of_today(folder: Path, raw: dict[str, Any]) -> dict[str, Any]:
    """Return a config.json of 2024, which had shapes and modes by feature and no type, as LeRobot writes it now."""
    if "type" in raw or not {"input_shapes", "output_shapes"} <= raw.keys():
        return raw
    raw = raw | {"type": "act"}
    mapping = dict[str, str]()
    with files.as_checkpoint_error(folder / CONFIG, "train with one way of normalisation for each kind of feature"):
        for part in ("input", "output"):
            shapes = raw.pop(f"{part}_shapes")
            modes = raw.pop(f"{part}_normalization_modes", {})
            kinds = {k: "VISUAL" if "image" in k else "STATE" for k in shapes}
            if "action" in shapes:
                kinds["action"] = "ACTION"
            raw[f"{part}_features"] = {k: {"type": kinds[k], "shape": shape} for k, shape in shapes.items()}
            for key, kind in kinds.items():
                mode = modes.get(key, "identity").upper()
                if mapping.setdefault(kind, mode) != mode:
                    raise ValueError(f"{mapping[kind]} and {mode} of {kind}")
    return raw | {"normalization_mapping": mapping}


def _trained_sizes(folder: Path, raw: Mapping[str, Any], sizes: Sizes, facts: Facts) -> Sizes:
    """Return (height, width) of each camera's pictures in training: config.json's, or as train_config.json resizes.

    Raises CheckpointError where the two deny each other, and for what was done to pictures and is not done here.
    """
    path = folder / TRAINED
    content = _read_json(path) if path.exists() else {}
    policy = content.get("policy") or {}
    dataset = dict(content.get("dataset") or {})
    for key in SAME & raw.keys() & policy.keys():
        facts.compare(key, {f"{CONFIG}:{key}": raw[key], f"{TRAINED}:policy.{key}": policy[key]})
    transforms = dataset.pop("image_transforms", None) or {}
    rest = {k: v for k, v in content.items() if k not in NOT_OF_POLICY} | {"dataset": dataset}
    facts.read(rest | {"policy": {k: v for k, v in policy.items() if k not in raw}}, f"{TRAINED}:", noted=False)
    steps = [t for t in (transforms.get("tfs") or {}).values() if t.get("weight", 1) > 0]
    for step in (t for t in steps if t["type"] not in WORDS["random"] and transforms.get("enable")):
        to = step["kwargs"].get("size")
        whole = all(is_whole(n, 1, files.MOST) for n in (to if isinstance(to, list) else [to]))
        if step["type"] != "Resize" or not whole or len(steps) > transforms.get("max_num_transforms", 3):
            problem = f"{path}: some or all of its pictures were changed by {quote(step['type'])}"
            raise CheckpointError(problem, remedy=f"train without it, or if it is another training's, remove {TRAINED}")
        from torchvision.transforms.v2 import Resize  # here, because it takes a second

        sizes = tuple((h, w) for _, h, w in (Resize(to)(torch.empty(1, *size)).shape for size in sizes))
        facts.known["size"] = sizes[0], f"{TRAINED}:dataset.image_transforms"
    return (facts.value("size"),) if len(sizes) == 1 and facts.source("size") == USER else sizes


class _Feature(NamedTuple):
    kind: str  # one of KINDS
    shape: tuple[int, ...]


def _features(content: Mapping[str, Any]) -> dict[str, _Feature]:
    """Read features by their names. Raises errors of many kinds."""
    features = {name: _Feature(str(each["type"]), tuple(each["shape"])) for name, each in content.items()}
    if unknown := {feature.kind for feature in features.values()} - {*KINDS}:
        raise ValueError(f"{quote_all(unknown)} is no type of a feature")
    return features


def _act_config(folder: Path, raw: dict[str, Any], facts: Facts) -> SimpleNamespace:
    """Return the config as LeRobot reads it, and its features by their kinds; its own reader takes seconds to import.

    A note says what it asks for beyond the network.
    """
    path = folder / CONFIG
    if raw.get("type") != "act":
        problem = f"{path}: policy type is {quote(raw.get('type'))}"
        raise CheckpointError(problem, remedy='only \'act\' is known: if it is one, write "type": "act" into it')
    with files.as_checkpoint_error(path, files.CORRECT_IT):
        settings = SimpleNamespace(**WORDS["act"] | {key: raw[key] for key in WORDS["act"] if key in raw})
        settings.features = _features(settings.input_features) | _features(settings.output_features)
        inputs = {name: settings.features[name] for name in settings.input_features}
        settings.images = {name: feature for name, feature in inputs.items() if feature.kind == "VISUAL"}
        settings.state = next((f for name, f in inputs.items() if (name, f.kind) == (STATE, "STATE")), None)
        action = settings.features.get(ACTION) if ACTION in settings.output_features else None
        settings.action = action if action and action.kind == "ACTION" else None
        most = settings.chunk_size if settings.temporal_ensemble_coeff is None else 1
        if settings.n_obs_steps != 1 or settings.n_action_steps > most:
            raise ValueError(f"n_obs_steps {settings.n_obs_steps}, n_action_steps {settings.n_action_steps} of {most}")
        cameras = [camera.shape for camera in settings.images.values()]
        rows = [row.shape for row in (settings.state, settings.action) if row]
        whole = all(is_whole(n, 1, files.MOST) for n in chain(*cameras, *rows))
        right = all(len(s) == 3 and s[0] == 3 for s in cameras) and all(len(s) == 1 for s in rows)
    if not (cameras and settings.action and whole and right) or "ENV" in {f.kind for f in inputs.values()}:
        actual = quote_all(f"{name} {feature.kind} {feature.shape}" for name, feature in settings.features.items())
        remedy = "train with cameras (3, height, width), numbers in 'action', and in 'observation.state' or none"
        raise CheckpointError(f"{folder}: its features are not a car's", found=actual, remedy=remedy)
    if settings.temporal_ensemble_coeff is not None:
        coefficient = f"temporal_ensemble_coeff is {settings.temporal_ensemble_coeff}"
        facts.notes.append(f"{coefficient}: LeRobot would average plans; here the car drives by the newest alone")
    facts.default("size", cameras[0][1:], SIZE_OF_BASE)
    with files.as_checkpoint_error(path):
        facts.read({k: v for k, v in raw.items() if k not in {*WORDS["act"], *WORDS["of_lerobot"]}}, "")
    return settings


class Normaliser:
    """Says how LeRobot normalises each input, or each output, as an Affine.

    LeRobot silently leaves a feature without statistics as it is, and an output in standard deviations would become a
    servo's pulse. file, normalises: INNER or OUTER. said: the policy's config, whose modes hold where there is no file.
    inside: statistics that lie among the weights, as LeRobot's step names them.
    """

    def __init__(self, folder: Path, file: str, normalises: str, said: SimpleNamespace, inside: dict[str, Tensor]):
        """Raises CheckpointError for a step that is unknown."""
        self.where = folder / file
        own = {"features": said.input_features | said.output_features, "norm_map": said.normalization_mapping}
        content: dict[str, Any] = {"steps": [{"registry_name": normalises, "config": own}]}
        tensors = inside
        if self.where.exists():
            content = _read_json(self.where)
            tensors = {}
        steps = list[dict[str, Any]]()
        with files.as_checkpoint_error(self.where):
            for step in content["steps"]:
                name = step.get("registry_name") or step["class"]
                config = step.get("config") or {}
                if config.get("enabled") is False:
                    continue  # as LeRobot writes steps that others of its policies use
                if name == normalises:
                    steps.append(config)
                    if state_file := step.get("state_file"):
                        tensors = _read_safetensors(folder / Path(state_file).name)
                elif name not in HARMLESS or config.get("rename_map"):
                    problem = f"{self.where}: has a processor step that is not known here: {quote(name)}"
                    raise CheckpointError(problem, remedy="train without it, or do in the recordings what it does")
        if len(steps) != 1 or steps[0].get("normalize_observation_keys") is not None:
            problem = f"{self.where}: normalises {len(steps)} times, or some of the observations only"
            raise CheckpointError(problem, remedy="copy the folder again, or train with LeRobot's own single step")
        with files.as_checkpoint_error(self.where):
            if unknown := steps[0].keys() - {"features", "norm_map", "eps", "normalize_observation_keys"}:
                raise ValueError(f"{quote_all(unknown)} is not known here")
            self.features = _features(steps[0]["features"])
            self.modes = dict(steps[0]["norm_map"])
            if unknown := {*self.modes.values()} - MODES.keys():
                raise ValueError(f"{quote_all(unknown)} is no way to normalise")
            self.eps = float(steps[0].get("eps", EPS))
            self.tensors = {name: tensor.float() for name, tensor in tensors.items()}

    def statistics(self, key: str) -> list[tuple[float, float]]:
        """Return the mean and the deviation of each number of a feature; [] if they are not there."""
        stats = self.tensors
        parts = [stats[name].flatten().tolist() for part in ("mean", "std") if (name := f"{key}.{part}") in stats]
        return list(zip(*parts, strict=True)) if len(parts) == 2 else []

    def constants(self, key: str, norm: Affine) -> dict[int, float]:
        """Return the numbers of an input that never varied in training, by their place, as the network saw them.

        Raises CheckpointError for those that varied, and whose quantiles were equal.
        """
        fixed = [i for i, (a, b) in enumerate(zip(norm.scale, norm.shift, strict=True)) if VARIES * max(a, abs(b)) >= 1]
        mode = self.modes[self.features[key].kind]
        varied = [i for i in fixed if (pairs := self.statistics(key)) and pairs[i][1] > VARIES]
        if varied and mode.startswith("QUANTILE"):
            problem = f"{self.where}: most values of '{key}' were equal: {mode} gives no range for the others"
            raise CheckpointError(problem, found=f"scale {norm.scale[varied[0]]:.3g}", remedy="train with MEAN_STD")
        return dict.fromkeys(fixed, 0.0 if mode == "MEAN_STD" else -1.0)

    def affine(self, key: str, kind: str, shape: tuple[int, ...], inverse: bool = False) -> Affine | None:
        """Return what LeRobot's step computes as scale and shift; None if it leaves the feature as it is.

        key, kind, shape: the feature's. inverse: undo the normalisation, as for an output. Raises CheckpointError for
        missing or wrong statistics.
        """
        own = self.features.get(key)
        if own and not inverse:
            kind = own.kind  # by which LeRobot chooses the mode, whatever the config says
        mode = self.modes.get(kind)
        if mode == "IDENTITY":
            return None
        stats = [name for name in self.tensors if name.startswith(f"{key}.")]
        if mode is None or not stats or not (inverse or (own and kind != "ACTION")):
            actual = f"mode {quote(mode)}, statistics {quote_all(stats) or 'none'}"
            remedy = "copy all policy_preprocessor* and policy_postprocessor* files, or say IDENTITY for raw values"
            raise CheckpointError(f"{self.where}: '{key}' would not be normalised", found=actual, remedy=remedy)
        x = torch.stack([torch.zeros(shape), torch.ones(shape)]).double()
        y = self._normalised(x, mode, [self.tensors[f"{key}.{part}"].double() for part in MODES[mode]], inverse)
        shift = y[0].flatten()
        scale = (y[1] - y[0]).flatten()
        finite = torch.isfinite(scale.float()).all() and torch.isfinite(shift.float()).all()  # used as float32
        if y.shape != x.shape or not finite or (scale < 0).any() or not (inverse or scale.all()):
            problem = f"{self.where}: statistics of '{key}' have another shape, are not finite, or would turn it around"
            raise CheckpointError(problem, found=f"scales {scale.tolist()[:3]}", remedy="compute them again")
        if not inverse:
            # LeRobot subtracts first, so a feature that never changes becomes -1, or 0. With scale and shift that is
            # only so while the last digit of x * scale in float32 is far below 1; a larger scale was off by up to 16.
            end = 0.0 if mode == "MEAN_STD" else -1.0
            usual = (end - shift) / scale
            largest = torch.exp2((21 - usual.abs().log2()).floor())
            scale, shift = scale.minimum(largest), torch.where(scale > largest, end - usual * largest, shift)
        return Affine(tuple(scale.tolist()), tuple(shift.tolist()))

    def _normalised(self, x: Tensor, mode: str, ends: Sequence[Tensor], inverse: bool) -> Tensor:
        """Return what LeRobot's step makes of x, in the same order of operations."""
        if mode == "MEAN_STD":
            mean, std = ends
            return x * std + mean if inverse else (x - mean) / (std + self.eps)
        low, high = ends
        width = torch.where(high == low, self.eps, high - low)
        return (x + 1) / 2 * width + low if inverse else 2 * (x - low) / width - 1


def _read_json(path: Path) -> dict[str, Any]:
    with files.as_checkpoint_error(path):
        return dict(read_json(path, files.JSON_BYTES))


def _read_safetensors(path: Path) -> dict[str, Tensor]:
    if not path.is_file():
        parts = quote_all(sorted(part.name for part in path.parent.glob(f"{path.stem}*"))) or "none"
        problem = f"{printable(str(path))}: not found, or not a file, found {parts}"
        raise CheckpointError(problem, remedy="merge an adapter or pieces where it was trained, and save_pretrained")
    with files.as_checkpoint_error(path):
        return load_file(path)


def write_lerobot(folder: Path, config: ActConfig, weights: dict[str, Tensor], origin: dict[str, Any]) -> None:
    """A folder that LeRobot's ACTPolicy.from_pretrained and its processors load. weights: as for `write_both`.

    Raises CheckpointError on a full disk.
    """
    # here, because it takes ten seconds to import
    from lerobot.configs.types import NormalizationMode
    from lerobot.policies.act.processor_act import make_act_pre_post_processors

    policy = lerobot_act(config, weights)
    raw = NormalizationMode.IDENTITY
    normed = NormalizationMode.MEAN_STD
    modes = {"STATE": normed if config.state_norm else raw, "ACTION": normed if config.action_unnorm else raw}
    policy.config.normalization_mapping = {"VISUAL": normed, **modes}
    pictures = zip(config.cameras, config.image_norm, strict=True)
    stats = {f"{CAMERA}{name}": _statistics(norm, (3, 1, 1)) for name, norm in pictures}
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


def _statistics(norm: Affine, shape: tuple[int, ...]) -> dict[str, Tensor]:
    """Mean and standard deviation whose normalisation, LeRobot's eps included, is x * scale + shift."""
    scale = torch.tensor(norm.scale, dtype=torch.float64)
    shift = torch.tensor(norm.shift, dtype=torch.float64)
    return {"mean": (-shift / scale).float().reshape(shape), "std": (1 / scale - EPS).float().reshape(shape)}

"""Read the folder that `lerobot-train` leaves: config.json, model.safetensors, and how each feature is normalised."""

import json
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor

from rover_lib.onboard.checked import is_number
from rover_lib.onboard.errors import CheckpointError
from rover_lib.onboard.kinds import refuse_pointer
from rover_lib.onboard.stage import sha256_of
from rover_lib.workshop.act import Affine
from rover_lib.workshop.checkpoint.contents import (
    COPY_AGAIN,
    FLOATS,
    LARGEST_SIDE_PX,
    Contents,
    config_from,
    flag,
    is_size,
    named_weights,
    one_observation,
    positive,
)
from rover_lib.workshop.recordings.samples import camera_names
from rover_lib.workshop.untrusted import quote, quote_all

RATE_HZ = 30.0  # steps of a plan in a second if nothing says it: the rate of the trainer's recordings

# Bounds, each far above what a policy of full size has, and low enough to be read in a second.
JSON_BYTES = 1_000_000  # LeRobot's config.json: 3 kB
HEADER_BYTES = 1_000_000  # the header of model.safetensors needs 100 bytes for each of some 300 tensors
STATISTICS_BYTES = 16_000_000  # LeRobot's: a few kB

# What LeRobot calls its files. STEPS: for each processor's file, how the names of its statistics began among the
# weights before LeRobot 0.4, and the name of the step that normalises.
PRETRAINED = "pretrained_model"
ORIGIN = "origin.json"  # our own notes in such a folder, because LeRobot refuses a config.json with unknown keys
ADAPTER = "adapter_config.json"
PREPROCESSOR, POSTPROCESSOR = "policy_preprocessor.json", "policy_postprocessor.json"
STEPS = {
    PREPROCESSOR: ("normalize_inputs.buffer_", "normalizer_processor"),
    POSTPROCESSOR: ("unnormalize_outputs.buffer_", "unnormalizer_processor"),
}
BUFFERS = ("normalize_inputs.", "normalize_targets.", "unnormalize_outputs.")
# What a config.json of LeRobot 0.4 or 0.6 has, all else than the network's shape without an effect on a trained one.
KNOWN = {
    "type", "input_features", "output_features", "n_obs_steps", "chunk_size", "dim_model", "n_heads", "dim_feedforward",
    "n_encoder_layers", "n_decoder_layers", "normalization_mapping", "vision_backbone", "pre_norm", "license", "tags",
    "replace_final_stride_with_dilation", "feedforward_activation", "n_action_steps", "temporal_ensemble_coeff",
    "use_vae", "latent_dim", "n_vae_encoder_layers", "dropout", "kl_weight", "device", "use_amp", "use_peft", "repo_id",
    "push_to_hub", "private", "pretrained_path", "pretrained_revision", "pretrained_backbone_weights", "optimizer_lr",
    "optimizer_lr_backbone", "optimizer_weight_decay",
}  # fmt: skip


def _broken(what: str, found: object = None) -> CheckpointError:
    """The error of a folder that no LeRobot wrote so, for the caller to raise."""
    return CheckpointError(what, found=found, remedy=COPY_AGAIN)


def lerobot_folder(path: Path) -> tuple[Path, list[str]] | None:
    """Find the folder with a policy's config: `path` itself, or one inside, as `lerobot-train` arranges them.

    Return it with a note if it is another than the last. None if there is none. Raises CheckpointError for an output
    folder that has several checkpoints, but no link to the last.
    """
    for inner in ("", PRETRAINED, f"last/{PRETRAINED}", f"checkpoints/last/{PRETRAINED}"):
        if any((path / inner / name).exists() for name in ("config.json", ADAPTER)):
            return path / inner, []
    for last in (path, path / "last", path / "checkpoints" / "last"):
        if last.name == "last" and last.is_file():  # Git writes a link as its text where it makes no links
            named = last.parent / last.read_bytes()[:64].decode("utf-8", "replace").strip() / PRETRAINED
            if (named / "config.json").is_file():
                return named, []
    for steps in (path / "checkpoints", path):
        if found := sorted(p.parent.name for p in steps.glob(f"*/{PRETRAINED}")):
            if len(found) == 1:
                return steps / found[0] / PRETRAINED, [f"'last' leads nowhere: taken is {found[0]}, the only one there"]
            raise CheckpointError(
                f"{steps}: it does not say which of its checkpoints is the last",
                found=quote_all(found),
                remedy=f"give one of them, as in {steps / found[-1]}",
            )
    return None


def _act_config(folder: Path) -> dict[str, Any]:
    """Read the config.json of a whole ACT policy. Raises CheckpointError for an adapter and for other policies."""
    raw = {} if (folder / ADAPTER).exists() else _read_json(folder / "config.json")
    if not raw or raw.get("use_peft"):
        raise CheckpointError(
            f"{folder}: a PEFT adapter, which holds changes to another policy's weights and no policy",
            remedy="merge it into its policy (PEFT's merge_and_unload) and save that",
        )
    if raw.get("type") != "act":
        raise CheckpointError(
            f"{folder}/config.json: policy type is {quote(raw.get('type'))}",
            remedy="only 'act' is known here"
            if raw.get("type")
            else "only 'act' is known here; if it is one from before 2025, convert it by LeRobot's "
            "lerobot.processor.migrate_policy_normalization",
        )
    return raw


def _picture_sizes(folder: Path, inputs: Mapping[str, tuple[str, list[int]]]) -> dict[str, tuple[int, int]]:
    """Return (height, width) by camera. Raises CheckpointError for inputs that a car with cameras does not have."""
    sizes: dict[str, tuple[int, int]] = {}
    for name, (kind, shape) in inputs.items():
        if kind == "VISUAL":
            if len(shape) != 3 or shape[0] != 3 or max(shape) > LARGEST_SIDE_PX:
                raise CheckpointError(
                    f"{folder}: camera {quote(name)} has shape {shape[:4]}",
                    remedy=f"only (3, height, width) works here, up to {LARGEST_SIDE_PX} pixels a side",
                )
            sizes[name] = (shape[1], shape[2])
        elif kind == "ENV":
            raise CheckpointError(
                f"{folder}: input {quote(name)} is an environment state, which no camera car has",
                remedy="train a policy without it",
            )
    if not sizes:
        raise CheckpointError(
            f"{folder}: the policy has no camera input (it has {quote_all(inputs) or 'none'})",
            remedy="nothing to drive by",
        )
    return sizes


def read_lerobot(folder: Path) -> Contents:
    """Read a LeRobot folder.

    Raises CheckpointError for missing or damaged files, and for policies that this project cannot run.
    """
    file = folder / "model.safetensors"
    if not any((folder / name).exists() for name in ("config.json", ADAPTER)):
        _refuse_shards(folder, file)
    raw = _act_config(folder)
    _refuse_shards(folder, file)
    state = _read_safetensors(file)
    buffers = {}
    for name in list(state):  # also inside of what torch.compile puts around a policy, see named_weights
        if begin := next((b for b in BUFFERS if name.startswith(b) or f".{b}" in name), None):
            buffers[name[name.index(begin) :]] = state.pop(name)
    weights, notes = named_weights(file, state, file.stat().st_size)
    inputs, outputs = (_features(folder, raw, key) for key in ("input_features", "output_features"))
    sizes = _picture_sizes(folder, inputs)
    if outputs.get("action", ("",))[0] != "ACTION":
        raise CheckpointError(
            f"{folder}: the policy has no 'action' output of type ACTION",
            found=quote_all(outputs) or "none",
            remedy="train one that acts",
        )
    one_observation(folder, raw)
    notes += _unheard(raw)
    keys = ("chunk_size", "dim_model", "n_heads", "dim_feedforward", "n_encoder_layers", "n_decoder_layers")
    chunk, dim, heads, feedforward, n_encoder, n_decoder = (positive(folder, raw, k) for k in keys)
    asked = raw.get("normalization_mapping", dict.fromkeys(("VISUAL", "STATE", "ACTION"), "MEAN_STD"))
    inner = Normaliser(folder, PREPROCESSOR, asked, buffers)
    outer = Normaliser(folder, POSTPROCESSOR, asked, buffers)
    sees_state = inputs.get("observation.state", ("",))[0] == "STATE"
    states, actions = inputs["observation.state"][1] if sees_state else [], outputs["action"][1]
    seen = _recorded_cameras(inner, sizes)
    config = config_from(
        folder,
        weights,
        sees_state=sees_state,
        cameras=tuple(camera_names(seen)),
        image_sizes=tuple(sizes.values()),
        chunk=chunk,
        dim=dim,
        heads=heads,
        feedforward=feedforward,
        encoder_layers=n_encoder,
        decoder_layers=n_decoder,
        backbone=raw.get("vision_backbone"),
        dilation=flag(folder, raw, "replace_final_stride_with_dilation"),
        pre_norm=flag(folder, raw, "pre_norm"),
        activation=raw.get("feedforward_activation", "relu"),
        image_norm=tuple(inner.affine(c, "VISUAL", 3) or Affine((1.0,) * 3, (0.0,) * 3) for c in sizes),
        state_norm=inner.affine("observation.state", "STATE", states[0]) if sees_state else None,
        action_unnorm=outer.affine("action", "ACTION", actions[0], inverse=True),
        rate_hz=_own_rate_hz(folder),
    )
    for name, shape, size in (
        ("observation.state", states, len(config.state_names) if sees_state else 0),
        ("action", actions, len(config.action_names)),
    ):
        if shape != ([size] if size else []):
            raise _broken(
                f"{folder}: config and weights do not agree ('{name}' has shape {shape}, the weights are for {size})"
            )
    extra = {
        "optimizer_mb": 0.0,
        "normalisation_from": {"in": inner.source, "out": outer.source},
        "written_here": (folder / ORIGIN).exists(),
        "notes": notes,
    }
    return Contents("lerobot", config, weights, sha256_of(file), file.stat().st_size, extra)


def _unheard(raw: Mapping[str, Any]) -> list[str]:
    """Return a note for what the config asks for beyond the network, which is all that is read."""
    notes = []
    if raw.get("temporal_ensemble_coeff") is not None:
        notes.append(
            f"temporal_ensemble_coeff is {quote(raw['temporal_ensemble_coeff'])}: LeRobot would drive by averages of "
            "plans; here the car drives by the newest plan alone"
        )
    if unknown := sorted(set(raw) - KNOWN):
        notes.append(f"config.json has what no ACT of LeRobot 0.4 or 0.6 has, not used: {quote_all(unknown)}")
    return notes


def _recorded_cameras(inner: "Normaliser", sizes: Mapping[str, Any]) -> list[str]:
    """Return for each of the policy's cameras the key under which its recordings have it (LeRobot's --rename_map)."""
    sources = {new: old for old, new in inner.renames.items()}
    others = [new for new in sources if new not in sizes]
    if others or len(sources) < len(inner.renames):
        pairs = ", ".join(f"{quote(old)} to {quote(new)}" for old, new in inner.renames.items())
        raise CheckpointError(
            f"{inner.where}: renames {pairs}; only one camera to another of the policy's is known here",
            found=f"a policy of the cameras {quote_all(sizes)}",
            remedy="rename them in the dataset, in meta/info.json and the tables, and train without --rename_map",
        )
    return [sources.get(key, key) for key in sizes]


def read_origin(folder: Path) -> dict[str, Any]:
    """Return what we noted in a folder of LeRobot's format that we wrote; {} for any other. Raises CheckpointError."""
    return _read_json(folder / ORIGIN) if (folder / ORIGIN).exists() else {}


def _own_rate_hz(folder: Path) -> float:
    """Return the steps of a plan in a second: what we noted in a folder that we wrote, else RATE_HZ."""
    rate_hz = read_origin(folder).get("rate_hz", RATE_HZ)
    if not is_number(rate_hz, 0, 1000) or not rate_hz:
        raise _broken(f"{folder / ORIGIN}: 'rate_hz' must be above 0 and at most 1000", quote(rate_hz))
    return float(rate_hz)


def _features(folder: Path, raw: Mapping[str, Any], key: str) -> dict[str, tuple[str, list[int]]]:
    """Return the type and shape of each of the config's features, by name."""
    features = raw.get(key) or {}
    if not isinstance(features, dict):
        raise _broken(f"{folder}/config.json: '{key}' is not an object", quote(features))
    checked = {}
    for name, feature in features.items():
        kind, shape = (feature.get("type"), feature.get("shape")) if isinstance(feature, dict) else (None, None)
        if not isinstance(kind, str) or not isinstance(shape, list) or not shape or not all(map(is_size, shape)):
            raise _broken(
                f"{folder}/config.json: feature {quote(name)} has no type and shape",
                f"{quote(kind)} and {quote(shape)}",
            )
        checked[name] = kind, shape
    return checked


def _refuse_shards(folder: Path, file: Path) -> None:
    """Raise CheckpointError for weights in pieces: torch's distributed format (DCP), or an index of safetensors."""
    if file.exists():
        return
    checkpoint = folder.parent if folder.name == PRETRAINED else folder
    pieces = [
        p for place in (folder, checkpoint) for pattern in ("*.distcp", "*/*.distcp") for p in place.glob(pattern)
    ]
    if pieces or file.with_suffix(".safetensors.index.json").exists():
        what = "a sharded checkpoint (DCP)" if pieces else "weights in several files"
        raise CheckpointError(
            f"{folder}: {what}, and no model.safetensors",
            remedy="merge them where it was trained, and save the policy by its save_pretrained",
        )


def _bare(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Return a shape without the ones that it begins with, which change nothing."""
    while len(shape) > 1 and shape[0] == 1:
        shape = shape[1:]
    return tuple(shape)


class Normaliser:
    """Says how LeRobot normalises each input, or each output, as an Affine.

    A processor file has it; before LeRobot 0.4 the config and buffers beside the weights had it. A feature that has no
    statistics and whose mode is not IDENTITY is refused: LeRobot 0.4 silently leaves it as it is, and an output in
    standard deviations would become a servo's pulse.

    asked: the config's normalization_mapping. buffers: the tensors of the weights' file whose names begin with BUFFERS.
    """

    def __init__(self, folder: Path, file: str, asked: Any, buffers: Mapping[str, Tensor]):
        self.where = folder / file
        self.modes, self.eps = asked, 1e-8
        self.stats: dict[str, Tensor] = {}
        self.features: dict[str, Any] | None = None  # which the processor's step names; it leaves all others alone
        self.renames: dict[str, str] = {}  # what the recordings call an observation: what the policy calls it
        prefix, step_name = STEPS[file]
        self.old = not self.where.exists()
        if self.old:
            self.stats = {k.removeprefix(prefix): v for k, v in buffers.items() if k.startswith(prefix)}
            self.where = folder / "config.json"
        else:
            self._read_steps(folder, step_name)
        self.source = f"{file}, LeRobot's processor"
        if self.old:
            self.source = "the weights' file, as LeRobot did before 0.4" if self.stats else "config.json: IDENTITY"
        texts = isinstance(self.modes, dict) and all(isinstance(v, str) for v in self.modes.values())
        if not texts or not isinstance(self.eps, (int, float)) or not 0 <= self.eps <= 1:
            raise _broken(
                f"{self.where}: norm_map must map names to texts, and eps must be from 0 to 1",
                f"{quote(self.modes)} and {quote(self.eps)}",
            )

    def _read_steps(self, folder: Path, step_name: str) -> None:
        known = {"rename_observations_processor", "to_batch_processor", "device_processor", step_name}
        count = 0
        for step in self._steps():
            config = step["config"]
            if renames := config.get("rename_map"):
                texts = isinstance(renames, dict) and all(isinstance(v, str) for v in renames.values())
                if not texts or self.renames or count:
                    raise _broken(
                        f"{self.where}: its rename_map is no map of names, or not the first that it does",
                        quote(renames),
                    )
                self.renames = renames
            if step["registry_name"] not in known:
                raise CheckpointError(
                    f"{self.where}: has a processor step that is not known here: {quote(step['registry_name'])}",
                    remedy="train without it, or do in the recordings what it does",
                )
            if step["registry_name"] == step_name:
                count += 1
                self.modes, self.eps = config.get("norm_map", {}), config.get("eps", 1e-8)
                features = config.get("features")
                self.features = features if isinstance(features, dict) else {}
                if config.get("normalize_observation_keys") is not None:
                    raise CheckpointError(
                        f"{self.where}: normalises some of the observations only (normalize_observation_keys)",
                        remedy="give the others IDENTITY, or train without it",
                    )
                if state := step.get("state_file"):
                    self.stats = self._read_statistics(folder, state)
        if count > 1:
            raise CheckpointError(f"{self.where}: normalises {count} times", remedy="train with one such step")

    def _steps(self) -> list[dict[str, Any]]:
        """Return the processor's steps, each with a name and a config."""
        steps = _read_json(self.where).get("steps", [])
        named = isinstance(steps, list) and all(
            isinstance(s, dict) and isinstance(s.get("registry_name"), str) and isinstance(s.get("config") or {}, dict)
            for s in steps
        )
        if not named:
            raise _broken(f"{self.where}: its steps are not a list of objects with a registry_name and a config")
        return [{**s, "config": s.get("config") or {}} for s in steps]

    def _read_statistics(self, folder: Path, name: Any) -> dict[str, Tensor]:
        if not isinstance(name, str) or Path(name).name != name or not name.isprintable():
            raise _broken(f"{self.where}: its state file {quote(name)} is not a file in the folder")
        return _read_safetensors(folder / name, STATISTICS_BYTES)

    def affine(self, key: str, kind: str, size: int, inverse: bool = False) -> Affine | None:
        """Return LeRobot's _apply_transform as scale and shift; None if it leaves the feature as it is.

        key: the feature's name. kind: its type, for which the config has a mode. size: how many numbers it has.
        inverse: undo the normalisation, as for an output. Raises CheckpointError for missing or wrong statistics.
        """
        if not inverse and self.features and isinstance(own := self.features.get(key), dict):
            kind = own.get("type", kind)  # by which LeRobot chooses the mode, whatever the config says
        mode = self.modes.get(kind) if isinstance(kind, str) else None
        if mode == "IDENTITY":
            return None
        name = key.replace(".", "_") if self.old else key
        stats = {k.removeprefix(f"{name}."): v for k, v in self.stats.items() if k.startswith(f"{name}.")}
        left_out = not inverse and self.features is not None and (key not in self.features or kind == "ACTION")
        if mode is None or not stats or left_out:
            raise self._would_be_raw(key, kind, mode, stats)
        pairs = {
            "MEAN_STD": ("mean", "std"),
            "MIN_MAX": ("min", "max"),
            "QUANTILES": ("q01", "q99"),
            "QUANTILE10": ("q10", "q90"),
        }
        if mode not in pairs:
            raise CheckpointError(
                f"{self.where}: normalisation mode {quote(mode)} of '{key}' is not known here",
                remedy=f"known are IDENTITY, {', '.join(pairs)}",
            )
        if missing := [p for p in pairs[mode] if p not in stats]:
            raise CheckpointError(
                f"{self.where}: mode '{mode}' of '{key}' needs {missing}",
                found=quote_all(sorted(stats)),
                remedy="copy the whole folder again, or compute the statistics again",
            )
        if odd := [p for p in pairs[mode] if stats[p].dtype not in FLOATS]:
            raise CheckpointError(
                f"{self.where}: statistics of '{key}' are not floats ({odd})", remedy="compute them again"
            )
        each = (size, 1, 1) if kind == "VISUAL" else (size,)  # LeRobot would spread another shape over steps or pixels
        if odd := [f"{p} {list(stats[p].shape)}" for p in pairs[mode] if _bare(stats[p].shape) != _bare(each)]:
            raise _broken(f"{self.where}: statistics of '{key}' have shapes {', '.join(odd)}, not {list(each)}")
        a, b = (stats[p].double().flatten() for p in pairs[mode])
        if mode == "MEAN_STD":
            scale, shift = (b, a) if inverse else (1 / (b + self.eps), -a / (b + self.eps))
        else:
            span = torch.where(a == b, torch.full_like(a, self.eps), b - a)
            if self.old:
                span = b - a if inverse else b - a + self.eps
            # LeRobot subtracts `a` first, so a feature that never changes becomes -1. With scale and shift that is only
            # so while the last digit of a * scale in float32 is far below 1; a larger scale was off by up to 16.
            most = torch.exp2((21 - a.abs().log2()).floor())
            scale = most.minimum(2 / span)
            scale, shift = (span / 2, a + span / 2) if inverse else (scale, -a * scale - 1)
        if not (torch.isfinite(scale.float()).all() and torch.isfinite(shift.float()).all()):  # used as float32
            raise CheckpointError(f"{self.where}: statistics of '{key}' are not finite", remedy="compute them again")
        if (wrong := b < 0 if mode == "MEAN_STD" else b < a).any():
            what = "a negative std" if mode == "MEAN_STD" else f"a {pairs[mode][0]} above its {pairs[mode][1]}"
            raise CheckpointError(
                f"{self.where}: statistics of '{key}' have {what}, which would turn it around",
                found=f"{a[wrong].tolist()} and {b[wrong].tolist()}",
                remedy="compute them again",
            )
        return Affine(tuple(scale.tolist()), tuple(shift.tolist()))

    def _would_be_raw(self, key: str, kind: str, mode: str | None, stats: Mapping[str, Tensor]) -> CheckpointError:
        """Return the error for a feature that LeRobot would leave as it is although the config does not say so."""
        remedy = (
            "copy the folder again from where it was trained, with all policy_preprocessor* and policy_postprocessor* "
            "files, or say IDENTITY where it was trained on raw values"
        )
        if mode is None:
            return CheckpointError(f"{self.where}: no normalisation mode for '{key}' ({kind})", remedy=remedy)
        needs = f"no statistics of '{key}', whose mode is {quote(mode)}"
        if stats:
            needs = f"'{key}' is not among the features that it normalises, and its mode is {quote(mode)}"
        beside = "no processor file beside it, and " if self.old and not self.stats else ""
        return CheckpointError(f"{self.where}: {beside}{needs}", remedy=remedy)


def _of_folder(path: Path, most_bytes: int | None = None) -> Path:
    """Return `path` if it is a plain file of at most `most_bytes`, else raise CheckpointError."""
    try:
        status = path.stat()
    except OSError as e:
        reason = "not found" if isinstance(e, FileNotFoundError) else f"cannot be read ({e.strerror})"
        raise CheckpointError(
            f"{path}: {reason}", remedy="a LeRobot folder has config.json and model.safetensors"
        ) from None
    refuse_pointer(path, CheckpointError)
    if not stat.S_ISREG(status.st_mode):
        raise CheckpointError(f"{path}: not a file", remedy="a LeRobot folder has config.json and model.safetensors")
    if most_bytes is not None and status.st_size > most_bytes:
        raise _broken(f"{path}: has {status.st_size / 1e6:.1f} MB, at most {most_bytes / 1e6:g} are read")
    return path


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(_of_folder(path, JSON_BYTES).read_bytes())
    except (ValueError, OSError, RecursionError) as e:  # RecursionError comes from brackets nested too deep
        raise _broken(f"{path}: not readable as JSON ({e})") from None
    if not isinstance(content, dict):
        raise _broken(f"{path}: expected a JSON object", type(content).__name__)
    return content


def _read_safetensors(path: Path, most_bytes: int | None = None) -> dict[str, Tensor]:
    try:
        with _of_folder(path, most_bytes).open("rb") as f:
            header_bytes = int.from_bytes(f.read(8), "little")
        if header_bytes > HEADER_BYTES:
            raise _broken(
                f"{path}: not readable as safetensors (its header claims {header_bytes / 1e6:.1f} MB, "
                f"at most {HEADER_BYTES / 1e6:g} are read)"
            )
        return load_file(path)
    except CheckpointError:
        raise
    except Exception as e:  # whatever safetensors or torch raise for a wrong header
        raise _broken(f"{path}: not readable as safetensors ({quote(str(e))})") from None

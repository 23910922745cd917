"""Read the folder that `lerobot-train` leaves: config.json, model.safetensors, and how each feature is normalised.

LeRobot's own classes read the config and the processors. What they accept without a word, such as a feature that has no
statistics and so is left as it is, is checked here.
"""

from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from safetensors.torch import load_file
from torch import Tensor

from rover_lib.onboard.checked import is_whole
from rover_lib.onboard.errors import CheckpointError, printable
from rover_lib.onboard.kinds import refuse_pointer
from rover_lib.workshop.act import ActConfig, Affine
from rover_lib.workshop.checkpoint.contents import (
    MIGRATE,
    MOST,
    Contents,
    as_checkpoint_error,
    name_numbers,
    name_weights,
)
from rover_lib.workshop.recordings.samples import camera_names
from rover_lib.workshop.untrusted import quote, quote_all, read_json

if TYPE_CHECKING:
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.processor.normalize_processor import NormalizerProcessorStep

RATE_HZ = 30.0  # steps of a plan in a second if nothing says it: the rate of the trainer's recordings
JSON_BYTES = 1_000_000  # LeRobot's config.json: 3 kB
PRETRAINED = "pretrained_model"
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
    found = sorted(p.parent.name for steps in (path, path / "checkpoints") for p in steps.glob(f"*/{PRETRAINED}"))
    what = f"{path}: no config.json, nor a link to the last checkpoint"
    remedy = "give best_model.pth, or one pretrained_model folder with config.json; merge an adapter before"
    raise CheckpointError(what, found=quote_all(found) or "none", remedy=remedy)


def read_lerobot(folder: Path) -> Contents:
    """Raises CheckpointError for missing or damaged files, and for policies that this project cannot run."""
    said, notes = _act_config(folder)
    weights = name_weights(folder, _read_safetensors(folder / "model.safetensors"))
    inner, outer = Normaliser(folder, *INNER, said), Normaliser(folder, *OUTER, said)
    origin = _read_json(folder / ORIGIN) if (folder / ORIGIN).exists() else {}  # what we noted in one that we wrote
    images, numbers, actions = said.image_features, said.robot_state_feature, said.action_feature
    with as_checkpoint_error(folder):
        config = ActConfig(
            cameras=tuple(camera_names(images)),
            image_sizes=tuple((f.shape[1], f.shape[2]) for f in images.values()),
            state_names=name_numbers(numbers.shape[0] if numbers else 2, "state"),
            action_names=name_numbers(actions.shape[0], "action"),
            chunk=said.chunk_size,
            dim=said.dim_model,
            heads=said.n_heads,
            feedforward=said.dim_feedforward,
            encoder_layers=said.n_encoder_layers,
            decoder_layers=said.n_decoder_layers,
            latent=said.latent_dim,
            vae_layers=said.n_vae_encoder_layers if said.use_vae else 0,
            backbone=said.vision_backbone,
            dilation=bool(said.replace_final_stride_with_dilation),
            pre_norm=said.pre_norm,
            activation=said.feedforward_activation,
            rate_hz=float(origin.get("rate_hz", RATE_HZ)),
            image_norm=tuple(
                inner.affine(key, "VISUAL", (3, 1, 1)) or Affine((1.0,) * 3, (0.0,) * 3) for key in images
            ),
            state_norm=inner.affine("observation.state", "STATE", numbers.shape) if numbers else None,
            sees_state=numbers is not None,
            action_unnorm=outer.affine("action", "ACTION", actions.shape, inverse=True),
        )
    report = {"optimizer_mb": 0.0, "written_here": bool(origin), "notes": notes}
    return config, weights, report | {"license": said.license, "base_model": said.repo_id}  # on the Hub


def _act_config(folder: Path) -> tuple["ACTConfig", list[str]]:
    """Return the config as LeRobot reads it, and notes on what it asks for beyond the network.

    Raises CheckpointError.
    """
    path = folder / "config.json"
    raw = _read_json(path)
    if raw.get("type") != "act":
        what = f"{path}: policy type is {quote(raw.get('type'))}"
        raise CheckpointError(what, remedy=f"only 'act' is known; {MIGRATE}")
    with as_checkpoint_error(path):
        import draccus  # LeRobot's reader of configs
        from lerobot.policies.act.configuration_act import ACTConfig

        known = {field.name for field in fields(ACTConfig)}
        # LeRobot 0.4 refuses what 0.6 added, and whether the training had CUDA is nothing to us.
        said = draccus.decode(ACTConfig, {k: v for k, v in raw.items() if k in known} | {"device": "cpu"})
        cameras = [tuple(camera.shape) for camera in said.image_features.values()]
        rows = [tuple(row.shape) for row in (said.robot_state_feature, said.action_feature) if row]
        whole = all(is_whole(n, 1, MOST) for shape in (*cameras, *rows) for n in shape)
        right = all(len(s) == 3 and s[0] == 3 for s in cameras) and all(len(s) == 1 for s in rows)
    if not (cameras and said.action_feature and whole and right) or said.env_state_feature:
        features = {**said.input_features, **said.output_features}
        found = quote_all(f"{name} {feature.type.value} {feature.shape}" for name, feature in features.items())
        remedy = "train with cameras (3, height, width), numbers in 'action', and in 'observation.state' or none"
        raise CheckpointError(f"{folder}: its features are not a car's", found=found, remedy=remedy)
    notes = []
    if said.temporal_ensemble_coeff is not None:
        coefficient = f"temporal_ensemble_coeff is {said.temporal_ensemble_coeff}"
        notes.append(f"{coefficient}: LeRobot would average plans; here the car drives by the newest alone")
    if unknown := sorted(set(raw) - known - {"type", "pretrained_revision"}):
        notes.append(f"config.json has what no ACT of LeRobot 0.4 or 0.6 has, not used: {quote_all(unknown)}")
    return said, notes


class Normaliser:
    """Says how LeRobot normalises each input, or each output, as an Affine.

    LeRobot silently leaves a feature without statistics as it is, and an output in standard deviations would become a
    servo's pulse. file, step: INNER or OUTER. said: the policy's config, whose modes hold where there is no file.
    """

    def __init__(self, folder: Path, file: str, step: str, said: "ACTConfig"):
        from lerobot.processor.normalize_processor import NormalizerProcessorStep

        self.where = folder / file
        if self.where.exists():
            self.step = self._read_step(folder, step)
        else:
            features = {**said.input_features, **said.output_features}
            self.step = NormalizerProcessorStep(features, said.normalization_mapping)

    def _read_step(self, folder: Path, normalises: str) -> "NormalizerProcessorStep":
        """Return the step that normalises, as LeRobot reads it. Raises CheckpointError for a step that is unknown."""
        from lerobot.processor.normalize_processor import NormalizerProcessorStep

        content, read = _read_json(self.where), []
        with as_checkpoint_error(self.where):
            for step in content["steps"]:
                name, config = step["registry_name"], step.get("config") or {}
                if name == normalises:
                    read.append(NormalizerProcessorStep(**config))
                    if file := step.get("state_file"):
                        read[-1].load_state_dict(_read_safetensors(folder / Path(file).name))
                elif name not in HARMLESS or config.get("rename_map"):
                    what = f"{self.where}: has a processor step that is not known here: {quote(name)}"
                    raise CheckpointError(what, remedy="train without it, or do in the recordings what it does")
        if len(read) != 1 or read[0].normalize_observation_keys is not None:
            what = f"{self.where}: normalises {len(read)} times, or some of the observations only"
            raise CheckpointError(what, remedy="copy the folder again, or train with LeRobot's own single step")
        return read[0]

    def affine(self, key: str, kind: str, shape: tuple[int, ...], inverse: bool = False) -> Affine | None:
        """Return what LeRobot's step computes as scale and shift; None if it leaves the feature as it is.

        key, kind, shape: the feature's. inverse: undo the normalisation, as for an output. Raises CheckpointError for
        missing or wrong statistics.
        """
        step, own = self.step, self.step.features.get(key)
        if own and not inverse:
            kind = own.type.value  # by which LeRobot chooses the mode, whatever the config says
        mode = {k.value: m.value for k, m in step.norm_map.items()}.get(kind)
        if mode == "IDENTITY":
            return None
        stats = [name for name in step.state_dict() if name.startswith(f"{key}.")]
        if mode is None or not stats or not (inverse or (own and kind != "ACTION")):
            found = f"mode {quote(mode)}, statistics {quote_all(stats) or 'none'}"
            remedy = "copy all policy_preprocessor* and policy_postprocessor* files, or say IDENTITY for raw values"
            raise CheckpointError(f"{self.where}: '{key}' would not be normalised", found=found, remedy=remedy)
        x = torch.stack([torch.zeros(shape), torch.ones(shape)]).double()
        y = step._normalize_action(x, True) if inverse else step._normalize_observation({key: x}, False)[key]
        shift, scale = y[0].flatten(), (y[1] - y[0]).flatten()
        finite = torch.isfinite(scale.float()).all() and torch.isfinite(shift.float()).all()  # used as float32
        if y.shape != x.shape or not finite or (scale < 0).any() or not (inverse or scale.all()):
            what = f"{self.where}: statistics of '{key}' have another shape, are not finite, or would turn it around"
            raise CheckpointError(what, found=f"scales {scale.tolist()[:3]}", remedy="compute them again")
        if not inverse:
            # LeRobot subtracts first, so a feature that never changes becomes -1, or 0. With scale and shift that is
            # only so while the last digit of x * scale in float32 is far below 1; a larger scale was off by up to 16.
            end = 0.0 if mode == "MEAN_STD" else -1.0
            usual = (end - shift) / scale
            most = torch.exp2((21 - usual.abs().log2()).floor())
            scale, shift = scale.minimum(most), torch.where(scale > most, end - usual * most, shift)
        return Affine(tuple(scale.tolist()), tuple(shift.tolist()))


def _read_json(path: Path) -> dict[str, Any]:
    refuse_pointer(path, CheckpointError)
    with as_checkpoint_error(path):
        return dict(read_json(path, JSON_BYTES))


def _read_safetensors(path: Path) -> dict[str, Tensor]:
    refuse_pointer(path, CheckpointError)
    if not path.is_file():
        what = f"{printable(str(path))}: not found, or not a file"
        raise CheckpointError(what, remedy="merge an adapter or pieces where it was trained, and save_pretrained")
    with as_checkpoint_error(path):
        return load_file(path)

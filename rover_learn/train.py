"""Train LeRobot's own ACTPolicy on recordings, and write a checkpoint in the format of the user's trainer.

    train("episodes", "best_model.pth")

How it learns is rover_learn/act_phases.py's. Recordings that are mirrored beside the others are turned over.
"""

import shutil
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path

from rover_exchange.export_dataset import lerobot_train
from rover_learn import act_phases, augment, backbone, judges, soften, training
from rover_learn.act_phases import Overrides, TrainingRecipe, train_in_phases
from rover_learn.backbone import Pretrained
from rover_learn.curves import leave_curves
from rover_learn.phases import VERSIONS
from rover_learn.training import Machine, Resumable
from rover_lib.onboard.durable import build_folder
from rover_lib.onboard.errors import EpisodeError, TrainingError
from rover_lib.onboard.params import params
from rover_lib.onboard.policy import preprocess
from rover_lib.onboard.stage import atomic_path
from rover_lib.workshop import act, act_config
from rover_lib.workshop.act import ActConfig
from rover_lib.workshop.cache import cache_folder, cache_root, key_of
from rover_lib.workshop.checkpoint.files import RATE_HZ, save_torch
from rover_lib.workshop.checkpoint.lerobot import write_lerobot
from rover_lib.workshop.checkpoint.trainer import trainer_config
from rover_lib.workshop.pictures.shown import with_faults
from rover_lib.workshop.pictures.turning import measure_sides
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings import controls, samples
from rover_lib.workshop.recordings import episodes as recorded_episodes
from rover_lib.workshop.recordings.blocks import usual_rate_hz
from rover_lib.workshop.recordings.episodes import load_recordings
from rover_lib.workshop.recordings.samples import ACTION_NAMES, Recordings
from rover_lib.workshop.recordings.source import Source

SIZES = {
    "small": ActConfig(
        image_sizes=((72, 128),), dim=128, heads=4, feedforward=512, encoder_layers=1, decoder_layers=1, vae_layers=1
    ),
    "full": ActConfig(),
}
# A cached checkpoint that takes minutes is made anew after each change of the code that makes it. One that takes an
# hour or more is made anew only when this number is raised. Raise it when you change what the same recipe results in.
FULL_VERSION = 4
# Whose sources decide what a training results in.
LEARNERS = (
    *(sys.modules[__name__], act_phases, backbone, augment, judges, soften, training),
    *(act, act_config, preprocess, recorded_episodes, controls),
)


def train(
    episodes: Path | str | Source,
    out_path: Path | str,
    size: str = "small",
    seed: int = 0,
    overrides: Overrides | None = None,
    *,
    backbone: Path | str | None = None,
    machine: Machine | None = None,
    progress: Progress = silent,
    say: Callable[[str], object] = silent,
) -> Path:
    """Train a policy on recordings and write its checkpoint in the format of the user's trainer.

    episodes: our recordings of one car, or a LeRobotDataset of steering, throttle and one camera. Their calibration
    part trains the policy, the choosing part gives best_val_loss, and the held-out part is left for its judgement.
    size: 'small' (72x128) or 'full' (the user's policy, 360x640). overrides: of the size's recipe in params.yml.
    backbone: weights that it begins with, as Pretrained.of takes them; None: random ones. machine: None takes the best
    that there is. say: is told what it trains on, and how that goes.

    Returns out_path, which appears complete or not at all; beside it are its <name>_curves/, which say of each action
    how far it is off, and the same policy as LeRobot's folder, <name>_pretrained_model/. On one machine the same input
    gives the same weights, even if training was ended at any moment and started again, unless the budget ended it. A
    checkpoint that was made before is taken from the cache.
    Raises TrainingError for a size, device, steps or seed that it cannot use, EpisodeError for recordings.
    """
    machine = machine or Machine.of()
    overrides = overrides or Overrides()
    say(f"training on {machine.words()}")
    if size not in SIZES:
        raise TrainingError(f"a policy's size must be one of {', '.join(SIZES)}", found=repr(size))
    if seed < 0:
        raise TrainingError("training needs a seed from 0", found=seed)
    config = SIZES[size]
    device = machine.device.type
    recipes = {kind: TrainingRecipe.of(size, kind, overrides) for kind in ("cpu", "cuda")}
    recipe = recipes[device]
    pretrained = None if backbone is None else Pretrained.of(backbone, say)
    recordings = load_recordings(episodes, config.chunk, params()["calibration"]["sync_s"], progress)
    rate_hz = _rate_hz(recordings)
    for caution in with_faults(recordings, progress).cautions():
        say(caution)
    origin = pretrained.origin if pretrained else {}
    ingredients = {"size": asdict(config), "seed": seed, "split": params()["calibration"], "version": FULL_VERSION}
    ingredients |= {"versions": [version(name) for name in VERSIONS], "episodes": recordings.hashes()} | origin
    ingredients |= {"rate_hz": rate_hz} | ({"amp": True} if machine.amp else {})
    sources = () if size == "full" and overrides.steps is None else LEARNERS
    keys = {kind: ingredients | {"recipe": asdict(recipe)} for kind, recipe in recipes.items()}
    begun = {kind: cache_root() / f"training-{key_of(key, *sources)}" for kind, key in keys.items()}
    unfinished = begun.pop(device)  # which another device goes on with if its recipe is the same, else:
    if not unfinished.exists() and any(folder.exists() for folder in begun.values()):
        say(f"begins anew: what {', '.join(begun)} has begun is of another recipe (params.yml)")

    def make(folder: Path) -> None:
        with machine.computing(), Resumable(unfinished, machine, progress) as saved:
            began_s = time.monotonic()
            sides = measure_sides(recordings, progress)
            if lateness := sides.lateness():
                say(lateness)
            drives = _turned(recordings, sides.mirrored)
            content, actions = train_in_phases(drives, config, recipe, seed, saved, pretrained, say)
            say(f"in {time.monotonic() - began_s:.0f} s")
            leave_curves(folder / "curves", saved.losses, saved.judged, actions)
            weights = {name.removeprefix("model."): v for name, v in content["model_state_dict"].items()}
            trained_by = {"trained_by": asdict(recipe), "device": device} | origin
            write_lerobot(folder / "pretrained_model", replace(config, rate_hz=rate_hz), weights, trained_by)
            settings = {"learning_rate": recipe.transformer_rate, "batch_size": recipe.batch, "device": device}
            settings |= {"seed": seed, "data_dir": "episodes", "output_dir": "checkpoints"}
            settings |= {"pretrained_backbone": pretrained is not None}
            settings |= {"rate_hz": int(rate_hz) if rate_hz.is_integer() else rate_hz}
            content["config"] = trainer_config(config, **settings)
            # It must be on the disk before the unfinished training, which it comes from, is removed.
            save_torch(folder / "best_model.pth", content)

    checkpoint = cache_folder("checkpoint", key_of({**keys[device], "device": device}, *sources), make)
    shutil.rmtree(unfinished, ignore_errors=True)
    return _copy_out(checkpoint, Path(out_path))


def _copy_out(checkpoint: Path, out_path: Path) -> Path:
    """Copy a checkpoint's file from its folder in the cache to `out_path`, and the folders in it beside that."""
    for name in ("curves", "pretrained_model"):
        with build_folder(out_path.with_name(f"{out_path.stem}_{name}")) as new:
            shutil.copytree(checkpoint / name, new, dirs_exist_ok=True)
    with atomic_path(out_path) as temporary:
        shutil.copyfile(checkpoint / "best_model.pth", temporary)
    return out_path


def curves_of(checkpoint: Path) -> Path:
    """Return the folder of the curves of a checkpoint that `train` wrote."""
    return checkpoint.with_name(f"{checkpoint.stem}_curves")


def _rate_hz(recordings: Recordings) -> float:
    """Return the steps per second of plans: the recordings', but 30 if those are within a fifth of it.

    Raises EpisodeError for recordings that this training is not for.
    """
    layout = recordings.layout
    samples.car_of(recordings.samples)
    if layout.action_names != ACTION_NAMES or layout.state_names != ACTION_NAMES or len(layout.cameras) != 1:
        problem = f"{recordings.root}: rover train is for cars of steering and throttle with one camera"
        remedy = f"name them, as in --action-names steering,throttle, or: {lerobot_train(recordings.root)}"
        raise EpisodeError(problem, found=layout.words(), remedy=remedy)
    rate_hz = layout.rate_hz or usual_rate_hz(recordings.episodes) or RATE_HZ
    if layout.rate_hz or samples.is_another_rate(rate_hz, RATE_HZ):
        return float(samples.round_rate_hz(rate_hz))
    return RATE_HZ


def _turned(recordings: Recordings, mirrored: Sequence[str]) -> Recordings:
    """Return the recordings with the pictures of the mirrored episodes, by name, turned over."""
    episodes = list(recordings.episodes)
    for i, episode in enumerate(episodes):
        if episode.id in mirrored:
            episodes[i] = replace(episode, samples=tuple(replace(s, mirrored=True) for s in episode.samples))
    return replace(recordings, episodes=tuple(episodes))

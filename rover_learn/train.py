"""Train LeRobot's own ACTPolicy on recordings, and write a checkpoint in the format of the user's trainer.

    train("episodes", "best_model.pth")

How it learns is rover_learn/act_phases.py's. Recordings that are mirrored beside the others are turned over.
"""

import shutil
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from rover_exchange.export_dataset import lerobot_train
from rover_learn import act_phases
from rover_learn import augment as augment_module
from rover_learn import backbone as backbone_module
from rover_learn import judges as judges_module
from rover_learn import training as loop
from rover_learn.act_phases import TrainingRecipe, train_in_phases
from rover_learn.backbone import Pretrained
from rover_learn.curves import leave_curves
from rover_learn.phases import VERSIONS
from rover_learn.training import Machine, Resumable
from rover_lib.onboard.durable import build_folder
from rover_lib.onboard.errors import EpisodeError, TrainingError
from rover_lib.onboard.params import params
from rover_lib.onboard.policy import preprocess
from rover_lib.onboard.stage import atomic_path
from rover_lib.workshop import act as act_module
from rover_lib.workshop import act_config
from rover_lib.workshop.act import ActConfig
from rover_lib.workshop.cache import cache_folder, cache_root, key_of
from rover_lib.workshop.checkpoint.files import RATE_HZ, save_torch
from rover_lib.workshop.checkpoint.lerobot import write_lerobot
from rover_lib.workshop.checkpoint.trainer import trainer_config
from rover_lib.workshop.pictures.shown import with_faults
from rover_lib.workshop.pictures.turning import measure_sides
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings import controls
from rover_lib.workshop.recordings import episodes as episodes_module
from rover_lib.workshop.recordings import samples as recorded
from rover_lib.workshop.recordings.blocks import usual_rate_hz
from rover_lib.workshop.recordings.episodes import load_recordings
from rover_lib.workshop.recordings.samples import ACTION_NAMES, Recordings
from rover_lib.workshop.recordings.source import Source

if TYPE_CHECKING:
    pass

SIZES = {
    "small": ActConfig(
        image_sizes=((72, 128),), dim=128, heads=4, feedforward=512, encoder_layers=1, decoder_layers=1, vae_layers=1
    ),
    "full": ActConfig(),
}
# A cached checkpoint that takes minutes is made anew after each change of the code that makes it. One that takes an
# hour or more is made anew only when this number is raised. Raise it when you change what the same recipe results in.
FULL_VERSION = 4


def train(
    episodes: Path | str | Source,
    out_path: Path | str,
    size: str = "small",
    seed: int = 0,
    steps: int | None = None,
    batch: int | None = None,
    minutes: float | None = None,
    *,
    backbone: Path | str | None = None,
    machine: Machine | None = None,
    progress: Progress = silent,
    say: Callable[[str], object] = silent,
) -> Path:
    """Train a policy on recordings and write its checkpoint in the format of the user's trainer.

    episodes: our recordings of one car, or a LeRobotDataset of steering, throttle and one camera. Their calibration
    part trains the policy, the choosing part gives best_val_loss, and the held-out part is left for its judgement.
    size: 'small' (72x128) or 'full' (the user's policy, 360x640). steps: of all phases together, batch: of each phase;
    minutes: its budget; None: the recipe's. backbone: weights that it begins with, as Pretrained.of takes them; None:
    random ones. machine: None takes the best that there is. say: is told what it trains on, and how that goes.

    Returns out_path, which appears complete or not at all; beside it are its <name>_curves/, which say of each action
    how far it is off, and the same policy as LeRobot's folder, <name>_pretrained_model/. On one machine the same input
    gives the same weights, even if training was ended at any moment and started again, unless the budget ended it. A
    checkpoint that was made before is taken from the cache.
    Raises TrainingError for a size, device, steps or seed that it cannot use, EpisodeError for recordings.
    """
    out_path = Path(out_path)
    machine = machine or Machine.of()
    kind = machine.device.type
    say(f"training on {machine.words()}")
    if size not in SIZES:
        raise TrainingError(f"a policy's size must be one of {', '.join(SIZES)}", found=repr(size))
    if seed < 0:
        raise TrainingError("training needs a seed from 0", found=seed)
    recipes = {each: TrainingRecipe.of(size, each, steps, batch, minutes) for each in ("cpu", "cuda")}
    recipe = recipes[kind]
    pretrained = None if backbone is None else Pretrained.of(backbone, say)
    p = params()["calibration"]
    recordings = load_recordings(episodes, SIZES[size].chunk, p["sync_s"], progress)
    rate_hz = _rate_hz(recordings)
    for caution in with_faults(recordings, progress).cautions():
        say(caution)
    made_of = {"size": asdict(SIZES[size]), "seed": seed, "split": p}
    made_of |= {"versions": [version(name) for name in VERSIONS], "version": FULL_VERSION}
    made_of |= {"episodes": recordings.hashes(), "rate_hz": rate_hz} | ({"amp": True} if machine.amp else {})
    made_of |= pretrained.origin if pretrained else {}
    phases = act_phases, backbone_module, augment_module, judges_module, loop, act_module, act_config
    learners = sys.modules[__name__], *phases, preprocess, episodes_module, controls
    sources = () if size == "full" and steps is None else learners
    keys = {each: made_of | {"recipe": asdict(made_by)} for each, made_by in recipes.items()}
    begun = {each: cache_root() / f"training-{key_of(key, *sources)}" for each, key in keys.items()}
    unfinished = begun.pop(kind)  # which another device goes on with if its recipe is the same, else:
    if not unfinished.exists() and any(folder.exists() for folder in begun.values()):
        say(f"begins anew: what {', '.join(begun)} has begun is of another recipe (params.yml)")

    def make(folder: Path) -> None:
        known = {"learning_rate": recipe.transformer_rate, "batch_size": recipe.batch, "device": kind, "seed": seed}
        known |= {"data_dir": "episodes", "output_dir": "checkpoints", "pretrained_backbone": pretrained is not None}
        known |= {"rate_hz": int(rate_hz) if rate_hz.is_integer() else rate_hz}
        with machine.computing(), Resumable(unfinished, machine, progress) as saved:
            began_s = time.monotonic()
            trained, actions = train_in_phases(
                _turned(recordings, progress), SIZES[size], recipe, seed, saved, pretrained, say
            )
            say(f"in {time.monotonic() - began_s:.0f} s")
            leave_curves(folder / "curves", saved.losses, saved.judged, actions)
            weights = {name.removeprefix("model."): v for name, v in trained["model_state_dict"].items()}
            config, origin = replace(SIZES[size], rate_hz=rate_hz), {"trained_by": asdict(recipe), "device": kind}
            origin |= pretrained.origin if pretrained else {}
            write_lerobot(folder / "pretrained_model", config, weights, origin)
            # It must be on the disk before the unfinished training, which it comes from, is removed.
            save_torch(folder / "best_model.pth", {**trained, "config": trainer_config(SIZES[size], **known)})

    made = cache_folder("checkpoint", key_of({**keys[kind], "device": kind}, *sources), make)
    shutil.rmtree(unfinished, ignore_errors=True)
    for folder in (each for each in made.iterdir() if each.is_dir()):  # those of older programs have none
        with build_folder(out_path.with_name(f"{out_path.stem}_{folder.name}")) as new:
            shutil.copytree(folder, new, dirs_exist_ok=True)
    with atomic_path(out_path) as temporary:
        shutil.copyfile(made / "best_model.pth", temporary)
    return out_path


def curves_of(checkpoint: Path) -> Path:
    """Return the folder of the curves of a checkpoint that `train` wrote."""
    return checkpoint.with_name(f"{checkpoint.stem}_curves")


def _rate_hz(recordings: Recordings) -> float:
    """Return the steps per second of plans: the recordings', but 30 if those are within a fifth of it.

    Raises EpisodeError for recordings that this training is not for.
    """
    layout = recordings.layout
    recorded.car_of(recordings.samples)
    if layout.action_names != ACTION_NAMES or layout.state_names != ACTION_NAMES or len(layout.cameras) != 1:
        what = f"{recordings.root}: rover train is for cars of steering and throttle with one camera"
        remedy = f"name them, as in --action-names steering,throttle, or: {lerobot_train(recordings.root)}"
        raise EpisodeError(what, found=layout.words(), remedy=remedy)
    found_hz = layout.rate_hz or usual_rate_hz(recordings.episodes) or RATE_HZ
    as_recorded = layout.rate_hz or recorded.is_another_rate(found_hz, RATE_HZ)
    return float(recorded.round_rate_hz(found_hz)) if as_recorded else RATE_HZ


def _turned(recordings: Recordings, progress: Progress) -> Recordings:
    """Return the recordings with the pictures of those that are mirrored beside most others turned over."""
    mirrored, episodes = measure_sides(recordings, progress).mirrored, []
    for e in recordings.episodes:
        samples = tuple(replace(s, mirrored=True) for s in e.samples) if e.id in mirrored else e.samples
        episodes.append(replace(e, samples=samples))
    return replace(recordings, episodes=tuple(episodes))

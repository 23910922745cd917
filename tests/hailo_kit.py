"""A kit of a tiny policy whose state, actions and colours are all normalised, and what the kit is made from."""

from dataclasses import replace
from pathlib import Path

from policies import memory_samples

from rover_hailo.kit import write_kit
from rover_lib.workshop.act import Affine
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint
from rover_lib.workshop.recordings.episodes import Split
from rover_lib.workshop.run.session import Opened

FRAMES = 6


def normalised(tiny: Checkpoint) -> Checkpoint:
    config = replace(
        tiny.config, state_norm=Affine((2.0, 3.0), (0.1, -0.2)), action_unnorm=Affine((0.2, 0.1), (0.05, 0.3))
    )
    return replace(tiny, config=config)


def opened(checkpoint: Checkpoint) -> Opened:
    samples = tuple(memory_samples(FRAMES))
    parts = Split(samples, tuple(memory_samples(4, seed=1)), (), None, {})
    return Opened(checkpoint, None, parts)


def make_kit(checkpoint: Checkpoint, folder: Path) -> Path:
    write_kit(opened(checkpoint), folder, samples=FRAMES)
    return folder

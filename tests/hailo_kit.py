"""A kit of a tiny policy whose state, actions and colours are all normalised, and what the kit is made from."""

from dataclasses import replace
from pathlib import Path

from policies import memory_samples

from rover_exchange.hailo.kit import write_kit
from rover_lib.workshop.act import Affine
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint
from rover_lib.workshop.int8.export import Exporter
from rover_lib.workshop.recordings.episodes import Split
from rover_lib.workshop.run.session import Opened

FRAMES = 6


def normalised(tiny: Checkpoint) -> Checkpoint:
    config = replace(
        tiny.config, state_norm=Affine((2.0, 3.0), (0.1, -0.2)), action_unnorm=Affine((0.2, 0.1), (0.05, 0.3))
    )
    return replace(tiny, config=config)


def opened(checkpoint: Checkpoint) -> Opened:
    parts = Split(tuple(memory_samples(FRAMES)), tuple(memory_samples(4, seed=1)), (), None)
    return Opened(checkpoint, None, parts)


def make_kit(checkpoint: Checkpoint, folder: Path) -> Path:
    """FP32 stands for the run's static INT8 too: the stand-in for the chip quantizes nothing."""
    exporter = Exporter(checkpoint, memory_samples(4, seed=1))
    for name in ("policy_fp32.pt", "policy_static.pt"):
        exporter.export(exporter.float_policy, folder / name)
    write_kit(opened(checkpoint), folder, folder / "kit", samples=FRAMES)
    return folder / "kit"

"""Measure a training on a GPU: seconds by phase, of them waiting for data, and whether its weights repeat."""

import os
import tempfile
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch

from balloon_world.record import record_episodes
from rover_learn.train import train
from rover_learn.training import Machine
from rover_lib.workshop.cache import cache_root
from rover_lib.workshop.progress import Progress

MOST_S, MOST_BEFORE_S, MOST_DATA_SHARE = 130.0, 6.0, 0.25  # of all, before the first step, of it waiting for data
DRIVES = 128  # 16,500 frames
REPEATED_STEPS, INTERRUPTED_AT = 120, 60  # of the trainings that should give the same weights


class Phases:
    """A bar that times a training's phases, and its waiting for data. stop_at: interrupts after so many steps."""

    def __init__(self, stop_at: int | None = None):
        self.rows: dict[str, dict[str, float]] = {}
        self.stop_at = stop_at

    def __call__(self, items: Iterable[Any], desc: str = "", **_: Any) -> Iterator[Any]:
        kind, _comma, phase = desc.partition(", ")
        row = self.rows.setdefault(phase, {"steps": 0, "s": 0.0, "data_s": 0.0}) if kind == "training" else {}
        began_s = time.monotonic()
        for each in items:
            waited_s = time.monotonic() - began_s
            yield each
            if row:
                row["steps"] += 1
                row["s"] += time.monotonic() - began_s
                row["data_s"] += waited_s
                if sum(every["steps"] for every in self.rows.values()) == self.stop_at:
                    raise KeyboardInterrupt
            began_s = time.monotonic()


def record(device: str, progress: Progress) -> Path:
    """Record, or find in the cache, drives to train on, for a device that is there. Raises TrainingError."""
    Machine.of(device)
    return record_episodes(cache_root() / "gpu-episodes", DRIVES, progress=progress)


def measure(episodes: Path, device: str = "cuda", size: str = "full") -> dict[str, Any]:
    """Train once by the recipe, then twice for REPEATED_STEPS, the second time with an interruption.

    Returns what it took, and in `wrong` a sentence for each requirement that does not hold. Raises TrainingError
    without such a device.
    """
    machine, phases = Machine.of(device), Phases()
    with tempfile.TemporaryDirectory() as folder, patch.dict(os.environ):
        began_s = time.monotonic()
        _train(episodes, Path(folder) / "whole", size, device, progress=phases)
        all_s = time.monotonic() - began_s
        memory_mb = torch.cuda.max_memory_allocated(machine.device) / 1e6 if machine.device.type == "cuda" else None
        once = _train(episodes, Path(folder) / "once", size, device, steps=REPEATED_STEPS)
        again: dict[str, Any] = {"steps": REPEATED_STEPS, "size": size, "device": device}
        with suppress(KeyboardInterrupt):
            _train(episodes, Path(folder) / "twice", progress=Phases(INTERRUPTED_AT), **again)
        twice = _train(episodes, Path(folder) / "twice", **again)
    before_s = all_s - sum(row["s"] for row in phases.rows.values())
    differ = sum(not torch.equal(value, twice[name]) for name, value in once.items())
    data_share = sum(row["data_s"] for row in phases.rows.values()) / all_s
    wrong = {
        f"{all_s:.0f} s in all, of at most {MOST_S:.0f}": all_s > MOST_S,
        f"{before_s:.1f} s before the first step, of at most {MOST_BEFORE_S:.0f}": before_s > MOST_BEFORE_S,
        f"{data_share:.0%} of the time waits for data, of at most {MOST_DATA_SHARE:.0%}": data_share > MOST_DATA_SHARE,
        f"{differ} of {len(once)} tensors differ after an interruption": differ > 0,
    }
    made = {"device": machine.words(), "workers": machine.workers, "torch": torch.__version__, "size": size}
    made |= {"all_s": all_s, "before_s": before_s, "data_share": data_share, "memory_mb": memory_mb}
    made |= {"phases": phases.rows, "tensors_that_differ": differ}
    return made | {"wrong": [sentence for sentence, is_so in wrong.items() if is_so]}


def _train(episodes: Path, folder: Path, size: str, device: str, **options: Any) -> dict[str, torch.Tensor]:
    """Train with a cache of its own in this folder, and return the weights."""
    os.environ["ROVER_CACHE"] = str(folder / "cache")
    made = train(episodes, folder / "policy.pth", size, machine=Machine.of(device), **options)
    return torch.load(made, weights_only=False)["model_state_dict"]

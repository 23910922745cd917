"""Measure `rover train --size full` on a GPU: seconds by phase, what they go to, memory, and whether weights repeat."""

import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch

from balloon_world.record import record_episodes
from rover_learn import training
from rover_learn.train import train
from rover_learn.training import Machine, Resumable
from rover_lib.workshop.cache import cache_root
from rover_lib.workshop.progress import Progress

MOST_S, MOST_BEFORE_S, MOST_DATA_SHARE = 130.0, 6.0, 0.25  # of all, before the first step, of it waiting for data
DRIVES = 128  # 16,500 frames
BEFORE = "before the first step"
REPEATED_STEPS, INTERRUPTED_AT = 120, 60  # of the trainings that should give the same weights


def record(device: str, progress: Progress) -> Path:
    """Record, or find in the cache, drives to train on, for a device that is there. Raises TrainingError."""
    Machine.of(device)
    return record_episodes(cache_root() / "gpu-episodes", DRIVES, progress=progress)


@contextmanager
def by_phase() -> Iterator[dict[str, dict[str, float]]]:
    """Yield what trainings inside the block take, by phase: steps, s, and of it data_s, waiting, and optimiser_s."""
    rows: dict[str, dict[str, float]] = {}
    steps, ahead, descend = Resumable.steps, training.ahead, training.descend

    def begin(phase: str) -> None:
        rows[phase] = {"steps": 0, "s": 0.0, "data_s": 0.0, "optimiser_s": 0.0}

    def add(key: str, began_s: float) -> None:
        rows[list(rows)[-1]][key] += time.monotonic() - began_s

    def timed_steps(self: Resumable, phase: str, *args: Any, **options: Any) -> Iterator[Any]:
        began_s = time.monotonic()
        begin(phase)
        for each in steps(self, phase, *args, **options):
            yield each
            rows[phase]["steps"] += 1
        add("s", began_s)

    def timed_ahead(*args: Any) -> Iterator[Any]:
        began_s = time.monotonic()
        for each in ahead(*args):
            add("data_s", began_s)
            yield each
            began_s = time.monotonic()

    def timed_descend(*args: Any) -> float:
        began_s = time.monotonic()
        loss = descend(*args)
        add("optimiser_s", began_s)
        return loss

    begin(BEFORE)
    with (
        patch.object(Resumable, "steps", timed_steps),
        patch.object(training, "ahead", timed_ahead),
        patch.object(training, "descend", timed_descend),
    ):
        yield rows


def measure(episodes: Path, device: str = "cuda", size: str = "full") -> dict[str, Any]:
    """Train once by the recipe, then twice for REPEATED_STEPS, the second time with an interruption.

    Returns what it took, and in `wrong` a sentence for each requirement that does not hold. Raises TrainingError
    without such a device.
    """
    machine = Machine.of(device)
    on_gpu = machine.device.type == "cuda"
    with tempfile.TemporaryDirectory() as folder, patch.dict(os.environ):
        began_s = time.monotonic()
        with by_phase() as rows:
            _train(episodes, Path(folder) / "whole", size, device)
        all_s = time.monotonic() - began_s
        memory_mb = torch.cuda.max_memory_allocated(machine.device) / 1e6 if on_gpu else None
        once = _train(episodes, Path(folder) / "once", size, device, steps=REPEATED_STEPS)
        descend, done = training.descend, iter(range(INTERRUPTED_AT))

        def interrupt(*args: Any) -> float:
            if next(done, None) is None:
                raise KeyboardInterrupt
            return descend(*args)

        with suppress(KeyboardInterrupt), patch.object(training, "descend", interrupt):
            _train(episodes, Path(folder) / "twice", size, device, steps=REPEATED_STEPS)
        twice = _train(episodes, Path(folder) / "twice", size, device, steps=REPEATED_STEPS)
    rows[BEFORE]["s"] = all_s - sum(row["s"] for row in rows.values())
    differ = sum(not torch.equal(value, twice[name]) for name, value in once.items())
    data_share = sum(row["data_s"] for row in rows.values()) / all_s
    wrong = {
        f"{all_s:.0f} s in all, of at most {MOST_S:.0f}": all_s > MOST_S,
        f"{rows[BEFORE]['s']:.1f} s {BEFORE}, of at most {MOST_BEFORE_S:.0f}": rows[BEFORE]["s"] > MOST_BEFORE_S,
        f"{data_share:.0%} of the time waits for data, of at most {MOST_DATA_SHARE:.0%}": data_share > MOST_DATA_SHARE,
        f"{differ} of {len(once)} tensors differ after an interruption": differ > 0,
    }
    made = {"device": machine.words(), "workers": machine.workers, "torch": torch.__version__, "size": size}
    made |= {"all_s": all_s, "data_share": data_share, "memory_mb": memory_mb, "phases": rows}
    return made | {"tensors_that_differ": differ, "wrong": [sentence for sentence, is_so in wrong.items() if is_so]}


def _train(episodes: Path, folder: Path, size: str, device: str, **options: Any) -> dict[str, torch.Tensor]:
    """Train with a cache of its own in this folder, and return the weights."""
    os.environ["ROVER_CACHE"] = str(folder / "cache")
    made = train(episodes, folder / "policy.pth", size, device=device, **options)
    return torch.load(made, weights_only=False)["model_state_dict"]

"""Measure trainings on a GPU by rows, each in the JSON as it ends: `python -m research.gpu OUTPUT [EPISODES]`."""

import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import click
import torch

from balloon_world.record import record_episodes
from rover_learn import train as training
from rover_learn.act_phases import Overrides
from rover_learn.train import SIZES, train
from rover_learn.training import Machine, Resumable
from rover_lib.onboard.cli import FILE
from rover_lib.onboard.stage import atomic_path
from rover_lib.workshop.act_config import lerobot_act
from rover_lib.workshop.cache import cache_root

MOST = {"all_s": 130.0, "before_s": 6.0, "data_share": 0.25}  # in all, before the first step, of it waiting for data
DRIVES = 128  # 16,500 frames
REPEATED_STEPS, STOPPED_AFTER = 120, 3  # of the trainings that should give the same weights; steps of a phase
STOPPED_IN = "backbone", "transformer", "all together", "at full size"
Run = Callable[..., dict[str, torch.Tensor]]  # trains in a folder of this name, with such options; returns the weights


class Bars:
    """A bar that times a training's phases, and their waiting for data. stop_in: exits early in this phase.

    first_s: when the first phase began. resumed: at which step a phase that was not done went on.
    """

    def __init__(self, stop_in: str = ""):
        self.rows: dict[str, dict[str, float]] = {}
        self.stop_in, self.first_s, self.resumed = stop_in, 0.0, dict[str, int]()

    def __call__(self, items: Iterable[Any], desc: str, total: int = 0, initial: int = 0) -> Iterator[Any]:
        kind, _comma, phase = desc.partition(", ")
        row = self.rows.setdefault(phase, {"steps": 0, "s": 0.0, "data_s": 0.0}) if kind == "training" else {}
        began_s = time.monotonic()
        if row:
            self.first_s = self.first_s or began_s
            self.resumed |= {phase: initial} if 0 < initial < total else {}
        for each in items:
            waited_s = time.monotonic() - began_s
            yield each
            if row:
                row["steps"] += 1
                row["s"] += time.monotonic() - began_s
                row["data_s"] += waited_s
                if phase == self.stop_in and row["steps"] == STOPPED_AFTER:
                    raise SystemExit
            began_s = time.monotonic()


def time_phases(run: Run, machine: Machine, row: dict[str, Any]) -> list[str]:
    """Train once by the recipe. LeRobot, and the GPU, are there before the clock starts."""
    lerobot_act(SIZES["small"]).to(machine.device)
    bars, began_s = Bars(), time.monotonic()
    row["phases"] = bars.rows
    run("whole", progress=bars)
    row["all_s"], row["before_s"] = time.monotonic() - began_s, bars.first_s - began_s
    row["data_share"] = sum(each["data_s"] for each in bars.rows.values()) / row["all_s"]
    row["memory_mb"] = torch.cuda.max_memory_allocated(machine.device) / 1e6 if machine.device.type == "cuda" else None
    return [f"{name} is {row[name]:.2f}, of at most {most:g}" for name, most in MOST.items() if row[name] > most]


def compare_weights(run: Run, _machine: Machine, row: dict[str, Any]) -> list[str]:
    """Train REPEATED_STEPS twice, the second time interrupted inside each phase, after it was saved."""
    once, resumed = run("once", overrides=Overrides(REPEATED_STEPS)), dict[str, int]()
    with patch.object(training, "Resumable", partial(Resumable, every_s=0.0)):
        for phase in (*STOPPED_IN, ""):
            bars = Bars(phase)
            with suppress(SystemExit):
                twice = run("twice", overrides=Overrides(REPEATED_STEPS), progress=bars)
            resumed |= bars.resumed
    differ = sum(not torch.equal(value, twice[name]) for name, value in once.items())
    row |= {"tensors": len(once), "differ": differ, "resumed_at": resumed}
    wrong = [f"{differ} of {len(once)} tensors differ after interruptions"] if differ else []
    return wrong if {"backbone", "transformer"} <= set(resumed) else [*wrong, "not every phase was resumed inside"]


def measure(output: Path, device: str, size: str, episodes: Path) -> list[str]:
    """Measure both rows, on episodes that are recorded if they are not there, and write each to `output` at its end.

    Returns a sentence for each requirement that does not hold. Raises TrainingError without such a device.
    """
    machine, wrong = Machine.of(device), list[str]()
    made: dict[str, Any] = {"device": machine.words(), "workers": machine.workers, "torch": torch.__version__}
    made |= {"size": size, "rows": {}, "wrong": wrong}
    if not episodes.exists():
        record_episodes(episodes, DRIVES)
    with tempfile.TemporaryDirectory() as folder:
        run = partial(_train, episodes, Path(folder), size=size, machine=machine)
        for name, fill in (("phases", time_phases), ("weights", compare_weights)):
            row, began_s = made["rows"].setdefault(name, {}), time.monotonic()
            try:
                wrong += [f"{name}: {sentence}" for sentence in fill(run, machine, row)]
            except Exception as error:  # the other row is still of use
                wrong.append(f"{name}: {error!r}")
            row["took_s"] = time.monotonic() - began_s
            with atomic_path(output) as temporary:
                temporary.write_text(json.dumps(made, indent=2) + "\n")
    return wrong


def _train(episodes: Path, folder: Path, name: str, **options: Any) -> dict[str, torch.Tensor]:
    """Train with a cache of its own, and return the weights."""
    with patch.dict(os.environ, ROVER_CACHE=str(folder / name)):
        made = train(episodes, folder / f"{name}.pth", **options)
    return torch.load(made, weights_only=False)["model_state_dict"]


@click.command()
@click.argument("output", type=FILE)
@click.argument("episodes", type=FILE, required=False)
@click.option("--device", default="cuda", show_default=True)
@click.option("--size", type=click.Choice(["small", "full"]), default="full", show_default=True)
def main(output: Path, episodes: Path | None, device: str, size: str) -> None:
    """Train on a GPU, on EPISODES or on 128 drives recorded for it, and write what it takes to OUTPUT, as JSON.

    It takes some ten minutes. The exit code is 1 if it takes too long, or an interruption changes the weights.
    research/gpu_proof.sh trains for longer, and judges what comes of that.
    """
    problems = measure(output, device, size, episodes or cache_root() / "gpu-episodes")
    for problem in problems:
        click.echo(problem, err=True)
    sys.exit(1 if problems else 0)


if __name__ == "__main__":
    main()

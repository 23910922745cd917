"""Open the checkpoint and the recordings of a run, as every notebook does first.

This module is separate from `run`, so that a kernel does not import what only the execution of notebooks needs.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import torch

from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.kinds import kinds_of
from rover_lib.onboard.params import params
from rover_lib.onboard.stage import read_stage
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint, check_limits, load_checkpoint
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.episodes import Split, load_recordings, split
from rover_lib.workshop.recordings.samples import Recordings
from rover_lib.workshop.recordings.source import Source
from rover_lib.workshop.run.units import in_todays_units

SMALL_GMAC = 1.0  # a policy below this gains less from a second thread than the thread costs on a busy machine


@dataclass(frozen=True)
class Opened:
    """What notebook 01 loaded: the checkpoint, the recordings, and which episodes calibrate, choose and judge."""

    checkpoint: Checkpoint
    recordings: Recordings
    parts: Split


def load(checkpoint: Path | str, episodes: Path | str | Source, progress: Progress = silent) -> Opened:
    """Read a checkpoint and its recordings, and split the recordings as params.yml says.

    A LeRobot policy gets its own cameras of a LeRobotDataset unless the user chose others, and the dataset's order and
    rate of numbers; one that was trained on the actions of older firmware gets today's units.
    Raises CheckpointError and EpisodeError.
    """
    p = params()["calibration"]
    source = Source.of(episodes)
    policy = load_checkpoint(checkpoint, source.facts)
    theirs = policy.config.cameras
    if policy.format == "lerobot" and source.cameras in ((), theirs):  # a trainer's file does not name its camera
        source = replace(source, cameras=theirs if "dataset" in kinds_of(source.path) else ())
    recordings = load_recordings(source, policy.config.chunk, p["sync_s"], progress)
    parts = split(recordings, p["held_out_share"], p["seed"])
    recorded = policy.recorded_as(recordings.layout, recordings.samples)
    recorded = in_todays_units(recorded, recordings, parts.calibration)
    check_limits(policy.path, recorded.config)  # again, because its rate and names are the recordings'
    return Opened(recorded, recordings, parts)


def open_run(run_dir: Path | str, progress: Progress = silent) -> Opened:
    """Load again what notebook 01 loaded; for a policy of less than SMALL_GMAC, on one thread.

    Raises RoverError if it did not run, or if the files have changed since.
    """
    stage = read_stage(Path(run_dir) / "load.json", "load")
    parameters = stage["params"]
    loaded = stage["metrics"]["checkpoint"]
    if sum(loaded["macs_by_block"].values()) < SMALL_GMAC * 1e9:
        torch.set_num_threads(1)
    again = load(parameters["checkpoint"], Source.loaded(parameters), progress)
    now = again.checkpoint
    then = stage["metrics"]["recordings"].get("layout"), stage["metrics"]["split"]
    if (now.sha256, now.identity) != (loaded["sha256"], loaded["identity"]):
        problem = f"{now.path}: its weights, config or statistics have changed since notebook 01 loaded it"
    elif then != (again.recordings.layout.words(), again.parts.episodes):
        problem = f"{again.recordings.root}: other episodes, or another order of numbers, than notebook 01 loaded"
    else:
        return again
    raise RoverError(problem, remedy="run notebook 01 again")


def training_device(asked: str | None, error: type[RoverError]) -> torch.device:
    """Return the device to train on: cpu, cuda or cuda:N as asked; for None a GPU if torch finds one. Else `error`."""
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    name, _, number = (asked or ("cuda" if count else "cpu")).partition(":")
    if name not in ("cpu", "cuda") or (number and (name == "cpu" or not number.isdecimal())):
        raise error("a device is cpu, cuda, or a GPU's number as in cuda:1", found=asked, remedy="leave it out")
    if name == "cuda" and int(number or 0) >= count:
        problem = f"{asked}: torch {torch.__version__} finds {count} GPUs"
        remedy = "does nvidia-smi show it?"
        raise error(problem, remedy=f"{remedy} if not, install its driver, or train on the CPU: --device cpu")
    return torch.device(name if name == "cpu" else f"cuda:{number or torch.cuda.current_device()}")

"""What every notebook of a run opens first: the checkpoint and the recordings that notebook 01 loaded.

Apart from `run`, so that a kernel need not import what only executing notebooks needs.
"""

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import torch

from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.params import params
from rover_lib.onboard.stage import read_stage
from rover_lib.workshop.checkpoint import Checkpoint, load_checkpoint
from rover_lib.workshop.episodes import Recordings, Split, load_recordings, split

TTY_VARIABLE = "ROVER_PROGRESS_TTY"  # the terminal of who started a run: the notebooks' bars are drawn there
SMALL_GMAC = 1.0  # below this a second thread costs more, on a busy machine, than it brings

Progress = Callable[..., Iterable]


@dataclass(frozen=True)
class Opened:
    """What notebook 01 loaded: the checkpoint, the recordings, and who of them calibrates, chooses and judges."""

    checkpoint: Checkpoint
    recordings: Recordings
    parts: Split


def load(checkpoint: Path | str, episodes: Path | str) -> Opened:
    """Read a checkpoint and its recordings, and part them as params.yml says. Raises CheckpointError, EpisodeError."""
    p = params()["calibration"]
    found = load_checkpoint(checkpoint)
    recordings = load_recordings(episodes, found.config.chunk, p["sync_s"], watched())
    return Opened(found, recordings, split(recordings, p["held_out_share"], p["seed"]))


def opened(run_dir: Path | str) -> Opened:
    """What notebook 01 loaded, again. Raises RoverError if it did not run, or if the files have changed since.

    For a policy of less than SMALL_GMAC, torch is set to one thread (a benchmark sets its own).
    """
    stage = read_stage(Path(run_dir) / "load.json", "load")
    if sum(stage["metrics"]["checkpoint"]["macs_by_block"].values()) < SMALL_GMAC * 1e9:
        torch.set_num_threads(1)
    again = load(stage["params"]["checkpoint"], stage["params"]["episodes"])
    if again.checkpoint.sha256 != stage["metrics"]["checkpoint"]["sha256"]:
        raise RoverError(f"{again.checkpoint.path}: is not what notebook 01 loaded any more; run it again")
    if again.parts.episodes != stage["metrics"]["split"]:
        raise RoverError(f"{again.recordings.root}: has other episodes than notebook 01 found; run it again")
    return again


def watched() -> Progress | None:
    """A progress bar where someone watches, else None: bars in a stored output are noise.

    That is the terminal from which `run` was started, or a JupyterLab session.
    """
    from tqdm import tqdm

    if terminal := os.environ.get(TTY_VARIABLE):
        try:
            stream = Path(terminal).open("w")  # noqa: SIM115, open as long as the kernel lives
        except OSError:
            return None
        return lambda *a, **k: tqdm(*a, **k, file=stream, leave=False)
    if "JPY_SESSION_NAME" in os.environ:
        return lambda *a, **k: tqdm(*a, **k, leave=False)
    return None

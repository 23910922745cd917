"""What every notebook of a run opens first: the checkpoint and the recordings that notebook 01 loaded.

Apart from `run`, so that a kernel need not import what only executing notebooks needs.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import torch

from rover_lib.onboard.artifact import CHUNK, MOST_NAMES, NAME_LENGTH, RATE_HZ, SIDE_PX, is_name
from rover_lib.onboard.errors import CheckpointError, RoverError
from rover_lib.onboard.params import params
from rover_lib.onboard.stage import read_stage
from rover_lib.workshop.checkpoint import Checkpoint, load_checkpoint
from rover_lib.workshop.episodes import Recordings, Split, load_recordings, split
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.samples import Source
from rover_lib.workshop.untrusted import shown

SMALL_GMAC = 1.0  # below this a second thread costs more, on a busy machine, than it brings


@dataclass(frozen=True)
class Opened:
    """What notebook 01 loaded: the checkpoint, the recordings, and which of them calibrate, choose and judge."""

    checkpoint: Checkpoint
    recordings: Recordings
    parts: Split


def load(checkpoint: Path | str, episodes: Path | str | Source, progress: Progress = silent) -> Opened:
    """Read a checkpoint and its recordings, and part them as params.yml says.

    Of a LeRobotDataset the policy's own cameras are read, if nobody chose others, and a LeRobot policy gets the order
    and the rate of the numbers that it was trained on. Raises CheckpointError and EpisodeError.
    """
    p = params()["calibration"]
    policy = load_checkpoint(checkpoint)
    check_sizes(policy)  # each sample has as many actions as a plan: of a million, a few frames fill the memory
    source = Source.of(episodes)
    if policy.format == "lerobot" and not source.cameras:  # the trainer's file does not say what its camera is called
        source = replace(source, cameras=policy.config.cameras)
    recordings = load_recordings(source, policy.config.chunk, p["sync_s"], progress)
    parts = split(recordings, p["held_out_share"], p["seed"])
    recorded = policy.recorded_as(recordings.layout)
    _check_limits(recorded)  # whose rate and names are the recordings'
    return Opened(recorded, recordings, parts)


def _check_limits(policy: Checkpoint) -> None:
    """Raise CheckpointError for a policy that no artifact may hold: now, rather than after minutes of calibration."""
    check_sizes(policy)
    c = policy.config
    _within(policy, "steps of a plan in a second", c.rate_hz, RATE_HZ)
    for what, names in (("cameras", c.cameras), ("states", c.state_names), ("actions", c.action_names)):
        for name in names:
            if not is_name(name):
                raise CheckpointError(
                    f"{policy.path}: the names of {what} must have 1 to {NAME_LENGTH} characters and no '/'",
                    found=shown(name),
                    remedy="give them other names in the dataset's meta/info.json and the policy's config.json",
                )


def check_sizes(policy: Checkpoint) -> None:
    """Raise CheckpointError for a plan, pictures or numbers that no artifact may have: before recordings are read."""
    c = policy.config
    _within(policy, "steps in a plan", c.chunk, CHUNK)
    for side in (side for size in c.image_sizes for side in size):
        _within(policy, "pixels a side", side, SIDE_PX)
    for what, names in (("cameras", c.cameras), ("states", c.state_names), ("actions", c.action_names)):
        _within(policy, what, len(names), (1, MOST_NAMES))


def _within(policy: Checkpoint, what: str, value: float, limits: tuple[float, float]) -> None:
    least, most = limits
    if not least <= value <= most:
        raise CheckpointError(
            f"{policy.path}: {what} must be from {least:g} to {most:g}",
            found=f"{value:g}",
            remedy="such a policy cannot be made into an artifact",
        )


def opened(run_dir: Path | str, progress: Progress = silent) -> Opened:
    """What notebook 01 loaded, again. Raises RoverError if it did not run, or if the files have changed since.

    For a policy of less than SMALL_GMAC, torch is set to one thread (a benchmark sets its own).
    """
    stage = read_stage(Path(run_dir) / "load.json", "load")
    if sum(stage["metrics"]["checkpoint"]["macs_by_block"].values()) < SMALL_GMAC * 1e9:
        torch.set_num_threads(1)
    given = stage["params"]
    again = load(given["checkpoint"], Source.loaded(given), progress)
    loaded, now = stage["metrics"]["checkpoint"], again.checkpoint
    if now.sha256 != loaded["sha256"] or now.identity != loaded.get("identity", now.identity):  # older runs lack it
        found = "the same weights, and another config or other statistics" if now.sha256 == loaded["sha256"] else None
        raise RoverError(
            f"{now.path}: is not what notebook 01 loaded any more", found=found, remedy="run notebook 01 again"
        )
    layout = stage["metrics"].get("recordings", {}).get("layout")
    if layout and layout != again.recordings.layout.words():
        raise RoverError(
            f"{again.recordings.root}: says something else of its numbers than when notebook 01 loaded it",
            found=again.recordings.layout.words(),
            remedy="run notebook 01 again",
        )
    if again.parts.episodes != stage["metrics"]["split"]:
        raise RoverError(
            f"{again.recordings.root}: has other episodes than notebook 01 loaded", remedy="run notebook 01 again"
        )
    return again


def training_device(asked: str | None, error: type[RoverError]) -> torch.device:
    """Where a policy learns: 'cpu' or 'cuda' as asked for, None for the best there is. Raises `error` for another."""
    there = torch.cuda.is_available()
    if asked not in (None, "cpu", "cuda") or (asked == "cuda" and not there):
        raise error("device must be cpu, or cuda where torch finds one", found=asked, remedy="leave it out")
    return torch.device(asked or ("cuda" if there else "cpu"))

"""Open the checkpoint and the recordings of a run, as every notebook does first.

This module is separate from `run`, so that a kernel does not import what only the execution of notebooks needs.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import torch

from rover_lib.onboard.artifact.manifest import CHUNK, MOST_NAMES, NAME_LENGTH, RATE_HZ, SIDE_PX, is_name
from rover_lib.onboard.errors import CheckpointError, RoverError
from rover_lib.onboard.params import params
from rover_lib.onboard.stage import read_stage
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint, load_checkpoint
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.episodes import Recordings, Split, load_recordings, split
from rover_lib.workshop.recordings.samples import Source
from rover_lib.workshop.run.units import Units, in_todays_units
from rover_lib.workshop.untrusted import quote

SMALL_GMAC = 1.0  # a policy below this gains less from a second thread than the thread costs on a busy machine


@dataclass(frozen=True)
class Opened:
    """What notebook 01 loaded: the checkpoint, the recordings, and which episodes calibrate, choose and judge."""

    checkpoint: Checkpoint
    recordings: Recordings
    parts: Split


def load(
    checkpoint: Path | str,
    episodes: Path | str | Source,
    progress: Progress = silent,
    units: Units | None = None,
    checked: str | None = None,
) -> Opened:
    """Read a checkpoint and its recordings, and split the recordings as params.yml says.

    For a LeRobot policy, the cameras that the policy uses are read from a LeRobotDataset unless the user chose others,
    and the policy gets the dataset's order and rate of numbers. One that was trained on the actions of older firmware
    gets today's units. units: those that an earlier call found, see `in_todays_units`. checked: as of
    `load_checkpoint`. Raises CheckpointError and EpisodeError.
    """
    p = params()["calibration"]
    policy = load_checkpoint(checkpoint, checked)
    check_sizes(policy)  # a sample has as many actions as a plan; with a million, a few frames would fill the memory
    source = Source.of(episodes)
    if policy.format == "lerobot" and not source.cameras:  # the trainer's file does not say what its camera is called
        source = replace(source, cameras=policy.config.cameras)
    recordings = load_recordings(source, policy.config.chunk, p["sync_s"], progress)
    parts = split(recordings, p["held_out_share"], p["seed"])
    recorded = in_todays_units(policy.recorded_as(recordings.layout), recordings, parts.calibration, units)
    _check_limits(recorded)  # after recorded_as, because its rate and names are the recordings'
    return Opened(recorded, recordings, parts)


def _check_limits(policy: Checkpoint) -> None:
    """Raise CheckpointError for a policy that no artifact may hold, before minutes are spent on its calibration."""
    check_sizes(policy)
    c = policy.config
    _within(policy, "steps of a plan in a second", c.rate_hz, RATE_HZ)
    for what, names in (("cameras", c.cameras), ("states", c.state_names), ("actions", c.action_names)):
        for name in names:
            if not is_name(name):
                must = f"{policy.path}: the names of {what} must have 1 to {NAME_LENGTH} characters and no '/'"
                remedy = "give them other names in the dataset's meta/info.json and the policy's config.json"
                raise CheckpointError(must, found=quote(name), remedy=remedy)


def check_sizes(policy: Checkpoint) -> None:
    """Raise CheckpointError for a plan, pictures, or a number of cameras, states or actions that no artifact may have.

    This needs no recordings, so it can be checked before they are read.
    """
    c = policy.config
    _within(policy, "steps in a plan", c.chunk, CHUNK)
    for side in (side for size in c.image_sizes for side in size):
        _within(policy, "pixels a side", side, SIDE_PX)
    for what, names in (("cameras", c.cameras), ("states", c.state_names), ("actions", c.action_names)):
        _within(policy, what, len(names), (1, MOST_NAMES))


def _within(policy: Checkpoint, what: str, value: float, limits: tuple[float, float]) -> None:
    least, most = limits
    if not least <= value <= most:
        must = f"{policy.path}: {what} must be from {least:g} to {most:g}"
        raise CheckpointError(must, found=f"{value:g}", remedy="such a policy cannot be made into an artifact")


def open_run(run_dir: Path | str, progress: Progress = silent) -> Opened:
    """Load again what notebook 01 loaded. Raises RoverError if it did not run, or if the files have changed since.

    For a policy of less than SMALL_GMAC, this sets torch to one thread; a benchmark sets its own number.
    """
    stage = read_stage(Path(run_dir) / "load.json", "load")
    given, loaded = stage["params"], stage["metrics"]["checkpoint"]
    if sum(loaded["macs_by_block"].values()) < SMALL_GMAC * 1e9:
        torch.set_num_threads(1)
    # To find them again would take planning. A run of before they were kept says only in words that there are any.
    units = loaded.get("units") if "units" in loaded.get("normalisation", {}) else {}
    again = load(given["checkpoint"], Source.loaded(given), progress, units, loaded["sha256"])
    now, root = again.checkpoint, again.recordings.root
    layout = stage["metrics"].get("recordings", {}).get("layout")
    words = again.recordings.layout.words()
    what, found = "", None
    if now.sha256 != loaded["sha256"] or now.identity != loaded.get("identity", now.identity):  # older runs lack it
        what = f"{now.path}: is not what notebook 01 loaded any more"
        found = "the same weights, and another config or other statistics" if now.sha256 == loaded["sha256"] else None
    elif layout and layout != words:
        what, found = f"{root}: says something else of its numbers than when notebook 01 loaded it", words
    elif again.parts.episodes != stage["metrics"]["split"]:
        what = f"{root}: has other episodes than notebook 01 loaded"
    if what:
        raise RoverError(what, found=found, remedy="run notebook 01 again")
    return again


def training_device(asked: str | None, error: type[RoverError]) -> torch.device:
    """Return the device to train on.

    asked: "cpu" or "cuda"; None takes cuda if torch finds one, else the CPU. Raises `error` for anything else, and for
    cuda where torch finds none.
    """
    there = torch.cuda.is_available()
    if asked not in (None, "cpu", "cuda") or (asked == "cuda" and not there):
        raise error("device must be cpu, or cuda where torch finds one", found=asked, remedy="leave it out")
    return torch.device(asked or ("cuda" if there else "cpu"))

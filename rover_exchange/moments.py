"""Find the pictures of a recorded drive, and put beside each what the flight log says of its moment.

The pictures come from the episode that the log names (`rover drive --record`). The log has no plans, only what became
of them: a moment has the commands of the next second.
"""

import csv
import math
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from rover_lib.onboard.drive.flight_log import Flight, Tick
from rover_lib.onboard.errors import EpisodeError, RoverError
from rover_lib.onboard.recording.episode import DATA_BYTES
from rover_lib.onboard.stage import plain, read_plain

RECORDED = "recorded: "  # the event that names the episode
PERIOD_MS = 1000 / 30  # between two ticks, if the log does not say
LATE_S = 0.1  # a picture may be this much later than the last tick


@dataclass(frozen=True)
class Moment:
    """One picture of a drive, t_s seconds after it began.

    frame: its file. tick: the tick before it, by the names of Tick; None where nothing was measured. ahead: (n, 2),
    [steering, throttle] of the next second. event: the newest, as text, or "".
    """

    t_s: float
    frame: Path
    tick: dict[str, Any]
    ahead: np.ndarray
    event: str


def moments_of(flight: Flight) -> list[Moment]:
    """Return a moment for each picture of a drive, at least one, in order of time.

    Raises RoverError if nothing was driven or the log's header is damaged, and EpisodeError if there are no pictures of
    this drive.
    """
    ticks = flight.ticks
    t_s = ticks["t_s"]
    period_ms = flight.period_ms or PERIOD_MS
    if not len(t_s):
        raise RoverError(f"{flight.path}: nothing was driven in this drive", remedy="choose another by --drive")
    begin_s = began_s(flight)
    commands = np.stack([ticks["steering"], ticks["throttle"]], axis=1)
    episode = find_recording(flight)
    moments = []
    for at_s, frame in pictures_of(episode):
        now_s = at_s - begin_s
        i = int(np.searchsorted(t_s, now_s, side="right")) - 1
        if i < 0 or now_s > t_s[-1] + LATE_S:
            continue
        tick = plain({name: ticks[name][i] for name in Tick._fields})
        ahead = commands[i : i + round(1000 / period_ms)]
        events = [f"{e.t_s:.1f} s  {e.text}" for e in flight.events if e.t_s <= now_s]
        moments.append(Moment(now_s, frame, tick, ahead, events[-1] if events else ""))
    if not moments:
        raise EpisodeError(f"{episode}: none of its pictures is of the drive in {flight.path}", remedy="choose --drive")
    return moments


def find_recording(flight: Flight) -> Path:
    """Return the folder of the episode recorded with a drive. Raises EpisodeError if there is none, or it is gone."""
    for event in reversed(flight.events):
        if event.text.startswith(RECORDED):
            folder = Path(event.text.removeprefix(RECORDED))
            for path in (folder, flight.path.parent / folder, flight.path.parent / "episodes" / folder.name):
                if path.is_dir():
                    return path
            remedy = f"copy that folder to {flight.path.parent / 'episodes'}"
            raise EpisodeError(f"{folder}: the drive's pictures are not there", remedy=remedy)
    remedy = "`rover drive --record FOLDER` records them"
    raise EpisodeError(f"{flight.path}: no pictures were recorded with this drive", remedy=remedy)


def began_s(flight: Flight) -> float:
    """Return when t_s was 0, in seconds by the system's clock. Raises RoverError if the log's header is damaged."""
    try:
        return datetime.fromisoformat(str(flight.header["start"])).timestamp()
    except (KeyError, ValueError):
        raise RoverError(f"{flight.path}: its start is not known, its header is damaged") from None


def pictures_of(episode: Path) -> list[tuple[float, Path]]:
    """Return when each picture was taken, in seconds by the system's clock, and its file inside the episode, by time.

    Raises EpisodeError if the list of pictures cannot be read.
    """
    try:
        lines = read_plain(episode / "frame_data.csv", DATA_BYTES).decode("utf-8-sig").splitlines()
        rows = [(float(row["timestamp"]), episode / row["image_path"]) for row in csv.DictReader(lines)]
        inside = episode.resolve()
        rows = [(t_s, path) for t_s, path in rows if math.isfinite(t_s) and path.resolve().is_relative_to(inside)]
    except (OSError, KeyError, ValueError, TypeError, csv.Error) as error:  # ValueError: also a zero byte in a path
        raise EpisodeError(f"{episode}: its list of pictures cannot be read ({error})") from None
    return sorted(rows)

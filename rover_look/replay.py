"""Replay a recorded drive as a view shows a live one: its pictures, each with what the flight log says of that moment.

    for moment in load_replay("flight.log").moments:
        moment.head                # a message as feed.py makes them
        moment.frame_bgr()

The flight log has no pictures. They come from the episode that was recorded with the drive (`rover drive --record`),
which the log names. It has no plans either, only what became of them: "plan" is what was commanded in the next second.
"""

import asyncio
import csv
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.picture import PictureError, read_jpeg
from rover_lib.onboard.car.servo_link import REASONS
from rover_lib.onboard.drive.flight_log import Flight, LogError, Tick, read_log
from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.kinds import kinds_of
from rover_lib.onboard.recording.episode import DATA_BYTES
from rover_lib.onboard.stage import read_plain
from rover_lib.workshop.recordings.episodes import load_recordings

if TYPE_CHECKING:
    from rover_lib.onboard.view.server import View

RECORDED = "recorded: "  # the event that names the episode
AHEAD = "ahead: where the commands of the next second led"
EVENTS = 8  # at most this many are shown
AGAIN_S = 3.0  # between two showings
LATEST = 100  # ticks: the rate and the largest lateness are those of the last 100
PAGE_HZ = 10.0


@dataclass(frozen=True)
class Moment:
    """One picture of a drive.

    t_s: seconds since the first moment. head: a message as feed.py makes them, whose times are seconds since the drive
    began. frame: the picture's file.
    """

    t_s: float
    head: dict[str, Any]
    frame: Path

    def frame_bgr(self) -> np.ndarray | None:
        """Read the picture, (h, w, 3) uint8 BGR; None if it is damaged or gone."""
        try:
            return read_jpeg(self.frame)
        except (OSError, PictureError):
            return None


@dataclass(frozen=True)
class Replay:
    """A recorded drive. car: the car that was driven. moments: at least one; one for each picture, in order of time."""

    car: Car
    moments: list[Moment]

    async def show(self, view: "View") -> None:
        """Show the drive in a view at its own pace, again and again. It never returns."""
        while True:
            begin_s, next_s = time.monotonic(), 0.0
            for moment in self.moments:
                if moment.t_s < next_s:
                    continue
                next_s = moment.t_s + 0.9 / PAGE_HZ
                await asyncio.sleep(max(0.0, begin_s + moment.t_s - time.monotonic()))
                image = moment.frame_bgr()
                head = dict(moment.head)
                jpeg = b""
                if image is not None:
                    head["size"] = [image.shape[1], image.shape[0]]
                    jpeg = cv2.imencode(".jpg", image)[1].tobytes()
                view.show(head, jpeg)
            await asyncio.sleep(AGAIN_S)


def load_replay(file: Path | str, drive: int = -1, pictures: Path | None = None) -> Replay:
    """Load the replay of a flight log, or of a recording alone; from a folder of several episodes, of the first.

    drive: which drive of a log, the last by default. pictures: the episode that was recorded with it; None takes the
    one that the log names. Raises LogError; EpisodeError if there are no pictures; CarError if the file's description
    of its car is not valid.
    """
    file = Path(file)
    if "flight log" not in kinds_of(file):
        return _of_recording(file)
    flight = read_log(file, drive)
    return Replay(flight.car, _of_flight(flight, pictures or find_recording(flight)))


def find_recording(flight: Flight) -> Path:
    """Return the folder of the episode recorded with a drive. Raises EpisodeError if there is none, or it is gone."""
    for event in reversed(flight.events):
        if event.text.startswith(RECORDED):
            named = Path(event.text.removeprefix(RECORDED))
            for path in (named, flight.path.parent / named, flight.path.parent / "episodes" / named.name):
                if path.is_dir():
                    return path
            raise EpisodeError(f"{named}: the drive's pictures are not there", remedy="name them by --pictures")
    raise EpisodeError(
        f"{flight.path}: no pictures were recorded with this drive",
        remedy="`rover drive --record FOLDER` records them; those of elsewhere are named by --pictures",
    )


def began_s(flight: Flight) -> float:
    """Return when t_s was 0, in seconds by the system's clock. Raises LogError if the log's header is damaged."""
    try:
        return datetime.fromisoformat(str(flight.header["start"])).timestamp()
    except (KeyError, ValueError):
        raise LogError(f"{flight.path}: when it began is not known, its header is damaged") from None


def _of_flight(flight: Flight, episode: Path) -> list[Moment]:
    ticks = flight.ticks
    t_s = ticks["t_s"]
    if not len(t_s):
        raise LogError(f"{flight.path}: nothing was driven in this drive", remedy="choose another by --drive")
    begin_s = began_s(flight)
    period_ms, late_ms = flight.period_ms or 1000 / 30, ticks["late_ms"]
    gaps = np.rint(np.diff(t_s * 1000 - late_ms) / period_ms) - 1
    missed = np.concatenate([[0], np.cumsum(gaps.clip(0))])
    commanded = np.stack([ticks["steering"], ticks["throttle"]], axis=1)
    title = Path(str(flight.header.get("drive", {}).get("artifact", ""))).name or flight.path.name
    found = []
    for at_s, frame in pictures_of(episode):
        i = int(np.searchsorted(t_s, at_s - begin_s, side="right")) - 1
        now_s = at_s - begin_s
        if i < 0 or now_s > t_s[-1] + 0.1:
            continue
        row = [_plain(ticks[name][i]) for name in Tick._fields]
        tick = Tick(*row)
        first = max(0, i - LATEST + 1)
        before = [m for m in range(len(flight.machine["t_s"])) if flight.machine["t_s"][m] <= now_s]
        events = [e for e in flight.events if e.t_s <= now_s][-EVENTS:]
        head = {
            **_head(title, now_s, commanded[i:].tolist(), 1000 / period_ms),
            "tick": tick._asdict(),
            "who": tick.state,
            "why": REASONS.get(tick.reason, ""),
            "pins": [tick.pins_steering_us, tick.pins_throttle_us],
            "missed": int(missed[i]),
            "hz": (i - first) / (t_s[i] - t_s[first]) if i > first else None,
            "late_most_ms": float(late_ms[first : i + 1].max()),
            "events": [[e.t_s, str(e)[:200]] for e in events],
        }
        if before:
            machine = flight.machine
            head["machine"] = {
                "temperature_c": _plain(machine["temperature_c"][before[-1]]),
                "throttled": machine["throttled"][before[-1]],
            }
        found.append(Moment(now_s, head, frame))
    if not found:
        raise EpisodeError(f"{episode}: none of its pictures is of the drive in {flight.path}", remedy="choose --drive")
    return [Moment(m.t_s - found[0].t_s, m.head, m.frame) for m in found]


def _of_recording(folder: Path) -> Replay:
    episode = load_recordings(folder).episodes[0]
    car, found = episode.samples[0].car, []
    for number, sample in enumerate(episode.samples, 1):
        steering, throttle = (float(v) for v in sample.chunk[0])
        pulses = car.pwm.pulses(*(float(v) for v in np.clip([steering, throttle], *car.limits)))
        tick = dict.fromkeys(Tick._fields) | {"t_s": sample.time_s, "steering": steering, "throttle": throttle}
        tick |= {"frame": number, "plan": 0, "fade": 1.0}
        ahead = sample.chunk[~sample.is_pad].tolist()
        head = _head(episode.id, sample.time_s, ahead, 30.0) | {"tick": tick}
        head["pins"] = [pulses.steering_us, pulses.throttle_us]
        found.append(Moment(sample.time_s - episode.samples[0].time_s, head, sample.frame_path))
    return Replay(car, found)


def _head(title: str, now_s: float, ahead: Sequence[Sequence[float]], rate_hz: float) -> dict[str, Any]:
    plan = {"captured_s": now_s, "rate_hz": rate_hz, "actions": ahead[: round(rate_hz)]}
    return {"phase": "replay", "text": AHEAD, "title": title, "sent_s": now_s, "who": "", "why": "", "missing": "",
            "machine": {}, "events": [], "hz": None, "late_most_ms": None, "missed": 0, "plan": plan}  # fmt: skip


def pictures_of(episode: Path) -> list[tuple[float, Path]]:
    """Return when each picture of an episode was taken, in seconds by the system's clock, and its file, in that order.

    A file outside the episode's folder, and a picture without a finite time, are left out. Raises EpisodeError if the
    list of pictures cannot be read.
    """
    try:
        lines = read_plain(episode / "frame_data.csv", DATA_BYTES).decode("utf-8-sig").splitlines()
        rows = [(float(row["timestamp"]), episode / row["image_path"]) for row in csv.DictReader(lines)]
        inside = episode.resolve()
        rows = [(t_s, path) for t_s, path in rows if math.isfinite(t_s) and path.resolve().is_relative_to(inside)]
    except (OSError, KeyError, ValueError, TypeError, csv.Error) as error:  # ValueError: also a zero byte in a path
        raise EpisodeError(f"{episode}: its list of pictures cannot be read ({error})") from None
    return sorted(rows)


def _plain(value: Any) -> Any:
    """Return a value of the log as JSON has it: a number that is not known (NaN) as None, a text as str."""
    if isinstance(value, str):
        return str(value)
    value = float(value)
    return None if np.isnan(value) else int(value) if value.is_integer() else value

"""Write a flight log as MCAP, the file format of Foxglove and Rerun: `rover log FILE --mcap out.mcap`.

    counts = write_mcap(Path("out.mcap"), read_log("flight.log"))

Every message is JSON, and its schema is in the file. A message's time is what the system's clock showed when it
happened. If an episode was recorded with the drive, the file also has its pictures and controls, by the same clock; the
controls continue after a takeover, when the log's ticks do not. A picture is Foxglove's CompressedImage, an event its
Log.
"""

import base64
import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from rover_lib.onboard.car.picture import PictureError, read_jpeg
from rover_lib.onboard.drive.flight_log import Flight, Tick
from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.recording.episode import CONTROL_FIELDS, DRIVERS, json_controls, number_of
from rover_lib.onboard.stage import atomic_path, plain
from rover_look.replay import began_s, find_recording, pictures_of

TICK, EVENT, MACHINE, CONTROL, PICTURE = TOPICS = ("/tick", "/event", "/machine", "/control", "/camera")
INFO = 2  # a level of foxglove.Log
MOST_S = 1.8e10  # the latest time: MCAP counts nanoseconds in 64 bits
_NUMBER = {"type": ["number", "null"]}
_TEXT = {"type": ["string", "null"]}
_TIME = {"type": "object", "title": "time", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


_TICK_TEXTS = ("state", "reason")
SCHEMAS = {  # by topic: the schema's name, and the schema
    TICK: ("rover.Tick", _object(**{name: _TEXT if name in _TICK_TEXTS else _NUMBER for name in Tick._fields})),
    EVENT: (
        "foxglove.Log",
        _object(timestamp=_TIME, level={"type": "integer"}, message={"type": "string"}, name={"type": "string"},
                file={"type": "string"}, line={"type": "integer"}),
    ),
    MACHINE: ("rover.Machine", _object(temperature_c=_NUMBER, throttled=_TEXT)),
    CONTROL: ("rover.Control", _object(**dict.fromkeys(CONTROL_FIELDS, _NUMBER), driver={"enum": [*DRIVERS, None]})),
    PICTURE: (
        "foxglove.CompressedImage",
        _object(timestamp=_TIME, frame_id={"type": "string"}, format={"type": "string"},
                data={"type": "string", "contentEncoding": "base64"}),
    ),
}  # fmt: skip


class _Message(NamedTuple):
    """at_ns: nanoseconds by the system's clock. content: the message, or for a picture its file."""

    at_ns: int
    topic: str
    content: dict[str, Any] | Path


def write_mcap(path: Path, flight: Flight, episode: Path | None = None) -> dict[str, int]:
    """Write a drive as MCAP, in order of time, and return how many messages each topic has, without the empty ones.

    episode: the one that was recorded with the drive; None takes the one that the log names, if it is there. A picture
    that is damaged is left out. Raises LogError if the log does not say when it began, and EpisodeError if the
    episode's list of pictures cannot be read.
    """
    from mcap.writer import Writer  # imported here, so that only this export needs it

    messages = list(_of_flight(flight))
    if episode is None:
        try:
            episode = find_recording(flight)
        except EpisodeError:
            episode = None
    if episode is not None:
        messages += _of_episode(episode)
    messages.sort(key=lambda message: message.at_ns)
    counts: Counter[str] = Counter()
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        writer = Writer(file)
        writer.start(library="rover")
        channels = {}
        for topic in TOPICS:
            if any(message.topic == topic for message in messages):
                name, schema = SCHEMAS[topic]
                number = writer.register_schema(name, "jsonschema", json.dumps(schema).encode())
                channels[topic] = writer.register_channel(topic, "json", number)
        header = {key: json.dumps(plain(value)) for key, value in flight.header.items()}
        writer.add_metadata("flight log", header)
        for at_ns, topic, content in messages:
            row = _picture(at_ns, content) if isinstance(content, Path) else content
            if row is not None:
                data = json.dumps(row, allow_nan=False).encode()
                writer.add_message(channels[topic], at_ns, data, at_ns, sequence=counts[topic])
                counts[topic] += 1
        writer.finish()
    return {topic.removeprefix("/"): counts[topic] for topic in TOPICS if counts[topic]}


def _of_flight(flight: Flight) -> Iterator[_Message]:
    begin_s = began_s(flight)
    ticks, machine = flight.ticks, flight.machine
    for i, t_s in enumerate(ticks["t_s"].tolist()):
        row = plain({name: str(ticks[name][i]) if name in _TICK_TEXTS else ticks[name][i] for name in Tick._fields})
        yield _Message(_ns(begin_s + t_s), TICK, row)
    for event in flight.events:
        at_ns = _ns(begin_s + event.t_s)
        yield _Message(at_ns, EVENT, {"timestamp": _time(at_ns), "level": INFO, "message": str(event), "name": "rover",
                                      "file": "", "line": 0})  # fmt: skip
    for i, t_s in enumerate(machine["t_s"].tolist()):
        row = plain({"temperature_c": machine["temperature_c"][i], "throttled": machine["throttled"][i]})
        yield _Message(_ns(begin_s + t_s), MACHINE, row)


def _of_episode(episode: Path) -> Iterator[_Message]:
    for at_s, picture in pictures_of(episode):
        if 0 <= at_s < MOST_S:
            yield _Message(_ns(at_s), PICTURE, picture)
    for row in json_controls(episode / "episode_data.json"):
        control_s = number_of(row.get("system_timestamp"))
        if control_s is not None and 0 <= control_s < MOST_S:  # not NaN either
            yield _Message(_ns(control_s), CONTROL, plain(row))


def _picture(at_ns: int, file: Path) -> dict[str, Any] | None:
    """Return the message with a picture, whose JPEG is as recorded; None if it is damaged or gone."""
    try:
        read_jpeg(file)
        data = file.read_bytes()
    except (OSError, PictureError):
        return None
    return {"timestamp": _time(at_ns), "frame_id": "camera", "format": "jpeg", "data": base64.b64encode(data).decode()}


def _ns(at_s: float) -> int:
    return round(at_s * 1e6) * 1000  # to the microsecond: a float of today's seconds is no more precise


def _time(at_ns: int) -> dict[str, int]:
    return {"sec": at_ns // 10**9, "nsec": at_ns % 10**9}

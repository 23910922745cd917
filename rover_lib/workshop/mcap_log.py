"""A flight log as MCAP, the file of Foxglove and Rerun: `rover log FILE --mcap out.mcap`.

    counts = write_mcap(Path("out.mcap"), read_log("flight.log"))

Every message is JSON with its schema in the file. Its time is the system's clock at which it happened, by which the
pictures of the drive's episode are there too, and its controls, which go on after a takeover when the log's ticks do
not. A picture is Foxglove's CompressedImage, an event its Log.
"""

import base64
import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.picture import PictureError, read_jpeg
from rover_lib.onboard.recording import CONTROL_FIELDS, DRIVERS, json_controls, number_of
from rover_lib.onboard.stage import atomic_path, plain
from rover_lib.onboard.telemetry import Flight, Tick
from rover_lib.workshop.replay import began_s, pictures_of, recorded_with

TICK, EVENT, MACHINE, CONTROL, PICTURE = TOPICS = ("/tick", "/event", "/machine", "/control", "/camera")
INFO = 2  # a level of foxglove.Log
MOST_S = 1.8e10  # of a time, which has 64 bits of nanoseconds
_NUMBER = {"type": ["number", "null"]}
_TEXT = {"type": ["string", "null"]}
_TIME = {"type": "object", "title": "time", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}


def _object(**properties: Any) -> dict[str, Any]:
    return {"type": "object", "properties": properties}


_TICK_TEXTS = ("state", "reason")
SCHEMAS = {  # by topic: its name, and what a message is
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
    """When, in nanoseconds of the system's clock; on which topic; what, or of a picture its file."""

    at_ns: int
    topic: str
    content: dict[str, Any] | Path


def write_mcap(path: Path, flight: Flight, episode: Path | None = None) -> dict[str, int]:
    """Writes a drive as MCAP, in order of time; how many messages of each topic.

    episode: that was recorded with it; None: the one that the log names, where it is there. A picture that is not whole
    is left out. Raises LogError for a log whose beginning is not known, EpisodeError for a named episode without a list
    of pictures.
    """
    from mcap.writer import Writer  # here, so that only this export needs it

    messages = list(_of_flight(flight))
    if episode is None:
        try:
            episode = recorded_with(flight)
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
    """As recorded; None where it is damaged or gone."""
    try:
        read_jpeg(file)
        data = file.read_bytes()
    except (OSError, PictureError):
        return None
    return {"timestamp": _time(at_ns), "frame_id": "camera", "format": "jpeg", "data": base64.b64encode(data).decode()}


def _ns(at_s: float) -> int:
    return round(at_s * 1e6) * 1000  # a float of today's seconds has no nanoseconds


def _time(at_ns: int) -> dict[str, int]:
    return {"sec": at_ns // 10**9, "nsec": at_ns % 10**9}

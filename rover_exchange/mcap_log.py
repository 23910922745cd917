"""Write a flight log as MCAP, the file format of Foxglove and Rerun: `rover log FILE --mcap out.mcap`.

Every message is JSON, with its schema, at the time that the system's clock showed. If an episode was recorded with the
drive, the file has its pictures too, which continue after a takeover.
"""

import base64
import json
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rover_exchange.moments import began_s, find_recording, pictures_of
from rover_lib.onboard.car.picture import read_jpeg
from rover_lib.onboard.drive.flight_log import Flight, Tick
from rover_lib.onboard.errors import CameraError, EpisodeError
from rover_lib.onboard.stage import atomic_path, plain

TICK, EVENT, MACHINE, PICTURE = TOPICS = ("/tick", "/event", "/machine", "/camera")
INFO = 2  # a level of foxglove.Log
MOST_S = 1.8e10  # the latest time: MCAP counts nanoseconds in 64 bits
TICK_TEXTS = ("state", "reason")
_NUMBER = {"type": ["number", "null"]}
_TEXT = {"type": ["string", "null"]}
_WORD, _WHOLE = {"type": "string"}, {"type": "integer"}
_TIME = {"type": "object", "title": "time", "properties": {"sec": _WHOLE, "nsec": _WHOLE}}
_LOG = {"timestamp": _TIME, "level": _WHOLE, "message": _WORD, "name": _WORD, "file": _WORD, "line": _WHOLE}
_IMAGE = {"timestamp": _TIME, "frame_id": _WORD, "format": _WORD, "data": {**_WORD, "contentEncoding": "base64"}}
SCHEMAS = {  # by topic: the schema's name, and its properties
    TICK: ("rover.Tick", {name: _TEXT if name in TICK_TEXTS else _NUMBER for name in Tick._fields}),
    EVENT: ("foxglove.Log", _LOG),
    MACHINE: ("rover.Machine", {"temperature_c": _NUMBER, "throttled": _TEXT}),
    PICTURE: ("foxglove.CompressedImage", _IMAGE),
}

Message = tuple[int, str, dict[str, Any] | Path]  # nanoseconds by the system's clock, topic, content or picture's file


def write_mcap(path: Path, flight: Flight) -> dict[str, int]:
    """Write a drive as MCAP, in order of time, and return how many messages each topic has, without the empty ones.

    Raises RoverError if the log does not say when it began, and EpisodeError if the list of the pictures recorded with
    it cannot be read.
    """
    from mcap.writer import Writer  # imported here, so that only this export needs it

    messages = [*_of_flight(flight), *_pictures_with(flight)]
    messages.sort(key=lambda message: message[0])
    counts: Counter[str] = Counter()
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        writer = Writer(file)
        writer.start(library="rover")
        channels = {}
        for topic in sorted({topic for _, topic, _ in messages}, key=TOPICS.index):
            name, properties = SCHEMAS[topic]
            schema = json.dumps({"type": "object", "properties": properties}).encode()
            channels[topic] = writer.register_channel(topic, "json", writer.register_schema(name, "jsonschema", schema))
        header = {key: json.dumps(plain(value)) for key, value in flight.header.items()}
        writer.add_metadata("flight log", header)
        for at_ns, topic, content in messages:
            row = _image(at_ns, content) if isinstance(content, Path) else content
            if row is not None:
                data = json.dumps(row, allow_nan=False).encode()
                writer.add_message(channels[topic], at_ns, data, at_ns, sequence=counts[topic])
                counts[topic] += 1
        writer.finish()
    return {topic.removeprefix("/"): counts[topic] for topic in TOPICS if counts[topic]}


def _of_flight(flight: Flight) -> Iterator[Message]:
    begin_s = began_s(flight)
    ticks, machine = flight.ticks, flight.machine
    for i, t_s in enumerate(ticks["t_s"].tolist()):
        yield _ns(begin_s + t_s), TICK, plain({name: ticks[name][i] for name in Tick._fields})
    for event in flight.events:
        at_ns = _ns(begin_s + event.t_s)
        row = {"timestamp": _time(at_ns), "level": INFO, "message": event.text, "name": "rover", "file": "", "line": 0}
        yield at_ns, EVENT, row
    for i, t_s in enumerate(machine["t_s"].tolist()):
        yield _ns(begin_s + t_s), MACHINE, plain({name: machine[name][i] for name in ("temperature_c", "throttled")})


def _pictures_with(flight: Flight) -> Iterator[Message]:
    try:
        episode = find_recording(flight)
    except EpisodeError:
        return
    for at_s, picture in pictures_of(episode):
        if 0 <= at_s < MOST_S:
            yield _ns(at_s), PICTURE, picture


def _image(at_ns: int, file: Path) -> dict[str, Any] | None:
    """Return the message with a picture, whose JPEG is as recorded; None if it is damaged or gone."""
    try:
        read_jpeg(file)
        data = file.read_bytes()
    except (OSError, CameraError):
        return None
    return {"timestamp": _time(at_ns), "frame_id": "camera", "format": "jpeg", "data": base64.b64encode(data).decode()}


def _ns(at_s: float) -> int:
    return round(at_s * 1e6) * 1000  # to the microsecond: a float of today's seconds is no more precise


def _time(at_ns: int) -> dict[str, int]:
    return {"sec": at_ns // 10**9, "nsec": at_ns % 10**9}

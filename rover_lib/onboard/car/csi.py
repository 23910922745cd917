"""Read a Raspberry Pi camera (CSI) through rpicam-vid of Raspberry Pi OS, which sets exposure and colours by libcamera.

rpicam-vid writes JPEGs to its standard output and, after each, what libcamera knows of it to a pipe: lines NAME=VALUE,
then an empty one (rpicam-apps: output/output.cpp). So the nth picture has the nth time stamp, nanoseconds since boot.
"""

import contextlib
import os
import re
import select
import subprocess
import tempfile
import threading
from collections.abc import Generator

from rover_lib.onboard.car.picture import MOST_BYTES
from rover_lib.onboard.errors import CameraError

PROGRAM = "rpicam-vid"
SOURCE = re.compile(r"csi(?::(\d))?((?:,[a-z]+=[\w.-]+)*)", re.ASCII)  # csi, csi:1, csi,shutter=8000,gain=4
SETTINGS = ("shutter", "gain", "ev", "exposure", "awb", "rotation")  # options of rpicam-vid; shutter in microseconds
DEFAULTS = {"exposure": "sport"}  # a short one: a car that moves blurs a long one
QUALITY = 90  # of the JPEGs, in percent; rpicam-vid's own default is 50
START, END = b"\xff\xd8\xff", b"\xff\xd9"  # of a JPEG; its data contains neither: there 00 follows each FF
STAMP = re.compile(rb"^SensorTimestamp=(\d+)$", re.M)
END_S = 1.0


def is_csi(source: str) -> bool:
    """Whether a camera's name means a Raspberry Pi camera."""
    return source == "csi" or source.startswith(("csi:", "csi,"))


def command(source: str, size: tuple[int, int], rate_hz: float, metadata: str) -> list[str]:
    """Return rpicam-vid's command line. size: (width, height). Raises CameraError for another source."""
    found = SOURCE.fullmatch(source)
    given = dict(setting.split("=") for setting in (found[2] if found else "").split(",")[1:])
    if not found or set(given) - set(SETTINGS):
        remedy = f"csi, csi:1, or csi,NAME=VALUE with {', '.join(SETTINGS)}"
        raise CameraError(f"{source}: not understood", remedy=remedy)
    options: dict[str, object] = {"camera": found[1] or 0, "width": size[0], "height": size[1], "framerate": rate_hz}
    options |= {"timeout": 0, "codec": "mjpeg", "quality": QUALITY, "output": "-", "verbose": 0}
    options |= {"metadata": metadata, "metadata-format": "txt", **DEFAULTS, **given}
    return [PROGRAM, "--nopreview", "--flush", *(f"--{name}={value}" for name, value in options.items())]


def read_csi(
    source: str, size: tuple[int, int], rate_hz: float, closing: threading.Event
) -> Generator[tuple[bytes, float | None], None, None]:
    """Yield the newest JPEG and its time stamp (s). Raises CameraError without the program, or once it ends."""
    reading, writing = os.pipe()
    with tempfile.TemporaryFile() as errors, contextlib.ExitStack() as leaving:
        leaving.callback(os.close, reading)
        leaving.callback(os.close, writing)
        line = command(source, size, rate_hz, f"/proc/self/fd/{writing}")
        none, pipe = subprocess.DEVNULL, subprocess.PIPE
        try:
            process = subprocess.Popen(line, stdin=none, stdout=pipe, stderr=errors, pass_fds=[writing])
        except OSError as error:
            remedy = "sudo apt-get install rpicam-apps-lite, on Raspberry Pi OS; is the cable in?"
            raise CameraError(f"{source}: {PROGRAM} cannot be started ({error.strerror})", remedy=remedy) from None
        leaving.enter_context(process)
        leaving.callback(process.kill)
        assert process.stdout
        yield from _pairs(process.stdout.fileno(), reading, closing)
        if not closing.is_set():
            code = process.wait(END_S)
            errors.seek(0)
            said = errors.read()[-200:].decode(errors="replace").strip().split("\n")[-1] or f"its status is {code}"
            remedy = "`rpicam-hello --list-cameras` shows what is there"
            raise CameraError(f"{source}: {PROGRAM} has ended: {said}", remedy=remedy)


def _pairs(pictures: int, entries: int, closing: threading.Event) -> Generator[tuple[bytes, float | None], None, None]:
    """Yield (JPEG, time stamp) of two streams until the first ends; of several that wait, the newest."""
    pending, text = bytearray(), b""
    begun, stamps = 0, 0  # how many of each have come
    waiting: dict[int, bytes] = {}  # by its number, the newest JPEG whose entry has not come yet
    known: dict[int, float | None] = {}
    while not closing.is_set():
        ready = select.select([pictures, entries], [], [], 0.05)[0]
        if entries in ready:
            *whole, text = (text + os.read(entries, 1 << 16)).split(b"\n\n")
            for entry in whole:
                stamps += 1
                stamp = STAMP.search(entry)
                known = {stamps - 1: known.get(stamps - 1), stamps: int(stamp[1]) / 1e9 if stamp else None}
        if pictures in ready:
            if not (data := os.read(pictures, 1 << 20)):
                return
            pending += data
            jpeg, count = newest_jpeg(pending)
            begun += count
            if jpeg:
                waiting = {begun: jpeg}
        for number in [n for n in waiting if n <= stamps]:
            yield waiting.pop(number), known.get(number)


def newest_jpeg(pending: bytearray) -> tuple[bytes, int]:
    """Cut the JPEGs from a stream's bytes. Return the last whole one, or b"", and how many had begun, the cut included.

    Raises CameraError if there is no JPEG's end in many bytes.
    """
    jpeg, begun = b"", 0
    while (end := pending.find(END)) >= 0:
        begun += pending.count(START, 0, end)
        if (start := pending.find(START, 0, end)) >= 0:
            jpeg = bytes(pending[start : end + 2])
        del pending[: end + 2]
    if len(pending) > MOST_BYTES:
        raise CameraError(f"no JPEG in {MOST_BYTES / 1e6:g} MB of the stream", remedy="write JPEGs one after another")
    return jpeg, begun

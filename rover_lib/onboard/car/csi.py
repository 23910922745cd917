"""Read JPEGs from a stream, and from a Raspberry Pi camera (CSI) through rpicam-vid of Raspberry Pi OS.

rpicam-vid sets exposure and colours by libcamera, and writes JPEGs to its standard output.
"""

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
END_S = 1.0

Jpegs = Generator[tuple[bytes, None], None, None]


def command(source: str, size: tuple[int, int], rate_hz: float) -> list[str]:
    """Return rpicam-vid's command line. size: (width, height). Raises CameraError for another source."""
    match = SOURCE.fullmatch(source)
    settings = dict(setting.split("=") for setting in (match[2] if match else "").split(",")[1:])
    if not match or set(settings) - set(SETTINGS):
        remedy = f"csi, csi:1, or csi,NAME=VALUE with {', '.join(SETTINGS)}"
        raise CameraError(f"{source}: not understood", remedy=remedy)
    options: dict[str, object] = {"camera": match[1] or 0, "width": size[0], "height": size[1], "framerate": rate_hz}
    options |= {"timeout": 0, "codec": "mjpeg", "quality": QUALITY, "output": "-", "verbose": 0, **DEFAULTS, **settings}
    return [PROGRAM, "--nopreview", "--flush", *(f"--{name}={value}" for name, value in options.items())]


def read_csi(source: str, size: tuple[int, int], rate_hz: float, closing: threading.Event) -> Jpegs:
    """Yield the newest JPEG. Raises CameraError without the program, or once it ends."""
    line = command(source, size, rate_hz)
    with tempfile.TemporaryFile() as errors:
        try:
            process = subprocess.Popen(line, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=errors)
        except OSError as error:
            remedy = "sudo apt-get install rpicam-apps-lite, on Raspberry Pi OS; is the cable in?"
            raise CameraError(f"{source}: {PROGRAM} cannot be started ({error.strerror})", remedy=remedy) from None
        with process:
            assert process.stdout
            try:
                yield from newest_jpegs(process.stdout.fileno(), closing)
                if closing.is_set():
                    return
                code = process.wait(END_S)
            finally:
                process.kill()
        errors.seek(0)
        message = errors.read()[-200:].decode(errors="replace").strip().split("\n")[-1] or f"its status is {code}"
        remedy = "`rpicam-hello --list-cameras` shows what is there"
        raise CameraError(f"{source}: {PROGRAM} has ended: {message}", remedy=remedy)


def newest_jpegs(fd: int, closing: threading.Event) -> Jpegs:
    """Yield the JPEGs of a stream until it ends; of several that wait in it, only the last. They have no time stamp.

    Raises CameraError if there is no JPEG's end in many bytes.
    """
    pending = bytearray()
    while not closing.is_set():
        if not select.select([fd], [], [], 0.05)[0]:  # as long as nobody has opened a FIFO for writing, too
            continue
        if not (data := os.read(fd, 1 << 20)):
            return
        pending += data
        if jpeg := cut_newest(pending):
            yield jpeg, None
        if len(pending) > MOST_BYTES:
            remedy = "write JPEGs one after another"
            raise CameraError(f"no JPEG in {MOST_BYTES / 1e6:g} MB of the stream", remedy=remedy)


def cut_newest(pending: bytearray) -> bytes:
    """Cut the whole JPEGs, and what is before them, from a stream's bytes. Return the last one, or b""."""
    jpeg = b""
    while (end := pending.find(END)) >= 0:
        if (start := pending.find(START, 0, end)) >= 0:
            jpeg = bytes(pending[start : end + 2])
        del pending[: end + 2]
    return jpeg

"""Pictures that no camera sends, small enough to make in a test."""

import io
import os
import resource
import signal
import struct
from pathlib import Path

import cv2
import numpy as np
import torch
from PIL import Image

from rover_lib.onboard.errors import RoverError


def scene(seed=0, size=(640, 360)) -> np.ndarray:
    """Return a picture with something on it, (height, width, 3) uint8."""
    width, height = size
    coarse = np.random.default_rng(seed).integers(20, 235, (9, 16, 3), np.uint8)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)


def jpeg(image, quality=90, *more) -> bytes:
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality, *more])[1].tobytes()


def cut(data, share=2 / 3) -> bytes:
    """Return the first part of a JPEG, closed with an end marker, so that OpenCV and Pillow take it for a picture."""
    return data[: int(len(data) * share)] + b"\xff\xd9"


def claims(data, width, height) -> bytes:
    """Return the same JPEG under a header that claims another size."""
    at = next(data.find(marker) for marker in (b"\xff\xc0", b"\xff\xc2") if marker in data)
    return data[: at + 5] + struct.pack(">HH", height, width) + data[at + 9 :]


def grey(size) -> bytes:
    """Return the complete JPEG of a grey picture of size x size pixels, without making the picture.

    Each of its blocks of 8x8 pixels is the bits 001010, so that four blocks are three bytes.
    """
    small = jpeg(np.full((8, 8), 128, np.uint8))
    header = claims(small, size, size)[: small.index(b"\xff\xda") + 10]
    return header + b"\x28\xa2\x8a" * (size * size // 64 // 4) + b"\xff\xd9"


def progressive(image, last_scans=1) -> bytes:
    """Return a progressive JPEG in which the last scan is repeated `last_scans` times."""
    out = io.BytesIO()
    Image.fromarray(image).save(out, "JPEG", progressive=True)
    data = out.getvalue()
    last = data.rindex(b"\xff\xda")
    return data[:last] + data[last:-2] * last_scans + b"\xff\xd9"


WHOLE = jpeg(scene())
RESTARTS = jpeg(scene(), 90, cv2.IMWRITE_JPEG_RST_INTERVAL, 4)
SCAN = WHOLE.index(b"\xff\xda") + 14  # where the compressed pixels begin

HOSTILE = {
    "nothing": b"",
    "noise": np.random.default_rng(1).bytes(50_000),
    "a PNG": cv2.imencode(".png", scene(size=(64, 36)))[1].tobytes(),
    "a header with an end": WHOLE[:SCAN] + b"\xff\xd9",
    "cut to two thirds, with an end": cut(WHOLE),
    "cut, with restart markers": cut(RESTARTS),
    "a piece missing, with restart markers": RESTARTS[: len(RESTARTS) // 3] + RESTARTS[2 * len(RESTARTS) // 3 :],
    "its tables gone": WHOLE[:2] + WHOLE[WHOLE.index(b"\xff\xc0") :],
    "no pixels": claims(WHOLE, 0, 360),
    "wider than it is": claims(WHOLE, 4000, 360),
    "a bomb of 65,000 x 65,000, in its header": claims(WHOLE, 65_000, 65_000),
    "a bomb of 16,000 x 16,000, whole": grey(16_000),
    "20,000 scans": progressive(scene(size=(64, 36)), 20_000),
    "9 MB": WHOLE[:-2] + bytes(9_000_000) + b"\xff\xd9",
}


def outcome_of(read, path: Path, most_s=10, most_bytes=500_000_000) -> str:
    """What a reader says of a file, in a child that may take this much more: its sentence, or what it did instead."""
    out, into = os.pipe()
    if not (child := os.fork()):
        said = "nothing"
        try:
            # Its own time counts: a fork of this process, which may have gigabytes, waits for the kernel to copy them.
            signal.setitimer(signal.ITIMER_VIRTUAL, most_s)
            signal.alarm(6 * most_s)
            torch.set_num_threads(1)  # a fork has none of the threads that OpenMP began before, and would wait
            now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (now + most_bytes,) * 2)
            said = f"returned {str(read(path))[:100]}"
        except RoverError as error:
            said = f"said {error}"
        except BaseException as error:
            said = f"raised {type(error).__name__}"
        finally:
            os.write(into, said.encode()[:4000])
            os._exit(0)
    os.close(into)
    with os.fdopen(out) as file:
        said = file.read()
    os.waitpid(child, 0)
    return said or f"went on for {most_s} s"

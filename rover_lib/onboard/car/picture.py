"""Check a picture from an untrusted source: the cost of decoding it, whether it is complete, and what it shows.

OpenCV and Pillow decode a JPEG that was cut short and closed with an end marker, and only print a warning. simplejpeg
reports the first warning, is as fast, and gives the same bits.
"""

import math
import re
import struct
from pathlib import Path

import cv2
import numpy as np
import simplejpeg

from rover_lib.onboard.errors import CameraError
from rover_lib.onboard.stage import open_plain

MOST_BYTES = 8_000_000  # of a JPEG
MOST_PIXELS = 3840 * 2160  # 25 MB decoded
MOST_SCANS = 32  # a progressive JPEG has about ten, and each costs as much as a whole plain JPEG
FILLED_MOST = 4  # bytes that some webcams put before a marker; many more mean that a piece is missing
BASELINE, SCAN, RESTART_INTERVAL = 0xC0, 0xDA, 0xDD  # markers
SMALL = {"min_height": 1, "min_width": 1, "min_factor": 8}  # all bytes are read, and few pixels computed
RESTART = re.compile(rb"\xff[\xd0-\xd7]")
TABLES = (0xDB, 0xC4)  # markers of quantization and Huffman tables
MOST_PIECES, MOST_TABLES = 10_000, 4000  # restart intervals, and bytes of tables: each interval is decoded with them
LEAST = (48, 27)  # width and height below which there are no blocks to compare
ROWS, COLUMNS = 9, 16  # of blocks
SQUEEZED = 0.05  # largest relative change of the aspect ratio; 432x240 instead of 640x360 is 0.013


def decode_jpeg(data: bytes, least: int = 0) -> np.ndarray:
    """Decode to (h, w, 3) uint8 BGR. Raises CameraError if it is not complete, or larger than any camera's.

    least: if not 0, pixels of width that are enough; a larger picture may then come smaller, in less time.
    """
    return _decode(data, "BGR", min_width=least)


def check_jpeg(data: bytes) -> tuple[int, int]:
    """Return a JPEG's (height, width). Raises CameraError for what decode_jpeg() refuses, in half of its time."""
    _decode(data, "GRAY", **SMALL)
    height, width = simplejpeg.decode_jpeg_header(data, strict=False)[:2]
    return height, width


def _decode(data: bytes, colours: str, **scale: int) -> np.ndarray:
    if len(data) > MOST_BYTES:
        raise CameraError("a JPEG is too large", found=f"{len(data) / 1e6:.1f} MB", remedy="is it a camera's?")
    if data[:2] != b"\xff\xd8":
        raise CameraError("not a JPEG", found=data[:12], remedy="is it whole? write other formats anew as JPEG")
    try:
        height, width = simplejpeg.decode_jpeg_header(data, strict=False)[:2]
        scans = data.count(b"\xff\xda")
        if width * height > MOST_PIXELS or scans > MOST_SCANS:
            size_found = f"{width}x{height} pixels in {scans} scans"
            raise CameraError("a JPEG would take too much to decode", found=size_found, remedy="is it a camera's?")
        if b"Exif\0\0" in data and _is_turned(data):
            remedy = "turn its pixels, as mogrify -auto-orient does"
            raise CameraError("a JPEG that its EXIF data turn over", remedy=remedy)
        try:
            return simplejpeg.decode_jpeg(data, colours, **scale)
        except ValueError as error:
            return simplejpeg.decode_jpeg(_check_only_filler(data, error), colours, strict=False, **scale)
    except (ValueError, KeyError) as error:  # KeyError: a header without colours
        raise CameraError("a JPEG is damaged or cut short", found=error, remedy="check the camera's cable") from None


def _is_turned(data: bytes) -> bool:
    """Whether most programs show a picture turned, while decoders do not turn it."""
    encoded = np.frombuffer(data, np.uint8)
    flags = cv2.IMREAD_REDUCED_GRAYSCALE_8
    upright, plain = (np.asarray(cv2.imdecode(encoded, flags | more)) for more in (0, cv2.IMREAD_IGNORE_ORIENTATION))
    return not np.array_equal(upright, plain)


def _check_only_filler(data: bytes, warning: ValueError) -> bytes:
    """Return a JPEG without filler in its header. Raises ValueError unless it is whole but for filler before markers.

    warning: the first one, and the only one that simplejpeg reports: what follows filler may be torn. So each restart
    interval is decoded as a picture of its own, where a warning about filler is the last one.
    """
    segments, scan_at = _segments(data)
    header = b"\xff\xd8" + b"".join(segments)
    scanned = data[scan_at:]
    data, filled = header + scanned, data[:scan_at]
    if header != filled:
        try:
            simplejpeg.decode_jpeg(data, "GRAY", **SMALL)
            return data
        except ValueError as error:
            warning = error
    named = {segment[1]: segment for segment in segments}
    if RESTART_INTERVAL not in named and _is_filler(warning) and "marker 0xd9" in str(warning):
        return data  # nothing follows it
    if not ("extraneous bytes" in str(warning) and {RESTART_INTERVAL, BASELINE} <= named.keys()):
        raise warning
    interval = int.from_bytes(named[RESTART_INTERVAL][4:6], "big")
    frame = named[BASELINE]
    height, width, parts = struct.unpack(">HHB", frame[5:10])
    sampling = frame[11::3] if parts > 1 else b"\x11"  # horizontal and vertical, four bits each
    block = 8 * max(s >> 4 for s in sampling), 8 * max(s & 15 for s in sampling)
    blocks = math.ceil(width / block[0]) * math.ceil(height / block[1])
    scan, end, _ = scanned.partition(b"\xff\xd9")
    pieces = RESTART.split(scan)
    in_turn = all(marker[1] & 7 == i % 8 for i, marker in enumerate(RESTART.findall(scan)))
    tables = b"".join(segment for segment in segments if segment[1] in TABLES)
    whole = interval > 0 and (len(pieces) - 1) * interval < blocks <= len(pieces) * interval
    if not (end and in_turn and whole) or len(pieces) > MOST_PIECES or len(tables) > MOST_TABLES:
        raise warning
    for i, piece in enumerate(pieces):
        row = [v.to_bytes(2, "big") for v in (block[1], block[0] * min(interval, blocks - i * interval))]
        picture = b"\xff\xd8", tables, frame[:5], *row, frame[9:], named[SCAN], piece, end
        try:
            simplejpeg.decode_jpeg(b"".join(picture), "GRAY", **SMALL)
        except ValueError as error:
            if not _is_filler(error):
                raise
    return data


def _is_filler(warning: ValueError) -> bool:
    match = re.search(r"(\d+) extraneous bytes before marker", str(warning))  # libjpeg reports it only as text
    return match is not None and int(match[1]) <= FILLED_MOST


def _segments(data: bytes) -> tuple[list[bytes], int]:
    """Return a JPEG's segments up to the header of its first scan, and where the scan begins. Raises ValueError.

    Filler between them is left out.
    """
    at = 2
    segments = [b"  "]
    while segments[-1][1] != SCAN:
        filled = data.find(b"\xff", at, at + FILLED_MOST + 1)
        at = max(at, filled)
        while data[at : at + 2] == b"\xff\xff":
            at += 1
        segment = data[at : at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")]
        if len(segment) < 4 or segment[0] != 0xFF:
            raise ValueError("its header is damaged")
        segments.append(segment)
        at += len(segment)
    return segments[1:], at


def read_jpeg(path: Path | str, least: int = 0) -> np.ndarray:
    """Decode a file as decode_jpeg() does. Raises CameraError, and OSError if the file cannot be read."""
    with open_plain(path, CameraError(f"{path}: no plain file", remedy="remove it")) as file:
        return decode_jpeg(file.read(MOST_BYTES + 1), least)


def brightness(image: np.ndarray) -> tuple[float, float]:
    """Return the mean of a picture's pixels, and its contrast, both in grey levels from 0 to 255.

    The contrast is the standard deviation of the means of a 16x9 grid of blocks, for the colour where it is largest.
    """
    small = cv2.resize(image, (160, 90), interpolation=cv2.INTER_NEAREST)
    cells = cv2.resize(small, (COLUMNS, ROWS), interpolation=cv2.INTER_AREA)
    return float(cells.mean()), float(cells.std(axis=(0, 1)).max())


def block_sums(image: np.ndarray) -> np.ndarray:
    """Return (144,) uint64, one sum per block of a 16x9 grid. Equal sums mean that the blocks are equal, byte for byte.

    image: contiguous, and at least LEAST in size.
    """
    height, width = image.shape[:2]
    rows = height // ROWS
    words = width * 3 // 8 // COLUMNS
    lines = image.reshape(height, width * 3)[: rows * ROWS, : words * COLUMNS * 8]
    eights = np.ascontiguousarray(lines).view(np.uint64)  # eight bytes at a time; overflow does not matter
    return eights.reshape(ROWS, rows, -1).sum(1).reshape(ROWS, COLUMNS, words).sum(2).ravel()


def is_squeezed(given: tuple[int, int], wanted: tuple[int, int]) -> bool:
    """Whether a picture would be squeezed by more than 5 % if it were resized. given, wanted: (width, height) each."""
    return abs(given[0] * wanted[1] / (given[1] * wanted[0]) - 1) > SQUEEZED

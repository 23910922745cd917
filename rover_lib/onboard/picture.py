"""A picture that nobody vouches for: what it would take to decode it, whether all of it is there, what is on it.

    image = decode_jpeg(data)                  # PictureError: cut, damaged, no JPEG, or too much of one
    mean, contrast = brightness(image)
    same = (block_sums(image) == block_sums(before)).mean()

OpenCV decodes a JPEG that was cut and closed with an end marker, and only prints a warning; so does Pillow.
simplejpeg is libjpeg-turbo too, as fast (0.98 ms for 640x360, OpenCV 1.05), gives the same bits, lets other threads run
meanwhile, and hands the warning over.
"""

import re
from pathlib import Path

import cv2
import numpy as np
import simplejpeg

from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.stage import open_plain

MOST_BYTES = 8_000_000  # of a JPEG
MOST_PIXELS = 3840 * 2160  # 25 MB decoded
MOST_SCANS = 32  # a progressive JPEG has some ten, and each costs as much as all of a plain one
FILLED_MOST = 4  # bytes that some webcams put before a marker; many more are there where a piece is missing
LEAST = (48, 27)  # width and height below which there are no blocks to compare
ROWS, COLUMNS = 9, 16  # of blocks


class PictureError(RoverError):
    """Bytes that are no whole picture, or a picture of another time than it should be."""


def decode_jpeg(data: bytes) -> np.ndarray:
    """(h, w, 3) uint8 BGR. Raises PictureError for what is no JPEG, not all of one, or larger than any camera's.

    Its size is known before anything is decoded. What it says of its orientation is not looked at.
    """
    if len(data) > MOST_BYTES:
        raise PictureError("a JPEG is too large", found=f"{len(data) / 1e6:.1f} MB", remedy="is it a camera's?")
    try:
        height, width = simplejpeg.decode_jpeg_header(data)[:2]
        scans = data.count(b"\xff\xda")
        if width * height > MOST_PIXELS or scans > MOST_SCANS:
            found = f"{width}x{height} pixels in {scans} scans"
            raise PictureError("a JPEG would take too much to decode", found=found, remedy="is it a camera's?")
        try:
            return simplejpeg.decode_jpeg(data, "BGR")
        except ValueError as error:
            filled = re.search(r"(\d+) extraneous bytes before marker", str(error))  # libjpeg tells it in no other way
            if not filled or int(filled[1]) > FILLED_MOST:
                raise
            return simplejpeg.decode_jpeg(data, "BGR", strict=False)
    except ValueError as error:
        raise PictureError("a JPEG is damaged or cut short", found=error, remedy="check the camera's cable") from None


def read_jpeg(path: Path | str) -> np.ndarray:
    """A file's picture, as decode_jpeg. Raises PictureError as that does; OSError if the file cannot be read."""
    with open_plain(path, PictureError(f"{path}: no plain file", remedy="remove it")) as file:
        return decode_jpeg(file.read(MOST_BYTES + 1))


def brightness(image: np.ndarray) -> tuple[float, float]:
    """Mean of a picture's pixels, and its contrast: how far a grid of 16x9 means spreads, both in grey levels of 255.

    The contrast is a standard deviation, of the colour that has most. A sensor's noise averages out in it.
    """
    small = cv2.resize(image, (160, 90), interpolation=cv2.INTER_NEAREST)
    cells = cv2.resize(small, (COLUMNS, ROWS), interpolation=cv2.INTER_AREA)
    return float(cells.mean()), float(cells.std(axis=(0, 1)).max())


def block_sums(image: np.ndarray) -> np.ndarray:
    """(144,) uint64, one per block of a 16x9 grid: equal sums are equal blocks, byte for byte.

    image: contiguous, and at least LEAST in size. What is left over at its right and lower edge is in no block.
    """
    height, width = image.shape[:2]
    rows, words = height // ROWS, width * 3 // 8 // COLUMNS
    lines = image.reshape(height, width * 3)[: rows * ROWS, : words * COLUMNS * 8]
    eights = np.ascontiguousarray(lines).view(np.uint64)  # eight bytes at a time, wherever they overflow to
    return eights.reshape(ROWS, rows, -1).sum(1).reshape(ROWS, COLUMNS, words).sum(2).ravel()

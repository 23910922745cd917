"""Deliver the newest frame of a camera. A thread reads all frames, because no backend of OpenCV keeps only the newest.

    with Camera(0) as camera:
        frame = camera.wait(after=0, timeout_s=1)

Another program may be the camera by writing JPEGs into a FIFO. Single bad pictures are left out; a few bad ones in a
row mean that the camera has failed.
"""

import contextlib
import os
import stat
import threading
import time
from collections.abc import Callable, Generator
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from rover_lib.onboard.car.csi import newest_jpegs, read_csi
from rover_lib.onboard.car.picture import COLUMNS, LEAST, ROWS, block_sums, brightness, decode_jpeg, is_squeezed
from rover_lib.onboard.errors import CameraError, sentence_of

FIRST_FRAME_S = 5.0
STALLED_S = 1.0
CLOSE_S = 1.0
UNPLUGGED = "is the camera unplugged?"
MJPG = cv2.VideoWriter.fourcc(*"MJPG")
MONOTONIC, NO_CLOCK = "monotonic", "no"  # the clock that time stamps come from
REFUSED_MOST = 4  # bad pictures in a row mean that the camera has failed; 0.13 s at 30 Hz
SAME = 0.6  # share of equal blocks of a repeated picture; real recordings have 0.02, a still scene's noise 0.37
REMEMBERED = 32  # pictures; a driver has at most this many buffers that it could repeat (VIDEO_MAX_FRAME)
OLD_S = 0.5  # a frame this old is of no use: a plan's throttle begins to fade at this age
AHEAD_S = 0.01  # a time stamp may lie this far in the future, because it may be rounded
WIDTH = 640  # pixels to ask a camera for; nearly every USB camera gives 640x360 and 640x480
NEAR_S = 600.0  # a time stamp further from a clock than this does not come from that clock

Read = tuple[bytes | np.ndarray, float | None]  # a JPEG or a decoded picture, and its time stamp if there is one
Reader = Generator[Read, None, None]


class CameraKind(Protocol):
    """A kind of camera. An entry point of the group `rover_lib.cameras` names its class, and `--camera` that name."""

    def read(self, source: str, size: tuple[int, int], rate_hz: float, closing: threading.Event) -> Reader:
        """Yield each picture as it comes, and its time by time.monotonic() or None, until `closing` is set.

        source: what --camera says, NAME or NAME:MORE. size: (width, height) to ask for. Raises CameraError.
        """


def size_like(width: int, height: int) -> tuple[int, int]:
    """Return the (width, height) to ask a camera for, so that its pictures have the shape of width x height."""
    return WIDTH, round(WIDTH * height / width / 2) * 2


def check_shape(source: str, image: np.ndarray, wanted: tuple[int, int]) -> None:
    """Raise CameraError for a picture of another shape than the policy has seen. wanted: (width, height) of those."""
    height, width = image.shape[:2]
    if is_squeezed((width, height), wanted):
        raise CameraError(
            f"{source}: pictures must have the shape of the policy's, {wanted[0]}x{wanted[1]}",
            found=f"{width}x{height}",
            remedy="use a camera that can give that shape ('rover doctor' lists sizes), or a policy for this one",
        )


@dataclass(frozen=True, slots=True)
class Frame:
    """One picture. Nobody may write into it.

    image: (h, w, 3) uint8 BGR. captured_s: when it was captured, by the camera's clock; when it arrived, if the camera
    does not tell. number: counts from 1. repeats: how many frames in a row, up to this one, repeat nearly all of one of
    the 32 pictures before them, byte for byte; a sensor's noise keeps this at 0. mean, contrast: picture.brightness().
    jpeg: as it arrived; None if the camera delivers raw pictures.
    """

    image: np.ndarray
    captured_s: float
    number: int
    repeats: int
    mean: float
    contrast: float
    jpeg: bytes | None = None


class Camera:
    """A source of frames, open inside its context; a thread reads it and keeps only the newest frame.

    source: a number or /dev/videoN (V4L2), csi (see csi.py), a FIFO of JPEGs, or a CameraKind's name. size: (width,
    height) to request from a camera. rate_hz: to request. Any thread may call any method.
    """

    def __init__(
        self,
        source: str | int | Path,
        *,
        size: tuple[int, int] = (640, 360),
        rate_hz: float = 30.0,
        clock: Callable[[], float] = time.monotonic,
    ):
        self.source = str(source)
        self.size = size
        self.wanted_hz = rate_hz
        self._clock = clock
        self.time_stamps = NO_CLOCK  # their clock; NO_CLOCK: frames get their time of arrival
        self._stamp_s = float("-inf")  # the newest one
        self._shown = np.zeros((REMEMBERED, ROWS * COLUMNS), np.uint64)  # block_sums() of the newest pictures, by row
        self._remembered = 0  # how many pictures have been stored there in all
        self._refusal: CameraError | None = None
        self._closing = threading.Event()
        self._changed = threading.Condition()  # guards the three below
        self._frame: Frame | None = None
        self._arrived_s = 0.0  # when it came, by `clock`
        self._failure: CameraError | None = None
        self._thread: threading.Thread | None = None

    def __enter__(self) -> "Camera":
        return self.open()

    def __exit__(self, *exc: object) -> None:
        self.close()

    def open(self) -> "Camera":
        """Start reading. Raises CameraError if there is no such source, or if no frame comes within 5 s."""
        reader = _reader(self.source, self.size, self.wanted_hz, self._closing)
        self._thread = threading.Thread(target=self._read, args=(reader,), name=f"camera {self.source}", daemon=True)
        self._thread.start()
        try:
            if self.wait(0, FIRST_FRAME_S) is None:
                none = CameraError("none came", remedy="is it a camera that no other program uses?")
                raise self._failed(f"no frame within {FIRST_FRAME_S:g} s", self._refusal or none)
        except BaseException:
            self.close()
            raise
        return self

    def _failed(self, what: str, why: CameraError) -> CameraError:
        return CameraError(f"{self.source}: {what}: {why.what}", found=why.found, remedy=why.remedy)

    def close(self) -> None:
        """Stop reading. Waits at most 1 s for a camera that hangs inside its driver."""
        self._closing.set()
        with self._changed:
            self._changed.notify_all()
        if self._thread and self._thread is not threading.current_thread():
            self._thread.join(CLOSE_S)

    def latest(self) -> Frame | None:
        """Return the newest frame, None before the first. Raises CameraError as wait() does."""
        with self._changed:
            self._check()
            return self._frame

    def wait(self, after: int, timeout_s: float) -> Frame | None:
        """Wait for a frame with a number above `after`, and return the newest; None if none comes in time.

        Raises CameraError once reading has failed, or if a camera that gave frames has given none for STALLED_S.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._failure or self._closing.is_set() or self.frames > after, timeout_s)
            self._check()
            return self._frame if self._frame and self._frame.number > after else None

    def _check(self) -> None:
        if self._failure:
            raise self._failure
        silent_s = self._clock() - self._arrived_s
        if self._frame and silent_s > STALLED_S and not self._closing.is_set():
            raise CameraError(f"{self.source}: no new frame came for {silent_s:.1f} s", remedy="plug it in again")

    @property
    def frames(self) -> int:
        return self._frame.number if self._frame else 0

    def _read(self, reader: Reader) -> None:
        refused = 0
        try:
            with contextlib.closing(reader):
                for picture, stamp_s in reader:
                    if self._closing.is_set():
                        return
                    try:
                        captured_s = self._captured_s(stamp_s)
                        image = decode_jpeg(picture) if isinstance(picture, bytes) else picture
                    except CameraError as error:
                        self._refusal = error
                        refused += 1
                        if self._frame and refused >= REFUSED_MOST:
                            raise self._failed(f"{refused} pictures in a row were no frames", error) from None
                        continue
                    refused = 0
                    self.add(image, captured_s, picture if isinstance(picture, bytes) else None)
                raise CameraError(f"{self.source}: it ended after {self.frames} frames", remedy=UNPLUGGED)
        except CameraError as error:
            failure = error
        except Exception as error:  # whatever goes wrong in a driver, the drive must learn of it
            failure = CameraError(f"{self.source}: reading failed ({sentence_of(error)})", remedy=UNPLUGGED)
        with self._changed:
            self._failure = failure
            self._changed.notify_all()

    def _captured_s(self, stamp_s: float | None) -> float:
        """Return when a frame that has just arrived was captured, seconds by `clock`.

        Time stamps near the machine's monotonic clock come from it: CameraError for one that is old, in the future or
        does not change.
        """
        now_s = self._clock()
        if stamp_s is not None and self._stamp_s < 0 and abs(now_s - stamp_s) < NEAR_S:
            self.time_stamps = MONOTONIC
        if stamp_s is None or self.time_stamps == NO_CLOCK:
            return now_s
        age_s = now_s - stamp_s
        stands = stamp_s <= self._stamp_s
        self._stamp_s = stamp_s
        if stands or not -AHEAD_S <= age_s <= OLD_S:
            actual = "the same again" if stands else f"one of {age_s:.2f} s ago"
            raise CameraError("a frame's time stamp is not of now", found=actual, remedy="plug the camera in again")
        return min(now_s, stamp_s)

    def add(self, image: np.ndarray, captured_s: float, jpeg: bytes | None) -> None:
        """Make a picture the newest frame. Raises CameraError if it is unfit, or has another size than before."""
        before = self._frame
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise CameraError(f"{self.source}: a frame must be (h, w, 3) uint8", found=image.shape)
        (h, w), (h0, w0) = image.shape[:2], (before.image if before else image).shape[:2]
        if (h, w) != (h0, w0):
            problem = f"{self.source}: the picture changed from {w0}x{h0} to {w}x{h}"
            raise CameraError(problem, remedy="is another program using the camera?")
        if w < LEAST[0] or h < LEAST[1]:
            raise CameraError(f"{self.source}: too small a picture to drive by", found=f"{w}x{h}")
        sums = block_sums(image)
        number = self.frames + 1
        same = (self._shown[: self._remembered] == sums).mean(axis=1).max(initial=0.0)
        self._shown[self._remembered % REMEMBERED] = sums
        self._remembered += 1
        repeats = before.repeats + 1 if before and same >= SAME else 0
        frame = Frame(image, captured_s, number, repeats, *brightness(image), jpeg)
        with self._changed:
            self._frame = frame
            self._arrived_s = self._clock()
            self._changed.notify_all()


def path_of(source: str) -> Path:
    """Return the path of a camera's source: a number N means /dev/videoN."""
    return Path(f"/dev/video{source}" if source.isdigit() else source)


def _reader(source: str, size: tuple[int, int], rate_hz: float, closing: threading.Event) -> Reader:
    if source == "csi" or source.startswith(("csi:", "csi,")):
        return read_csi(source, size, rate_hz, closing)
    for kind in entry_points(group="rover_lib.cameras", name=source.partition(":")[0]):
        return kind.load()().read(source, size, rate_hz, closing)
    path = path_of(source)
    try:
        mode = path.stat().st_mode
    except OSError as error:
        problem = f"{path}: no such camera ({error.strerror})"
        raise CameraError(problem, remedy="'rover doctor' lists those that are") from None
    if stat.S_ISCHR(mode):
        return _v4l2(str(path), size, rate_hz)
    if stat.S_ISFIFO(mode):
        return _fifo(path, closing)
    raise CameraError(f"{path}: neither a camera nor a FIFO of JPEGs", remedy="give /dev/videoN")


def _v4l2(source: str, size: tuple[int, int], rate_hz: float) -> Reader:
    device = cv2.VideoCapture(source, cv2.CAP_V4L2)
    try:
        if not device.isOpened():
            remedy = "is the user in group video, and does nobody else use it?"
            raise CameraError(f"{source}: cannot be opened", remedy=remedy)
        device.set(cv2.CAP_PROP_FOURCC, MJPG)  # raw pictures at 30 Hz are too much for USB 2
        device.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
        device.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
        device.set(cv2.CAP_PROP_FPS, rate_hz)
        device.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        jpegs = int(device.get(cv2.CAP_PROP_FOURCC)) == MJPG and device.set(cv2.CAP_PROP_CONVERT_RGB, 0)
        while True:
            ok, image = device.read()
            if not ok:
                raise CameraError(f"{source}: gives no more frames", remedy=UNPLUGGED)
            stamp_s = device.get(cv2.CAP_PROP_POS_MSEC) / 1e3  # the driver's time of the buffer
            yield image.tobytes() if jpegs else image, stamp_s or None
    finally:
        device.release()


def _fifo(path: Path, closing: threading.Event) -> Reader:
    """Yield the newest JPEG of a FIFO, which ends when its writer does."""
    fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK)  # does not wait for the writer
    try:
        yield from newest_jpegs(fd, closing)
    finally:
        os.close(fd)

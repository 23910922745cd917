"""The newest frame of a camera: a thread reads all of them, because no backend of OpenCV can be told to keep only one.

    with Camera(0) as camera:
        frame = camera.wait(after=0, timeout_s=1)

The same reader also takes what stands in for a camera: a video file, a folder of frames, or JPEGs through a FIFO.
"""

import contextlib
import os
import select
import stat
import threading
import time
import zlib
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from itertools import takewhile
from operator import itemgetter
from pathlib import Path

import cv2
import numpy as np

from rover_lib.onboard.errors import RoverError

FIRST_FRAME_S = 5.0
CLOSE_S = 1.0
JPEG_START, JPEG_END = b"\xff\xd8", b"\xff\xd9"  # FF D9 is not in the data of a JPEG: there FF is followed by 00
JPEG_MOST = 8_000_000  # bytes; a stream without an end of a picture in so much is none
PICTURES = (".jpg", ".jpeg", ".png")

Read = tuple[np.ndarray, float | None]  # a picture, and when it was captured if the camera says so
Reader = Generator[Read, None, None]


class CameraError(RoverError):
    """A camera that is not there, stopped, or delivers something else than before."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One picture. Nobody writes into it.

    image: (h, w, 3) uint8 BGR. captured_s: time.monotonic() (or the camera's clock) at which it was captured, or
    arrived where the camera does not say. number: 1, 2, ... of this camera. repeats: how many frames before it were the
    same, byte for byte. mean: of its pixels, 0 to 255.
    """

    image: np.ndarray
    captured_s: float
    number: int
    repeats: int
    mean: float


class Camera:
    """A source of frames, from entering the context until leaving it; a thread keeps only the newest.

    source: a number or /dev/videoN (V4L2), a video file, a folder of pictures (or an episode's), or a FIFO or .mjpeg
    file of JPEGs one after another. size: (width, height) to ask a V4L2 camera for. rate_hz: to ask it for, and of
    sources without a rate of their own. Any thread may call any method.
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
        self.size, self.wanted_hz = size, rate_hz
        self._clock = clock
        self._closing = threading.Event()
        self._changed = threading.Condition()  # guards the four below
        self._frame: Frame | None = None
        self._failure: CameraError | None = None
        self._first_s = 0.0
        self._began_s = 0.0
        self._thread: threading.Thread | None = None

    def __enter__(self) -> "Camera":
        return self.open()

    def __exit__(self, *exc: object) -> None:
        self.close()

    def open(self) -> "Camera":
        """Starts reading. Raises CameraError if there is no such source, or no frame within 5 s."""
        reader = _reader(self.source, self.size, self.wanted_hz, self._closing)
        self._thread = threading.Thread(target=self._read, args=(reader,), name=f"camera {self.source}", daemon=True)
        self._thread.start()
        try:
            if self.wait(0, FIRST_FRAME_S) is None:
                raise CameraError(
                    f"{self.source}: no frame within {FIRST_FRAME_S:g} s",
                    remedy="is it a camera, and does no other program use it? ('rover doctor' looks at all of them)",
                )
        except BaseException:
            self.close()
            raise
        return self

    def close(self) -> None:
        """Ends reading. A camera that hangs inside its driver is left behind."""
        self._closing.set()
        with self._changed:
            self._changed.notify_all()
        if self._thread and self._thread is not threading.current_thread():
            self._thread.join(CLOSE_S)

    def latest(self) -> Frame | None:
        """The newest frame, None before the first. Raises CameraError once reading has failed."""
        with self._changed:
            if self._failure:
                raise self._failure
            return self._frame

    def wait(self, after: int, timeout_s: float) -> Frame | None:
        """The newest frame with a number above `after`, None if none comes in time. Raises as latest()."""
        with self._changed:
            self._changed.wait_for(lambda: self._failure or self._closing.is_set() or self.frames > after, timeout_s)
            if self._failure:
                raise self._failure
            return self._frame if self._frame and self._frame.number > after else None

    @property
    def frames(self) -> int:
        """Count of those that came until now."""
        return self._frame.number if self._frame else 0

    @property
    def rate_hz(self) -> float | None:
        """Frames a second, measured since the first; None before the second."""
        with self._changed:
            frame = self._frame
            if frame is None or frame.number < 2 or frame.captured_s <= self._first_s:
                return None
            return (frame.number - 1) / (frame.captured_s - self._first_s)

    def _read(self, reader: Reader) -> None:
        before, repeats, number = None, 0, 0
        try:
            with contextlib.closing(reader):
                for image, captured_s in reader:
                    if self._closing.is_set():
                        return
                    now = self._clock()
                    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
                        raise CameraError(f"{self.source}: a frame must be (h, w, 3) uint8", found=image.shape)
                    if self._frame and image.shape != self._frame.image.shape:
                        (h, w), (h0, w0) = image.shape[:2], self._frame.image.shape[:2]
                        raise CameraError(
                            f"{self.source}: the picture changed from {w0}x{h0} to {w}x{h}",
                            remedy="is another program using the camera?",
                        )
                    seen = zlib.crc32(image.data)
                    repeats = repeats + 1 if seen == before else 0
                    before, number = seen, number + 1
                    # A camera's own time counts if it is of this clock; some drivers give none, or of another.
                    if captured_s is None or not now - 1 < captured_s <= now:
                        captured_s = now
                    frame = Frame(image, captured_s, number, repeats, float(image[::8, ::8].mean()))
                    with self._changed:
                        self._frame = frame
                        self._first_s = self._first_s or frame.captured_s
                        self._changed.notify_all()
                raise CameraError(f"{self.source}: it ended after {number} frames", remedy="is the camera unplugged?")
        except CameraError as error:
            failure = error
        except Exception as error:  # whatever a driver does, the car must learn of it
            failure = CameraError(
                f"{self.source}: reading failed ({type(error).__name__}: {error})", remedy="check the camera"
            )
        with self._changed:
            self._failure = failure
            self._changed.notify_all()


def _reader(source: str, size: tuple[int, int], rate_hz: float, closing: threading.Event) -> Reader:
    if source.isdigit():
        source = f"/dev/video{source}"
    path = Path(source)
    try:
        mode = path.stat().st_mode
    except OSError as error:
        raise CameraError(
            f"{source}: no such camera ({error.strerror})", remedy="'rover doctor' lists those that are"
        ) from None
    if stat.S_ISCHR(mode):
        return _v4l2(source, size, rate_hz)
    if stat.S_ISFIFO(mode):
        return _fifo(path, closing)
    if stat.S_ISDIR(mode):
        return _folder(path, rate_hz, closing)
    if path.suffix == ".mjpeg":
        return _paced(_decoded(_split(iter([path.read_bytes()]))), rate_hz, closing)
    return _video(path, rate_hz, closing)


def _v4l2(source: str, size: tuple[int, int], rate_hz: float) -> Reader:
    device = cv2.VideoCapture(source, cv2.CAP_V4L2)
    try:
        if not device.isOpened():
            raise CameraError(
                f"{source}: cannot be opened", remedy="is the user in group video, and does nobody else use it?"
            )
        device.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"MJPG"))  # raw pictures do not fit USB 2 at 30 Hz
        device.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
        device.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
        device.set(cv2.CAP_PROP_FPS, rate_hz)
        device.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        while True:
            ok, image = device.read()
            if not ok:
                raise CameraError(f"{source}: gives no more frames", remedy="is the camera unplugged?")
            yield image, device.get(cv2.CAP_PROP_POS_MSEC) / 1e3  # the driver's time of the buffer, monotonic
    finally:
        device.release()


def _video(path: Path, rate_hz: float, closing: threading.Event) -> Reader:
    device = cv2.VideoCapture(str(path))
    try:
        if not device.isOpened():
            raise CameraError(
                f"{path}: no video that OpenCV can read", remedy="give /dev/videoN, a video, a folder or a FIFO"
            )
        own_hz = device.get(cv2.CAP_PROP_FPS)
        images = map(itemgetter(1), takewhile(itemgetter(0), iter(device.read, None)))
        yield from _paced(images, own_hz if 1 <= own_hz <= 240 else rate_hz, closing)
    finally:
        device.release()


def _folder(path: Path, rate_hz: float, closing: threading.Event) -> Reader:
    folder = path / "frames" if (path / "frames").is_dir() else path
    files = sorted(f for f in folder.iterdir() if f.suffix.lower() in PICTURES)
    if not files:
        raise CameraError(
            f"{folder}: no pictures in it ({', '.join(PICTURES)})", remedy="give /dev/videoN or another folder"
        )
    pictures = (cv2.imread(str(f), cv2.IMREAD_COLOR) for f in files)
    return _paced((p for p in pictures if p is not None), rate_hz, closing)


def _paced(images: Iterator[np.ndarray], rate_hz: float, closing: threading.Event) -> Reader:
    """Pictures that are all there, at a camera's rate."""
    start = time.monotonic()
    for i, image in enumerate(images):
        if closing.wait(max(0.0, start + i / rate_hz - time.monotonic())):
            return
        yield image, None


def _fifo(path: Path, closing: threading.Event) -> Reader:
    """JPEGs from a FIFO, the last of those that are there; its end is the end of the camera."""
    for image in _decoded(_split(_pieces(path, closing), newest=True)):
        yield image, None


def _pieces(path: Path, closing: threading.Event) -> Iterator[bytes]:
    fd = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        began = False
        while not closing.is_set():
            if not select.select([fd], [], [], 0.05)[0]:
                continue
            try:
                data = os.read(fd, 1 << 20)
            except BlockingIOError:
                continue
            if data:
                began = True
                yield data
            elif began:
                return
            else:
                closing.wait(0.01)  # nobody writes yet
    finally:
        os.close(fd)


def _split(pieces: Iterator[bytes], newest: bool = False) -> Iterator[bytes]:
    """Whole JPEGs out of a stream; newest: of several that came together only the last."""
    pending = bytearray()
    for piece in pieces:
        pending += piece
        last = None
        while (end := pending.find(JPEG_END)) >= 0:
            start = pending.find(JPEG_START, 0, end)
            if start >= 0:
                if last is not None and not newest:
                    yield last
                last = bytes(pending[start : end + 2])
            del pending[: end + 2]
        if last is not None:
            yield last
        if len(pending) > JPEG_MOST:
            raise CameraError(
                f"no JPEG in {JPEG_MOST / 1e6:g} MB of the stream", remedy="write JPEGs one after another"
            )


def _decoded(jpegs: Iterator[bytes]) -> Iterator[np.ndarray]:
    for jpeg in jpegs:
        image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        if image is not None:  # a damaged one is no frame
            yield image

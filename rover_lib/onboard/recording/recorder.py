"""Record on the car: an episode while the control loop runs, or an episode of a human who drives.

All times are the monotonic clock's, which is mapped to the system's clock once, at the start, as NTP may set that one
meanwhile. A fault of the recorder never stops a drive: it is logged once, and what was recorded until then is kept.
"""

import contextlib
import logging
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rover_lib.onboard.car.camera import Camera
from rover_lib.onboard.car.servo_link import ServoLink
from rover_lib.onboard.errors import EpisodeError, RoverError, sentence_of
from rover_lib.onboard.recording.episode import About, EpisodeWriter, find_killed, remove_if_empty
from rover_lib.onboard.signal_event import SignalEvent, signals
from rover_lib.onboard.status_line import StatusLine

SPARE_BYTES = 16_000_000  # always left free on the disk: to finish an episode, and for the rest of the Pi
LEAST_BYTES = 1_000_000  # an episode that would have less room than this is not begun
ROW_BYTES = 1000  # what a control or frame needs in both files at the end
QUEUE_MOST = 20_000  # controls that may wait for the disk: some minutes, a few megabytes
SILENT_S = 2.0  # without a frame or a status of the Arduino for this time, recording ends
CLOSE_S = 60.0  # time for a slow card to catch up
PAUSE_S = 5.0  # between two episodes

_log = logging.getLogger("rover")


class Recorder(contextlib.AbstractContextManager["Recorder"]):
    """Records an episode while a loop runs. The loop hands over controls, and a thread takes frames from the camera.

    folder: where the episode appears on close(), named episode_YYYYMMDD_HHMMSS by its start in local time (a second
    later if that name is taken). rate_hz: maximum frames per second. most_bytes: of the episode; None: limited by the
    disk only. Raises EpisodeError if there is no room to record; later faults are in `failure`.
    """

    def __init__(
        self,
        folder: Path | str,
        camera: Camera,
        about: About,
        *,
        rate_hz: float = 30.0,
        most_bytes: int | None = None,
        clock: Callable[[], float] = time.monotonic,
    ):
        self._camera = camera
        self._clock = clock
        self._most_bytes = most_bytes
        self.start_s = clock()
        self._to_system_s = time.time() - self.start_s
        self._frame_s = 0.75 / rate_hz  # a frame that comes sooner is left out: the camera is faster
        self._writer = _new_episode(
            Path(folder), self.start_s + self._to_system_s, replace(about, fps=min(rate_hz, camera.wanted_hz))
        )
        self.folder = self._writer.folder
        self.path: Path | None = None  # the episode's folder, once it exists
        self.failure: str | None = None
        self._queue: deque[tuple] = deque()
        self._lost = 0
        self._closing = threading.Event()
        self._unwanted = False
        try:
            self._check_room()
            self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
            self._thread.start()
        except BaseException:
            self._writer.close()
            raise

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        begun = error is None or self.controls or self._queue  # else the car was not armed, say
        self.close(sentence_of(error) if error else None, unwanted=not begun)

    def control(self, host_s: float, *reading: int | None, **extra: Any) -> None:
        """Hand over one control, at time `host_s` of the clock. Never blocks, never raises.

        reading, extra: as EpisodeWriter.control() takes them.
        """
        if self.failure is not None or self._closing.is_set():
            return
        if len(self._queue) < QUEUE_MOST:
            self._queue.append((host_s, reading, extra))
        else:
            self._lost += 1

    def note(self, **metadata: Any) -> None:
        """Add entries to the episode's metadata, of JSON's types. Does nothing if the episode has ended."""
        if self.failure is None and not self._closing.is_set():
            self._writer.metadata |= metadata

    def close(self, fault: str | None = None, unwanted: bool = False) -> Path | None:
        """End the episode and return its folder; None if there is no usable episode, and `failure` says why.

        fault: what ended it; the episode is kept as far as it goes, and notes it. unwanted: remove all of it.
        """
        self._unwanted = unwanted
        if fault and not unwanted and not self._closing.is_set():
            self._fail(fault)
        self._closing.set()
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            self._fail(f"{self.folder}: the disk has not taken the episode for {CLOSE_S:g} s: check it")
        return self.path

    @property
    def controls(self) -> int:
        return self._writer.controls

    @property
    def frames(self) -> int:
        return self._writer.frames

    def _fail(self, sentence: str) -> None:
        if self.failure is None:
            self.failure = sentence
            _log.error("recording ended: %s", sentence)

    def _check_room(self) -> None:
        folder = self.folder.parent
        rows = ROW_BYTES * (self._writer.controls + self._writer.frames)
        if self._most_bytes is not None and self._most_bytes - rows - self._writer.picture_bytes < LEAST_BYTES:
            problem = f"{folder}: no room is left of what episodes may take here"
            raise EpisodeError(problem, remedy="fetch them by `rover playbook drive`, or delete some")
        disk = os.statvfs(folder)
        if (free := disk.f_bavail * disk.f_frsize) < (needed := SPARE_BYTES + rows):
            room = f"{free / 1e6:.1f} MB free, {needed / 1e6:.1f} are kept in reserve"
            raise EpisodeError(f"{folder}: the disk is almost full", found=room, remedy="make room, or use another")

    def _run(self) -> None:
        try:
            self._collect()
        except Exception as error:  # whatever it is, the car drives on, and what was recorded is kept
            self._fail(sentence_of(error))
        if self._unwanted:
            return self._writer.close(unwanted=True)
        if self.failure:
            self._writer.metadata["fault"] = self.failure
        if self._lost:
            self._writer.metadata["controls_lost"] = self._lost
        try:
            self.path = self._writer.finish()
        except Exception as error:
            self._fail(sentence_of(error))

    def _collect(self) -> None:
        newest = self._camera.latest()
        number = newest.number if newest else 0  # that frame came before the episode began
        last_s = self._clock()
        captured_s = -1e9
        while True:
            frame = self._camera.wait(number, 0.1)
            closing = self._closing.is_set()  # read before the queue is emptied, so that nothing is lost
            for _ in range(len(self._queue)):
                host_s, reading, extra = self._queue.popleft()
                self._writer.control(host_s + self._to_system_s, *reading, **extra)
            if closing:
                return
            now = self._clock()
            if frame is None:
                if now - last_s > SILENT_S:
                    problem = f"{self._camera.source}: no frame for {SILENT_S:g} s"
                    raise EpisodeError(problem, remedy="is the camera plugged in?")
                continue
            number = frame.number
            last_s = now
            if frame.captured_s - captured_s < self._frame_s:
                continue
            captured_s = frame.captured_s
            self._check_room()
            self._writer.frame(captured_s + self._to_system_s, frame.image)


def room_for(folder: Path | str, most_mb: float) -> int:
    """Return the bytes that the next episode may take in a folder whose whole content may take most_mb.

    At most half of the free disk: an episode is packed on it to be fetched, and a new model needs room as well.
    """
    folder = Path(folder)
    size = sum(path.lstat().st_size for path in folder.rglob("*"))
    there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    disk = os.statvfs(there)
    return int(min(most_mb * 1e6 - size, disk.f_bavail * disk.f_frsize / 2))


def _new_episode(folder: Path, start_s: float, about: About) -> EpisodeWriter:
    """Open an episode in `folder`, named by its start; if that name is taken, by the next free second."""
    if killed := [part for part in find_killed(folder) if not remove_if_empty(part)]:
        text = "%d recordings here were killed; `rover record %s --finish` keeps what they have"
        _log.warning(text, len(killed), folder)
    while True:
        name = time.strftime("episode_%Y%m%d_%H%M%S", time.localtime(start_s))
        writer = EpisodeWriter(folder / name, about, resolution=None, flags=True)
        try:
            writer.open()
            return writer
        except EpisodeError as error:
            if error.kind != "exists":
                raise
            start_s += 1


@dataclass(frozen=True)
class RecordReport:
    """What was recorded.

    folder: None if there is no usable episode. not_measured: number of controls without a pulse of steering, and of
    throttle. fault: what ended it, None if it was asked to end.
    """

    folder: Path | None
    controls: int
    frames: int
    seconds: float
    not_measured: tuple[int, int]
    fault: str | None

    def __str__(self) -> str:
        place = self.folder or "nothing"
        text = f"recorded: {place} ({self.controls} controls and {self.frames} frames in {self.seconds:.1f} s)"
        for channel, lost in zip(("steering", "throttle"), self.not_measured, strict=True):
            if lost > self.controls / 10:
                text += f"; {channel} was not measured in {lost} of them: is the transmitter on?"
        return text


def record(
    camera: Camera,
    link: ServoLink,
    folder: Path | str,
    *,
    rate_hz: float = 30.0,
    max_seconds: float | None = None,
    stop: threading.Event | None = None,
    label: str = "",
    clock: Callable[[], float] = time.monotonic,
) -> RecordReport:
    """Record one episode of a human who drives.

    Args:
        camera: whose frames are recorded.
        link: to the Arduino, whose newest status is recorded as a control at each tick, none twice.
        folder: in which the episode's folder is made.
        rate_hz: of the ticks.
        max_seconds: after which it ends.
        stop: ends it when it is set.
        label: stored with the episode.
        clock: in seconds, that of the camera's and the link's time stamps.

    Returns:
        What was recorded; `fault` is what ended it, if that is neither the time nor `stop`.

    Raises:
        EpisodeError: recording cannot begin.
    """
    stop = stop or threading.Event()
    lost = 0, 0
    with contextlib.ExitStack() as stack:
        description = About(label, arduino_port=link.port, source="human", car=link.car)
        recorder = stack.enter_context(Recorder(folder, camera, description, rate_hz=rate_hz, clock=clock))
        start = heard_s = recorder.start_s  # earlier statuses do not belong to this episode

        def words() -> str:
            return f"{clock() - start:.0f} s, {recorder.controls} controls, {recorder.frames} frames"

        line = stack.enter_context(StatusLine(words))
        _log.addHandler(line)
        stack.callback(_log.removeHandler, line)
        tick = 0
        while not stop.is_set() and recorder.failure is None:
            now = clock()
            if max_seconds is not None and now - start >= max_seconds:
                break
            try:
                telemetry = link.latest()
                if now - heard_s > SILENT_S:
                    problem = f"{link.port}: no status for {SILENT_S:g} s"
                    raise EpisodeError(problem, remedy="is the Arduino plugged in?")
            except RoverError as error:
                recorder.close(str(error))
                break
            if telemetry is not None and telemetry.host_s > heard_s:
                heard_s = telemetry.host_s
                recorder.control(heard_s, telemetry.uptime_ms, *telemetry.receiver)
                steering, throttle = telemetry.receiver[:2]
                lost = lost[0] + (steering is None), lost[1] + (throttle is None)
            tick = max(tick + 1, int((now - start) * rate_hz))
            stop.wait(max(0.0, start + tick / rate_hz - clock()))
        seconds = clock() - start
    return RecordReport(recorder.path, recorder.controls, recorder.frames, seconds, lost, recorder.failure)


def record_episodes(
    camera: str,
    port: str,
    folder: Path | str,
    *,
    rate_hz: float = 30.0,
    episodes: int = 1,
    notify: Callable[[str], None] = _log.info,
    **options: Any,
) -> Iterator[RecordReport]:
    """Open camera and Arduino, and record one episode after another. Call it in the main thread: it handles signals.

    options: of record(). SIGINT ends an episode; a second one, or one in the pause before the next episode, ends the
    recording, as SIGTERM, SIGHUP, SIGQUIT and a fault do. Raises RoverError if recording cannot begin.
    """
    stop = SignalEvent()
    leave = SignalEvent()

    def on_signal(number: int, _: object) -> None:
        if number != signal.SIGINT or stop.is_set():
            leave.set()
        stop.set()

    with Camera(camera, rate_hz=rate_hz) as frames, ServoLink(port) as link, signals(on_signal):
        for i in range(episodes):
            if i:
                notify(f"episode {i + 1} of {episodes} begins in {PAUSE_S:g} s; Ctrl-C now is the end of it all")
                if stop.wait(PAUSE_S):
                    return
            notify("recording; Ctrl-C ends the episode")
            report = record(frames, link, folder, rate_hz=rate_hz, stop=stop, **options)
            yield report
            if report.fault or leave.is_set():
                return
            stop.clear()

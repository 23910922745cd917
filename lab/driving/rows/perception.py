"""Faults of what the camera shows: nothing, always the same, too late, or something useless.

There are no rows about time stamps that are old or stand still, as a FIFO has none: tests/onboard/car/test_camera.py
tests those.
"""

import signal

import numpy as np

from lab.driving.bench import DrivingBench
from lab.driving.pins import CONTINUES, REFUSED, STOPPED
from lab.driving.policy import PLAIN, SIZE, pictures
from lab.driving.row import FaultKind
from rover_lib.onboard.car.csi import PROGRAM
from rover_lib.onboard.car.picture import decode_jpeg

FAULTS = FaultKind("perception")


@FAULTS.add("camera unplugged", STOPPED, "is the camera unplugged", "the FIFO's writer closes it")
def _unplug_camera(bench: DrivingBench) -> None:
    bench.feed.close()


@FAULTS.add("camera frozen", STOPPED, "the camera is frozen", "the same JPEG again and again")
def _freeze(bench: DrivingBench) -> None:
    bench.feed.freeze()


@FAULTS.add("camera frozen before the drive", REFUSED, "the camera is frozen", "the same JPEG again and again")
def _freeze_before(bench: DrivingBench) -> None:
    bench.feed.freeze()


@FAULTS.add("camera shows two old pictures", STOPPED, "the camera is frozen", "two JPEGs in turn")
def _ring(bench: DrivingBench) -> None:
    bench.feed.show(*pictures(PLAIN, count=2))


@FAULTS.add("pictures cut", STOPPED, "were no frames: a JPEG is damaged", "two thirds of each JPEG and an end marker")
def _cut(bench: DrivingBench) -> None:
    bench.feed.show(*(jpeg[: len(jpeg) * 2 // 3] + b"\xff\xd9" for jpeg in pictures(PLAIN)))


@FAULTS.add(
    "a picture that is a bomb",
    STOPPED,
    "were no frames: a JPEG would take too much",
    "JPEGs whose header says 16,000x16,000",
)
def _bomb(bench: DrivingBench) -> None:
    size, bomb = (value.to_bytes(2, "big") for value in (SIZE[0], 16_000))
    size += SIZE[1].to_bytes(2, "big")
    bench.feed.show(*(jpeg.replace(size, bomb * 2, 1) for jpeg in pictures(PLAIN)))


@FAULTS.add(
    "one pixel flickers", STOPPED, "the camera is frozen", "grey but for one pixel, which is always another grey"
)
def _flicker(bench: DrivingBench) -> None:
    shown = [np.full((*SIZE, 3), 128, np.uint8) for _ in range(40)]
    for i, picture in enumerate(shown):
        picture[50, 50] = 6 * i
    bench.feed.show(*shown)


@FAULTS.add("all but a strip is frozen", STOPPED, "the camera is frozen", "a strip of 5 % still changes")
def _freeze_but_a_strip(bench: DrivingBench) -> None:
    shown = [decode_jpeg(jpeg).copy() for jpeg in pictures(PLAIN)]
    rows = SIZE[0] // 20
    for picture in shown[1:]:
        picture[:-rows] = shown[0][:-rows]
    bench.feed.show(*shown)


@FAULTS.add("camera sees grey", STOPPED, "nothing is on the camera's picture", "grey pictures, with a sensor's noise")
def _grey(bench: DrivingBench) -> None:
    bench.feed.show(*np.random.default_rng(0).integers(120, 137, (40, *SIZE, 3), np.uint8))


@FAULTS.add("camera black", STOPPED, "picture is black", "black pictures, with a sensor's noise")
def _blacken(bench: DrivingBench) -> None:
    bench.feed.show(*pictures(PLAIN, level=0))


@FAULTS.add("camera changes its picture's size", STOPPED, "the picture changed from", "pictures of 160x80")
def _resize(bench: DrivingBench) -> None:
    bench.feed.show(*pictures(PLAIN, size=(80, 160)))


@FAULTS.add("camera of another shape", REFUSED, "they would be squeezed", "pictures of 160x120 since before the drive")
def _another_shape(bench: DrivingBench) -> None:
    bench.feed.show(*pictures(PLAIN, size=(120, 160)))


@FAULTS.add(
    "frames late",
    CONTINUES,
    "no new frame",
    "none for 300 ms, then each 120 ms late",
    watch_s=0.1,
    limits="as 'camera gives no more frames', when none comes for longer than that",
)
def _frames_late(bench: DrivingBench) -> None:
    bench.feed.pause()
    bench.wait(0.3)
    bench.feed.late_s = 0.12
    bench.show(PLAIN)
    bench.wait(1.5)
    bench.feed.late_s = 0.0


@FAULTS.add(
    "camera gives no more frames",
    CONTINUES,
    "no new frame came",
    "the FIFO stays open, and nothing comes",
    watch_s=2.0,
    until_limit=True,
    exit_code=3,
)
def _no_frames(bench: DrivingBench) -> None:
    bench.feed.pause()


@FAULTS.add("rpicam-vid killed", STOPPED, "rpicam-vid has ended", "SIGKILL to its stand-in", start="csi")
def _kill_rpicam(bench: DrivingBench) -> None:
    bench.signal_children(signal.SIGKILL, PROGRAM)


@FAULTS.add(
    "rpicam-vid stopped",
    CONTINUES,
    "no new frame came",
    "SIGSTOP to its stand-in",
    start="csi",
    watch_s=2.0,
    until_limit=True,
    exit_code=3,
)
def _stop_rpicam(bench: DrivingBench) -> None:
    bench.signal_children(signal.SIGSTOP, PROGRAM)


@FAULTS.add("camera black at the start", REFUSED, "picture is black", "black pictures since before the drive")
def _black_before(bench: DrivingBench) -> None:
    bench.feed.show(*pictures(PLAIN, level=0))


@FAULTS.add("no camera at the start", REFUSED, "no such camera", "the FIFO is removed before the drive")
def _no_camera(bench: DrivingBench) -> None:
    bench.feed.close()
    bench.camera.unlink()

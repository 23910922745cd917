"""Make a film of a drive, its pictures with all that is known of each moment: `rover log FILE --video out.mp4`.

PyAV encodes an .mp4; Pillow encodes a .webp, which is small enough for a page.
"""

import functools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import av
import cv2
import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from rover_lib.onboard.car.pwm import PwmCalibration
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.stage import atomic_path
from rover_lib.onboard.view.path_overlay import CarShape, from_now
from rover_lib.workshop.progress import Progress, silent
from rover_look.replay import AHEAD, Replay

WIDTH = 640
PANEL = 118  # rows below the picture
FULL_THROTTLE = 0.25  # the throttle that fills the bar
WHO = {"M": "the human drives", "A": "the policy drives", "S": "stopped", "": ""}
GREEN_BGR = (113, 204, 46)
INK, FAINT, BAR, FILL, PIN = (232, 232, 232), (154, 164, 173), (42, 47, 52), (59, 143, 212), (255, 255, 255)
KINDS = (".mp4", ".webp")


class FilmError(RoverError):
    """A film that cannot be made."""


def write_film(
    path: Path,
    replay: Replay,
    *,
    rate_hz: float = 30.0,
    width: int = WIDTH,
    quality: int = 50,
    progress: Progress = silent,
) -> int:
    """Write a film of a drive at its own pace, and return how many pictures it has.

    path: .mp4 or .webp. rate_hz: pictures per second. width: of the film, even. quality: of a .webp, 1 to 100.
    Raises FilmError for another kind of file, or if every picture of the drive is damaged; ParamsError as CarShape.of.
    """
    if path.suffix not in KINDS:
        raise FilmError(f"{path}: a film ends in {' or '.join(KINDS)}", found=path.suffix or "no ending")
    with atomic_path(path) as temporary:
        # The encoders are told the kind, because they would tell it by the name, and the temporary file has another.
        encode = _write_mp4 if path.suffix == ".mp4" else functools.partial(_write_webp, quality=quality)
        count = encode(temporary, _pictures(replay, rate_hz, width, progress), rate_hz)
        if not count:
            raise FilmError(f"{path}: no picture of this drive is whole")
    return count


def _pictures(replay: Replay, rate_hz: float, width: int, progress: Progress) -> Iterator[np.ndarray]:
    """Yield a picture for each time step of the film, (h, w, 3) uint8 RGB with even sides, all of one size.

    A step whose picture is damaged is left out.
    """
    times_s = np.array([m.t_s for m in replay.moments])
    shape = CarShape.of(replay.car)
    size: tuple[int, int] | None = None
    for at_s in progress(np.arange(0.0, times_s[-1] + 1e-9, 1 / rate_hz), desc="drawing"):
        moment = replay.moments[int(np.searchsorted(times_s, at_s + 1e-9, side="right")) - 1]
        frame = moment.frame_bgr()
        if frame is None:
            continue
        picture = draw_moment(moment.head, frame, shape, replay.car.pwm)
        size = size or (width, round(width * picture.shape[0] / picture.shape[1] / 2) * 2)
        if size != picture.shape[1::-1]:
            picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
        yield picture


def _write_mp4(path: Path, pictures: Iterator[np.ndarray], rate_hz: float) -> int:
    count = 0
    with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as container:
        stream: Any = None
        for picture in pictures:
            if stream is None:
                stream = container.add_stream("libx264", rate=round(rate_hz), options={"crf": "23"})
                stream.height, stream.width = picture.shape[:2]
                stream.pix_fmt = "yuv420p"  # what browsers play
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            count += 1
        if stream is not None:
            container.mux(stream.encode())
    return count


def _write_webp(path: Path, pictures: Iterator[np.ndarray], rate_hz: float, quality: int) -> int:
    images = [Image.fromarray(picture) for picture in pictures]
    if images:
        images[0].save(path, "WEBP", save_all=True, append_images=images[1:], duration=round(1000 / rate_hz), loop=0,
                       quality=quality, method=4)  # fmt: skip
    return len(images)


def draw_moment(head: dict[str, Any], frame_bgr: np.ndarray, shape: CarShape, pwm: PwmCalibration) -> np.ndarray:
    """Return a moment's picture, (h, WIDTH, 3) uint8 RGB, with the planned path drawn into it and the commands below.

    head: a Moment's. frame_bgr: (h, w, 3) uint8. shape, pwm: of the car that was driven.
    """
    height = round(WIDTH * frame_bgr.shape[0] / frame_bgr.shape[1] / 2) * 2
    picture = cv2.resize(frame_bgr, (WIDTH, height), interpolation=cv2.INTER_AREA)
    if plan := head.get("plan"):
        actions = from_now(plan, head["sent_s"])
        _draw_ribbon(picture, shape.ribbon(actions, 1 / plan["rate_hz"], WIDTH / height))
    canvas = np.full((height + PANEL, WIDTH, 3), (20, 23, 26), np.uint8)
    canvas[:height] = picture[:, :, ::-1]
    image = Image.fromarray(canvas)
    _draw_panel(ImageDraw.Draw(image), head, height, pwm, shape.left)
    return np.asarray(image)


def _draw_ribbon(picture: np.ndarray, ribbon: Sequence[tuple[float, float, float, float]]) -> None:
    if len(ribbon) < 2:
        return
    height, width = picture.shape[:2]
    points = [(a * width, b * height) for a, b, _, _ in ribbon] + [(c * width, d * height) for *_, c, d in ribbon[::-1]]
    corners = np.clip(np.array(points) * 8, -1e6, 1e6).astype(np.int32)  # in eighths of a pixel
    filled = picture.copy()
    cv2.fillPoly(filled, [corners], GREEN_BGR, cv2.LINE_AA, 3)
    cv2.addWeighted(filled, 0.35, picture, 0.65, 0, picture)
    cv2.polylines(picture, [corners], True, GREEN_BGR, 2, cv2.LINE_AA, 3)


@functools.cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans.ttf"), size)


def _draw_panel(draw: ImageDraw.ImageDraw, head: dict[str, Any], top: int, pwm: PwmCalibration, left: int) -> None:
    tick, pins = head["tick"], head.get("pins") or [None, None]
    for row, (name, us) in enumerate(zip(("steering", "throttle"), pins, strict=True)):
        y = top + 10 + 30 * row
        pin = None if us is None else pwm.channel(name).action(us)
        draw.text((10, y), name, INK, _font(14))
        _draw_bar(draw, (84, y, 264, y + 18), name, tick[name], pin, left)
        value = "" if tick[name] is None else f"{tick[name]:+.2f}" if name == "steering" else f"{tick[name]:.3f}"
        draw.text((272, y), value if us is None else f"{value} | {us:.0f} us", INK, _font(14))
    who = WHO.get(head["who"], "")
    lines = [f"{head['sent_s']:7.2f} s   {who}" if who else f"{head['sent_s']:7.2f} s"]
    if tick.get("plan_age_ms") is not None:
        lines.append(f"plan {tick['plan_age_ms']:.0f} ms old, took {tick['latency_ms']:.0f} ms")
    if tick.get("late_ms") is not None:
        lines.append(f"command {tick['late_ms']:.1f} ms late, {head['missed']} missed")
    for row, line in enumerate(lines):
        draw.text((404, top + 8 + 21 * row), line, INK, _font(14))
    if head["events"]:
        t_s, text = head["events"][-1]
        draw.text((10, top + 76), f"{t_s:.1f} s  {text}"[:96], FAINT, _font(12))
    draw.text((10, top + 95), AHEAD, FAINT, _font(12))


def _draw_bar(
    draw: ImageDraw.ImageDraw, box: tuple[int, int, int, int], name: str, value: Any, pin: Any, positive_left: int
) -> None:
    """Draw what was commanded as a bar, and what the pin did as a line.

    Steering starts in the middle of the bar. positive_left: 1 if positive steering goes to the left, else -1.
    """
    left, top, right, bottom = box

    def column(action: float) -> float:
        share = 0.5 - 0.5 * positive_left * action if name == "steering" else action / FULL_THROTTLE
        return left + (right - left) * min(1.0, max(0.0, share))

    draw.rectangle(box, BAR)
    if value is not None:
        a, b = sorted((column(0.0), column(value)))
        draw.rectangle((a, top, b, bottom), FILL)
    if pin is not None:
        draw.rectangle((column(pin) - 1, top, column(pin) + 1, bottom), PIN)

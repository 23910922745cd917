"""Make a film of a drive, its pictures with all that is known of each moment: `rover log FILE --video out.mp4`."""

from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from rover_exchange.moments import PERIOD_MS, Moment, moments_of
from rover_lib.onboard.car.picture import PictureError, read_jpeg
from rover_lib.onboard.car.pwm import PwmCalibration
from rover_lib.onboard.drive.flight_log import Flight
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.stage import atomic_path
from rover_lib.onboard.view.path_overlay import CarShape
from rover_lib.workshop.progress import Progress, silent

WIDTH = 640
PANEL = 118  # rows below the picture
FULL_THROTTLE = 0.25  # the throttle that fills the bar
WHO = {"M": "the human drives", "A": "the policy drives", "S": "stopped"}
GREEN_BGR = (113, 204, 46)
INK, FAINT, BAR, FILL, PIN = (232, 232, 232), (154, 164, 173), (42, 47, 52), (59, 143, 212), (255, 255, 255)
# By a file's ending: the codec, its options, and those of the container. A .webp is small enough for a page.
FORMATS = {
    ".mp4": ("libx264", {"crf": "23"}, {"movflags": "+faststart"}),
    ".webp": ("libwebp_anim", {"quality": "50"}, {"loop": "0"}),
}


def write_film(
    path: Path,
    flight: Flight,
    episode: Path | None = None,
    *,
    rate_hz: float = 30.0,
    width: int = WIDTH,
    progress: Progress = silent,
) -> int:
    """Write a film of a drive at its own pace, and return how many pictures it has.

    path: .mp4 or .webp. episode: the one recorded with the drive; None takes the one that the log names. rate_hz:
    pictures per second. width: of the film in pixels; an odd one becomes even. Raises RoverError for another kind of
    file, or if every picture of the drive is damaged; LogError and EpisodeError as moments_of.
    """
    if path.suffix not in FORMATS:
        raise RoverError(f"{path}: a film ends in {' or '.join(FORMATS)}", found=path.suffix or "no ending")
    pictures = _pictures(flight, moments_of(flight, episode), rate_hz, width // 2 * 2, progress)
    with atomic_path(path) as temporary:
        count = _encode(temporary, pictures, rate_hz)
        if not count:
            raise RoverError(f"{path}: no picture of this drive is whole")
    return count


def _pictures(
    flight: Flight, moments: list[Moment], rate_hz: float, width: int, progress: Progress
) -> Iterator[np.ndarray]:
    """Yield a picture for each time step of the film, (h, w, 3) uint8 RGB with even sides, all of one size.

    A step whose picture is damaged or gone is left out.
    """
    times_s = np.array([m.t_s for m in moments])
    shape, pwm, step_s = CarShape.of(flight.car), flight.car.pwm, (flight.period_ms or PERIOD_MS) / 1000
    height: int | None = None
    for at_s in progress(np.arange(times_s[0], times_s[-1] + 1e-9, 1 / rate_hz), desc="drawing"):
        moment = moments[int(np.searchsorted(times_s, at_s + 1e-9, side="right")) - 1]
        try:
            frame = read_jpeg(moment.frame)
        except (OSError, PictureError):
            continue
        picture = draw_moment(moment, frame, shape, pwm, step_s)
        height = height or round(width * picture.shape[0] / picture.shape[1] / 2) * 2
        yield cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)


def _encode(path: Path, pictures: Iterator[np.ndarray], rate_hz: float) -> int:
    codec, options, of_container = FORMATS[path.suffix]
    count, stream = 0, None
    with av.open(str(path), "w", options=of_container) as container:
        for picture in pictures:
            if stream is None:
                stream: Any = container.add_stream(codec, Fraction(rate_hz).limit_denominator(100), options=options)
                stream.height, stream.width = picture.shape[:2]
                stream.pix_fmt = "yuv420p"  # what browsers play
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
            count += 1
        if stream is not None:
            container.mux(stream.encode())
    return count


def draw_moment(
    moment: Moment, frame_bgr: np.ndarray, shape: CarShape, pwm: PwmCalibration, step_s: float
) -> np.ndarray:
    """Return a moment's picture, (h, WIDTH, 3) uint8 RGB, with the planned path drawn into it and the commands below.

    frame_bgr: (h, w, 3) uint8. shape, pwm: of the car that was driven. step_s: seconds between two ticks.
    """
    height = round(WIDTH * frame_bgr.shape[0] / frame_bgr.shape[1] / 2) * 2
    picture = cv2.resize(frame_bgr, (WIDTH, height), interpolation=cv2.INTER_AREA)
    _draw_path(picture, np.array(shape.ribbon(moment.ahead.tolist(), step_s, WIDTH / height)))
    canvas = np.full((height + PANEL, WIDTH, 3), (20, 23, 26), np.uint8)
    canvas[:height] = picture[:, :, ::-1]
    image = Image.fromarray(canvas)
    _draw_panel(ImageDraw.Draw(image), moment, height, pwm, shape.left)
    return np.asarray(image)


def _draw_path(picture: np.ndarray, ribbon: np.ndarray) -> None:
    """Draw the path into a picture. ribbon: (n, 4), x and y of the left wheel and of the right one, in shares."""
    if len(ribbon) < 2:
        return
    corners = np.concatenate([ribbon[:, :2], ribbon[::-1, 2:]]) * picture.shape[1::-1]
    corners = np.clip(corners * 8, -1e6, 1e6).astype(np.int32)  # in eighths of a pixel
    filled = picture.copy()
    cv2.fillPoly(filled, [corners], GREEN_BGR, cv2.LINE_AA, 3)
    cv2.addWeighted(filled, 0.35, picture, 0.65, 0, picture)
    cv2.polylines(picture, [corners], True, GREEN_BGR, 2, cv2.LINE_AA, 3)


def _draw_panel(draw: ImageDraw.ImageDraw, moment: Moment, top: int, pwm: PwmCalibration, left: int) -> None:
    tick, font = moment.tick, ImageFont.load_default(14)
    for y, name in ((top + 10, "steering"), (top + 40, "throttle")):
        action, pin_us = tick[name], tick[f"pins_{name}_us"]
        draw.text((10, y), name, INK, font)
        pin = None if pin_us is None else pwm.channel(name).action(pin_us)
        _draw_bar(draw, (84, y, 264, y + 18), [action, pin], left if name == "steering" else None)
        value = "" if action is None else f"{action:+.3f}"
        draw.text((272, y), value if pin_us is None else f"{value} | {pin_us:.0f} us", INK, font)
    lines = [f"{moment.t_s:7.2f} s   {WHO.get(tick['state'], '')}"]
    if tick["plan_age_ms"] is not None:
        lines.append(f"plan {tick['plan_age_ms']:.0f} ms old, took {tick['latency_ms'] or 0:.0f} ms")
    if tick["late_ms"] is not None:
        lines.append(f"command {tick['late_ms']:.1f} ms late, {moment.missed} missed")
    draw.multiline_text((404, top + 8), "\n".join(lines), INK, font, spacing=6)
    below = f"{moment.event[:96]}\nahead: where the commands of the next second led"
    draw.multiline_text((10, top + 76), below, FAINT, ImageFont.load_default(12))


def _draw_bar(
    draw: ImageDraw.ImageDraw, box: tuple[int, int, int, int], values: list[float | None], side: int | None
) -> None:
    """Draw what was commanded as a bar, and what the pin did as a line. values: both, as actions.

    side: for steering, which starts in the middle of the bar, 1 if positive goes to the left, else -1.
    """
    left, top, right, bottom = box

    def column(action: float) -> float:
        share = action / FULL_THROTTLE if side is None else 0.5 - 0.5 * side * action
        return left + (right - left) * min(1.0, max(0.0, share))

    action, pin = values
    draw.rectangle(box, BAR)
    if action is not None:
        a, b = sorted((column(0.0), column(action)))
        draw.rectangle((a, top, b, bottom), FILL)
    if pin is not None:
        draw.rectangle((column(pin) - 1, top, column(pin) + 1, bottom), PIN)

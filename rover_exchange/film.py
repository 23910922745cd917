"""Make a film of a drive, its pictures with all that is known of each moment: `rover log FILE --video out.mp4`."""

from collections.abc import Iterator
from pathlib import Path

import av
import cv2
import numpy as np
from av.video.stream import VideoStream
from PIL import Image, ImageDraw, ImageFont

from rover_exchange.moments import PERIOD_MS, Moment, moments_of
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.picture import read_jpeg
from rover_lib.onboard.drive.flight_log import Flight
from rover_lib.onboard.errors import CameraError, RoverError
from rover_lib.onboard.stage import atomic_path
from rover_lib.onboard.view.path_overlay import CarShape
from rover_lib.workshop.progress import Progress, silent

WIDTH = 640  # in which a moment is drawn
PANEL = 118  # rows below the picture
FULL_THROTTLE = 0.25  # the throttle that fills the bar
WHO = {"M": "the human drives", "A": "the policy drives", "S": "stopped"}
GREEN_BGR = (113, 204, 46)
INK = (232, 232, 232)
BAR = (42, 47, 52)
FILL = (59, 143, 212)
PIN = (255, 255, 255)
RATE_HZ = 30


def write_film(path: Path, flight: Flight, progress: Progress = silent) -> int:
    """Write a film of a drive, an .mp4, at its own pace, and return how many pictures it has.

    Raises RoverError for another ending, or if every picture is damaged; RoverError and EpisodeError as
    moments_of.
    """
    if path.suffix != ".mp4":
        raise RoverError(f"{path}: a film ends in .mp4", found=path.suffix or "no ending")
    moments = moments_of(flight)
    count = 0
    stream: VideoStream | None = None
    with atomic_path(path) as temporary:
        with av.open(str(temporary), "w", options={"movflags": "+faststart"}) as container:
            for picture in _pictures(flight, moments, progress):
                if stream is None:
                    stream = container.add_stream("libx264", RATE_HZ, options={"crf": "23"})
                    stream.height, stream.width = picture.shape[:2]
                    stream.pix_fmt = "yuv420p"  # what browsers play
                container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
                count += 1
            if stream is not None:
                container.mux(stream.encode())
        if not count:
            raise RoverError(f"{path}: no picture of this drive is whole")
    return count


def _pictures(flight: Flight, moments: list[Moment], progress: Progress) -> Iterator[np.ndarray]:
    """Yield (h, WIDTH, 3) uint8 RGB, even sides, all of one size, for each time step whose picture is whole."""
    times_s = np.array([m.t_s for m in moments])
    step_s = (flight.period_ms or PERIOD_MS) / 1000
    height: int | None = None
    for at_s in progress(np.arange(times_s[0], times_s[-1] + 1e-9, 1 / RATE_HZ), desc="drawing"):
        moment = moments[int(np.searchsorted(times_s, at_s + 1e-9, side="right")) - 1]
        try:
            frame = read_jpeg(moment.frame)
        except (OSError, CameraError):
            continue
        picture = draw_moment(moment, frame, flight.car, step_s)
        height = height or len(picture)
        yield cv2.resize(picture, (WIDTH, height), interpolation=cv2.INTER_AREA)


def draw_moment(moment: Moment, frame_bgr: np.ndarray, car: Car, step_s: float) -> np.ndarray:
    """Return a moment's picture, (h, WIDTH, 3) uint8 RGB, with the path ahead drawn into it and the commands below.

    frame_bgr: (h, w, 3) uint8. car: that was driven. step_s: seconds between two ticks.
    """
    height = round(WIDTH * frame_bgr.shape[0] / frame_bgr.shape[1] / 2) * 2
    picture = cv2.resize(frame_bgr, (WIDTH, height), interpolation=cv2.INTER_AREA)
    ribbon = np.array(CarShape.of(car).ribbon(moment.ahead.tolist(), step_s, WIDTH / height))
    if len(ribbon) > 1:
        corners = np.concatenate([ribbon[:, :2], ribbon[::-1, 2:]]) * (WIDTH, height)
        corners = np.clip(corners * 8, -1e6, 1e6).astype(np.int32)  # in eighths of a pixel
        filled = cv2.fillPoly(picture.copy(), [corners], GREEN_BGR, cv2.LINE_AA, 3)
        picture = cv2.addWeighted(filled, 0.35, picture, 0.65, 0)
        cv2.polylines(picture, [corners], True, GREEN_BGR, 2, cv2.LINE_AA, 3)
    canvas = np.full((height + PANEL, WIDTH, 3), (20, 23, 26), np.uint8)
    canvas[:height] = picture[:, :, ::-1]
    image = Image.fromarray(canvas)
    _draw_panel(ImageDraw.Draw(image), moment, height, car)
    return np.asarray(image)


def _draw_panel(draw: ImageDraw.ImageDraw, moment: Moment, top: int, car: Car) -> None:
    """Draw each action as a bar, what the pin did as a line in it, and both as numbers."""
    tick = moment.tick
    font = ImageFont.load_default(14)
    # The columns of an action of 0 and of 1: steering starts in the middle of the bar.
    scales = {"steering": (174, 174 - 90 * car.left), "throttle": (84, 84 + 180 / FULL_THROTTLE)}
    for y, (name, (zero, one)) in zip((top + 10, top + 40), scales.items(), strict=True):
        action = tick[name] or 0.0
        pin_us = tick[f"pins_{name}_us"]
        column = float(np.clip(zero + (one - zero) * action, 84, 264))
        draw.rectangle((84, y, 264, y + 18), BAR)
        draw.rectangle((min(zero, column), y, max(zero, column), y + 18), FILL)
        text = f"{action:+.3f}"
        if pin_us is not None:
            pin = car.pwm.channel(name).action(pin_us) or 0.0
            at = float(np.clip(zero + (one - zero) * pin, 84, 264))
            draw.rectangle((at - 1, y, at + 1, y + 18), PIN)
            text += f" | {pin_us:.0f} us"
        draw.text((10, y), name, INK, font)
        draw.text((272, y), text, INK, font)
    lines = [f"{moment.t_s:7.2f} s   {WHO.get(tick['state'], '')}"]
    if tick["plan_age_ms"] is not None:
        lines.append(f"plan {tick['plan_age_ms']:.0f} ms old, took {tick['latency_ms'] or 0:.0f} ms")
    lines.append(f"command {tick['late_ms'] or 0:.1f} ms late")
    draw.multiline_text((404, top + 8), "\n".join(lines), INK, font, spacing=6)
    below = f"{moment.event[:96]}\nahead: where the commands of the next second led"
    draw.multiline_text((10, top + 76), below, (154, 164, 173), ImageFont.load_default(12))

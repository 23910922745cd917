"""Faultless recordings, and changes of them."""

import math

import cv2
import numpy as np

from rover_lib.onboard.car.pwm import PwmCalibration
from rover_lib.onboard.recording.episode import About, EpisodeWriter
from rover_lib.workshop.recordings.episodes import load_recordings
from tests.helpers.recorded import edit_json

CHUNK = 8
PWM = PwmCalibration()
FRAME = np.full((18, 32, 3), (30, 90, 200), np.uint8)


def steering_at(t_s):
    return 0.6 * math.sin(1.5 * t_s)


def throttle_at(t_s):
    return 0.04 + 0.03 * math.cos(2 * t_s)


def record(root, name="episode_20260101_120000", frames=40, start_s=1000.0, first_s=0.1):
    """Record a faultless drive, with controls every 33 ms. first_s: from the first of them to the first frame.

    Its name's last two digits choose the drive: the same drive twice is left out.
    """
    later_s = 0.717 * int(name[-2:])
    folder = root / name
    with EpisodeWriter(folder, About("hit red balloon"), resolution=(32, 18)) as writer:
        for i in range(round((frames / 30 + 0.2) / 0.033)):
            t_s = i * 0.033
            pulses = PWM.pulses(steering_at(t_s + later_s), throttle_at(t_s + later_s))
            writer.control(start_s + t_s, 500 + 33 * i, pulses.steering_us, pulses.throttle_us, 21316, 1016)
        for i in range(frames):
            writer.frame(start_s + first_s + i / 30, FRAME)
    return folder


def edit(folder, change):
    """Rewrite a recording's JSON."""
    edit_json(folder / "episode_data.json", change)
    return folder


def kinds(recordings):
    return {kind: n for kinds in recordings.faults_by_kind().values() for kind, n in kinds.items()}


def load(root, **options):
    return load_recordings(root, **{"chunk": CHUNK, **options})


def redrawn(change):
    """A change of a recording: that of each of its pictures, encoded anew."""

    def redraw(folder):
        for path in (folder / "frames").iterdir():
            cv2.imwrite(str(path), change(cv2.imread(str(path))), [cv2.IMWRITE_JPEG_QUALITY, 40])

    return redraw


def burst(content, count=20):
    """The first controls waited in the buffer, and arrive 0.3 ms apart just before the next one."""
    controls = content["control_samples"]
    for k, control in enumerate(controls[:count]):
        control["system_timestamp"] = controls[count]["system_timestamp"] - 0.0003 * (count - k)


OLD = {"steering": (7, 2.42), "throttle": (0, 70)}


def rewritten(formulas, wrong=0, share=1.0):
    """Return a change of a recording: its actions, or those of the first `share` of it, as other formulas of the duty
    give them, `wrong` of them random.
    """

    def change(content):
        rng, rows = np.random.default_rng(0), content["control_samples"]
        for i, row in enumerate(rows[: round(share * len(rows))]):
            for name, (neutral, span) in formulas.items():
                low = -1 if name == "steering" else 0
                said = (100 * row[f"{name}_raw_us"] / row[f"{name}_period_us"] - neutral) / span
                said = float(rng.uniform(low, 1)) if i < wrong else min(max(said, low), 1)
                row[f"{name}_normalized"] = round(said, 4)

    return change

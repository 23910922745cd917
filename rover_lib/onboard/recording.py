"""Write one drive as an episode folder, in the format of the user's recorder.

episode_YYYYMMDD_HHMMSS/
  episode_data.json   control_data.csv   frame_data.csv   frames/frame_%06d.jpg
"""

import csv
import json
import math
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.pwm import PwmCalibration

CONTROL_FIELDS = (
    "arduino_timestamp",
    "system_timestamp",
    "steering_normalized",
    "throttle_normalized",
    "steering_raw_us",
    "throttle_raw_us",
    "steering_period_us",
    "throttle_period_us",
)
FRAME_FIELDS = ("frame_id", "timestamp", "image_path")


class EpisodeWriter:
    """Collect one episode; the folder appears, complete, when the `with` block ends well, and not otherwise.

    folder: Path to make, e.g. episodes/episode_20251007_144013; its name is the episode's id. Must not exist.
    label: what was done, e.g. "hit red balloon". fps: the camera's rate. resolution: (width, height).
    start_time_s, end_time_s: system time of the recording's ends; the first and last sample's when left out.
    Raises EpisodeError for an existing folder, frames of another size, times or pulses that are no finite
    numbers, or an episode without a frame or a control.
    """

    def __init__(
        self,
        folder: Path | str,
        *,
        label: str,
        fps: float = 30,
        resolution: tuple[int, int] = (640, 360),
        start_time_s: float | None = None,
        end_time_s: float | None = None,
        arduino_port: str = "",
        jpeg_quality: int = 95,
        pwm: PwmCalibration | None = None,
    ):
        self.folder = Path(folder)
        self.label, self.fps, self.resolution = str(label), fps, (int(resolution[0]), int(resolution[1]))
        self.start_time_s, self.end_time_s = start_time_s, end_time_s
        self.arduino_port, self.jpeg_quality = arduino_port, jpeg_quality
        self.pwm = pwm or PwmCalibration()
        self._controls: list[dict[str, Any]] = []
        self._frames: list[dict[str, Any]] = []
        self._temporary: Path | None = None

    def __enter__(self) -> "EpisodeWriter":
        self._refuse_existing()
        self.folder.parent.mkdir(parents=True, exist_ok=True)
        # beside the target, so that the rename stays within one filesystem; hidden from loaders
        self._temporary = Path(tempfile.mkdtemp(dir=self.folder.parent, prefix=f".{self.folder.name}."))
        (self._temporary / "frames").mkdir()
        return self

    def __exit__(self, kind, error, trace) -> None:
        try:
            if kind is None:
                self._finish()
        finally:
            shutil.rmtree(self._temporary, ignore_errors=True)
            self._temporary = None

    def control(
        self,
        t_system_s: float,
        arduino_ms: int,
        steering_us: int,
        throttle_us: int,
        steering_period_us: int,
        throttle_period_us: int,
    ) -> None:
        """Add one reading of the transmitter. Pulses and periods of 0 say "not measured".

        The normalised values follow the firmware's rule: 4 decimals, 0 where no pulse was measured.
        """
        self._must_be_open()
        whole = {
            "arduino_timestamp": arduino_ms,
            "steering_raw_us": steering_us,
            "throttle_raw_us": throttle_us,
            "steering_period_us": steering_period_us,
            "throttle_period_us": throttle_period_us,
        }
        for name, value in whole.items():
            if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 0:
                raise EpisodeError(f"{self.folder.name}: {name} must be a whole number from 0, found {value!r}")
            whole[name] = int(value)
        actions = self.pwm.actions_from_pulses(steering_us, throttle_us, steering_period_us, throttle_period_us)
        row = {
            "system_timestamp": self._time(t_system_s),
            "steering_normalized": round(actions.steering or 0.0, 4) + 0.0,  # + 0.0: no "-0.0" in the file
            "throttle_normalized": round(actions.throttle or 0.0, 4) + 0.0,
            **whole,
        }
        self._controls.append({name: row[name] for name in CONTROL_FIELDS})

    def frame(self, t_s: float, frame_bgr: np.ndarray) -> None:
        """Add one picture: (height, width, 3) uint8 BGR of that resolution, at system time `t_s`."""
        self._must_be_open()
        t_s = self._time(t_s)
        shape = (self.resolution[1], self.resolution[0], 3)
        if not isinstance(frame_bgr, np.ndarray) or frame_bgr.shape != shape or frame_bgr.dtype != np.uint8:
            found = f"{getattr(frame_bgr, 'dtype', type(frame_bgr).__name__)} {getattr(frame_bgr, 'shape', '')}"
            raise EpisodeError(f"{self.folder.name}: frames must be uint8 {shape}, found {found}: check the camera")
        number = len(self._frames) + 1
        relative = f"frames/frame_{number:06d}.jpg"
        ok, jpeg = cv2.imencode(".jpg", frame_bgr, [cv2.IMWRITE_JPEG_QUALITY, self.jpeg_quality])
        if not ok:
            raise EpisodeError(f"{self.folder.name}: frame {number} could not be written as JPEG: check the camera")
        (self._temporary / relative).write_bytes(jpeg.tobytes())
        self._frames.append({"frame_id": number, "timestamp": t_s, "image_path": relative})

    def _must_be_open(self) -> None:
        if self._temporary is None:
            raise EpisodeError(f"{self.folder.name}: not open: use it as `with EpisodeWriter(...) as writer:`")

    def _time(self, t_s: float) -> float:
        try:
            found = float(t_s)
        except (TypeError, ValueError, OverflowError):
            found = math.nan
        if not math.isfinite(found):
            raise EpisodeError(f"{self.folder.name}: a time must be finite seconds, found {t_s!r}: check the clock")
        return found

    def _refuse_existing(self) -> None:
        if os.path.lexists(self.folder):
            raise EpisodeError(f"{self.folder}: exists already: name another folder, or move this one away first")

    def _finish(self) -> None:
        if not self._controls or not self._frames:
            raise EpisodeError(
                f"{self.folder.name}: {len(self._controls)} controls and {len(self._frames)} frames are no "
                "episode: check that the camera and the Arduino deliver"
            )
        times = [c["system_timestamp"] for c in self._controls] + [f["timestamp"] for f in self._frames]
        start_s = min(times) if self.start_time_s is None else self._time(self.start_time_s)
        end_s = max(times) if self.end_time_s is None else self._time(self.end_time_s)
        duration_s = end_s - start_s
        episode = {
            "episode_id": self.folder.name,
            "action_label": self.label,
            "start_time": start_s,
            "end_time": end_s,
            "duration": duration_s,
            "metadata": {
                "camera_fps": self.fps,
                "camera_resolution": list(self.resolution),
                "arduino_port": self.arduino_port,
                "total_control_samples": len(self._controls),
                "total_frames": len(self._frames),
                "avg_control_rate": len(self._controls) / duration_s if duration_s > 0 else 0,
                "avg_frame_rate": len(self._frames) / duration_s if duration_s > 0 else 0,
            },
            "control_samples": self._controls,
            "frame_samples": self._frames,
        }
        (self._temporary / "episode_data.json").write_text(json.dumps(episode, indent=2, allow_nan=False))
        for name, fields, rows in (
            ("control_data.csv", CONTROL_FIELDS, self._controls),
            ("frame_data.csv", FRAME_FIELDS, self._frames),
        ):
            with (self._temporary / name).open("w", newline="") as f:
                table = csv.DictWriter(f, fields)  # ends lines with CR LF, as the user's recorder did
                table.writeheader()
                table.writerows(rows)
        umask = os.umask(0)
        os.umask(umask)
        self._temporary.chmod(0o777 & ~umask)  # mkdtemp's 0700 would hide the episode from other users
        self._refuse_existing()  # rename would replace an empty folder without a word
        self._temporary.rename(self.folder)

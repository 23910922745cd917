"""Export our recordings as a LeRobotDataset v3, for `lerobot-train` and LeRobot's own tools.

    report = export_dataset("episodes", "my_dataset")

A row of that format is a picture, the state before it and the action at it, at a fixed rate; an episode has no holes.
What our reader repairs (readings that came in a burst, single lost pulses) is therefore repaired in the dataset. Where
a frame must be left out (a damaged picture, a hole in time, no measured pulse), the episode ends and another begins.
The report counts each of these, and stays in the dataset's folder. Read back, the dataset gives the samples of the
recordings.

If a policy drove in one of the recordings, each frame says in `intervention` whether a human had taken over from it, as
`lerobot-rollout` writes it when it collects corrections. A demonstration is no intervention. Frames at which nobody
drove are left out like a hole: the car did not do what the pulses beside its picture say, and whoever trains on a
LeRobotDataset trains on all of it. If every recording was labelled, the last frame of each episode says how its drive
ended, in LeRobot's `next.success`, `next.reward` and `next.done`.
"""

import json
import os
import warnings
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.params import params
from rover_lib.onboard.policy.preprocess import prepare_frame
from rover_lib.onboard.recording.episode import HIT, HUMAN, NOBODY, POLICY
from rover_lib.workshop.lerobot_moved import no_progress_bars
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.episodes import load_recordings
from rover_lib.workshop.recordings.lerobot_dataset import (
    ACTION,
    BACKEND,
    CAR,
    DRIVEN_BY,
    INTERVENTION,
    OUTCOMES,
    REPORT,
    STATE,
    SUCCESS,
)
from rover_lib.workshop.recordings.samples import (
    ACTION_NAMES,
    CAMERA,
    LEAST_RATED,
    Episode,
    Recordings,
    Sample,
    car_of,
    frame_rate_hz,
    is_another_rate,
)
from rover_lib.workshop.recordings.turning import measure_sides
from rover_lib.workshop.swap_folder import lock_folder

NAME = "cam_front"  # the camera's name, as in the trainer's policies
REWARD, DONE = "next.reward", "next.done"
SIDES_PX = 16, 8192  # smallest and largest side of a picture that an artifact takes
SHORTEST = 2  # rows in the shortest episode: a single row has no spread to normalise by


def export_dataset(
    episodes: Path | str | Recordings,
    out: Path | str,
    *,
    video: bool = False,
    size: tuple[int, int] | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Write all usable samples to `out`, a new folder, and return what was written and left out.

    episodes: the recordings, or the folder that has them.

    video: True writes AV1, LeRobot's default, which is far smaller but loses detail; False writes PNG inside parquet,
    which loses nothing. size: (height, width) to which the pictures are resized, as a rover resizes what its camera
    gives; None keeps the recorded size. The folder appears only when it is complete.

    Raises EpisodeError for recordings that cannot be used, that are of several cars or rates or, without `size`, have
    several picture sizes, for a size that no artifact takes, and if `out` exists; RoverError while another process
    makes `out`.
    """
    out = Path(out)
    if out.exists() or out.is_symlink():
        raise EpisodeError(f"{out}: is there already", remedy="give a new folder, or remove it")
    if size and not SIDES_PX[0] <= min(size) <= max(size) <= SIDES_PX[1]:
        raise EpisodeError(
            f"pictures must have {SIDES_PX[0]} to {SIDES_PX[1]} pixels a side", found=f"{size[1]}x{size[0]}"
        )
    if isinstance(episodes, Recordings):
        recordings = episodes
    else:
        recordings = load_recordings(episodes, chunk=2, sync_s=params()["calibration"]["sync_s"], progress=progress)
    if recordings.layout.rate_hz is not None:
        raise EpisodeError(f"{recordings.root}: is a LeRobotDataset already", remedy="use it as it is")
    rate_hz = usual_rate_hz(recordings)
    car = car_of(recordings.samples)
    with lock_folder(out.with_name(f".{out.name}.new")) as beside:
        new = beside / out.name
        report = _write(recordings, new, rate_hz, video, size, progress) | {CAR: car.description()}
        (new / REPORT).write_text(json.dumps(report, indent=2) + "\n")
        new.rename(out)
    return report


def usual_rate_hz(recordings: Recordings) -> int:
    """Return the frames per second of all episodes. Raises EpisodeError if they differ: a dataset has only one rate."""
    longest = max(len(e.samples) for e in recordings.episodes)
    long = [e for e in recordings.episodes if len(e.samples) >= min(longest, LEAST_RATED)]
    rates = {e.id: found for e in long if (found := frame_rate_hz(e.samples)) is not None}
    if not rates:
        raise EpisodeError(f"{recordings.root}: no episode of two frames", remedy="record longer ones")
    usual_hz = float(np.median(list(rates.values())))
    if odd := {name: found for name, found in rates.items() if is_another_rate(found, usual_hz)}:
        name, found_hz = next(iter(odd.items()))
        raise EpisodeError(
            f"{recordings.root}: most episodes have {usual_hz:.1f} frames a second, {len(odd)} have another rate",
            found=f"{found_hz:.1f} in {name}",
            remedy="export those of each rate by themselves",
        )
    return max(round(usual_hz), 1)


def _runs(samples: tuple[Sample, ...]) -> Iterator[list[Sample]]:
    """Yield runs of samples at which somebody drove, with no frame left out between two of them.

    A run also ends where a sample's chunk does not reach into the next frame.
    """
    driven = [sample for sample in samples if sample.driver != NOBODY]
    if not driven:
        return
    run = driven[:1]
    for before, after in pairwise(driven):
        if after.row == before.row + 1 and not before.is_pad[1]:
            run.append(after)
        else:
            yield run
            run = [after]
    yield run


def _write(
    recordings: Recordings, root: Path, rate_hz: int, video: bool, size: tuple[int, int] | None, progress: Progress
) -> dict[str, Any]:
    os.environ.setdefault("SVT_LOG", "1")  # without it the AV1 encoder prints its settings at every episode
    # Imported here, because it takes seconds that no other command should wait for.
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    recorded = recordings.samples[0].frame_bgr().shape
    shape = (*size, 3) if size else recorded
    numbers = {"dtype": "float32", "shape": (len(ACTION_NAMES),), "names": list(ACTION_NAMES)}
    extra = _ExtraColumns.of(recordings)
    picture = {"dtype": "video" if video else "image", "shape": shape, "names": ["height", "width", "channels"]}
    dataset = LeRobotDataset.create(
        repo_id=f"local/{root.name}",
        fps=rate_hz,
        features={f"{CAMERA}{NAME}": picture, STATE: numbers, ACTION: numbers, **extra.features},
        root=root,
        robot_type="rover",
        use_videos=video,
        video_backend=BACKEND,
    )
    short, broken = 0, 0
    lengths: list[int] = []
    origins: list[str] = []
    driven_by: list[str] = []
    outcomes: list[str | None] = []
    with no_progress_bars(), warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", "Converting input from bool"
        )  # numpy warns when LeRobot computes statistics of yes and no
        for episode in progress(recordings.episodes, desc="exporting", total=len(recordings.episodes)):
            for run in _runs(episode.samples):
                for rows, unread in _readable(run, size, recorded):
                    broken += unread
                    if len(rows) < SHORTEST:
                        short += len(rows)
                        continue
                    for sample, frame in rows:
                        dataset.add_frame(
                            {
                                f"{CAMERA}{NAME}": frame,
                                STATE: sample.state,
                                ACTION: sample.chunk[0],
                                "task": episode.label or "drive",
                                **extra.of_frame(episode, sample, last=sample is rows[-1][0]),
                            }
                        )
                    dataset.save_episode()
                    lengths.append(len(rows))
                    driven_by.append(POLICY if episode.by_policy else HUMAN)
                    outcomes.append(episode.outcome)
                    origins.append(f"{episode.id} from frame {rows[0][0].row}")
        dataset.finalize()
    if not lengths:
        raise EpisodeError(f"{recordings.root}: no two whole frames in a row", remedy="record again")
    return {
        "dataset": "LeRobotDataset v3, " + ("AV1 video" if video else "images"),
        "pictures": f"{shape[1]}x{shape[0]}" + ("" if shape == recorded else f", recorded {recorded[1]}x{recorded[0]}"),
        "episodes": len(origins),
        "frames": sum(lengths),
        "frames_in_a_usual_episode": int(np.median(lengths)),
        "frames_a_second": rate_hz,
        "recorded_episodes": len(recordings.episodes),
        "left_out_pictures_not_whole": broken,
        "left_out_too_short": short,
        "left_out_nobody_drove": sum(s.driver == NOBODY for s in recordings.samples),
        "recomputed": recordings.recomputed() or "no action",
        "steering": measure_sides(recordings, progress).words(),
        "faults": recordings.faults_by_kind(),
        "faults_while_reading": [asdict(fault) for fault in recordings.faults],
        "episodes_are": origins,
        DRIVEN_BY: driven_by,
        OUTCOMES: outcomes,
    }


@dataclass(frozen=True)
class _ExtraColumns:
    """Which extra columns the dataset has.

    intervention: there because a policy drove in some recording. outcome: there because every recording was labelled.
    """

    intervention: bool
    outcome: bool

    @classmethod
    def of(cls, recordings: Recordings) -> "_ExtraColumns":
        return cls(any(e.by_policy for e in recordings.episodes), all(e.outcome for e in recordings.episodes))

    @property
    def features(self) -> dict[str, Any]:
        """Return the features that declare these columns, as LeRobot's own commands declare them."""

        def one(dtype: str) -> dict[str, Any]:
            return {"dtype": dtype, "shape": (1,), "names": None}

        features = {INTERVENTION: one("bool")} if self.intervention else {}
        return features | ({REWARD: one("float32"), DONE: one("bool"), SUCCESS: one("bool")} if self.outcome else {})

    def of_frame(self, episode: Episode, sample: Sample, last: bool) -> dict[str, Any]:
        """Return one frame's values of these columns. last: whether its episode in the dataset ends with it."""
        row: dict[str, Any] = {}
        if self.intervention:
            row[INTERVENTION] = np.array([sample.driver == HUMAN and episode.by_policy])
        if self.outcome:
            hit = last and episode.outcome == HIT
            row |= {REWARD: np.array([hit], np.float32), DONE: np.array([last]), SUCCESS: np.array([hit])}
        return row


def _readable(
    run: list[Sample], size: tuple[int, int] | None, recorded: tuple[int, ...]
) -> Iterator[tuple[list[tuple[Sample, np.ndarray]], int]]:
    """Yield the parts of a run between pictures that cannot be decoded, each as samples with their RGB frames.

    The number beside each part is 1 if such a picture ends it, and 0 for the last.
    """
    rows: list[tuple[Sample, np.ndarray]] = []
    for sample in run:
        try:
            frame = sample.frame_bgr()
        except EpisodeError:
            yield rows, 1
            rows = []
            continue
        if size is None and frame.shape != recorded:
            raise EpisodeError(
                f"{sample.frame_path}: a picture of {frame.shape[1]}x{frame.shape[0]} among those of "
                f"{recorded[1]}x{recorded[0]}",
                remedy="export the episodes of each size by themselves, or all at one: --size",
            )
        rows.append((sample, prepare_frame(frame, *(size or recorded[:2]))))
    yield rows, 0

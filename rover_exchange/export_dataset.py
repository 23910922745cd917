"""Export our recordings as a LeRobotDataset v3, for `lerobot-train` and LeRobot's own tools.

What our reader repairs is repaired in the dataset. Where a frame must be left out, the episode ends and another begins.
If a policy drove in one of the recordings, `intervention` says where a human had taken over, as in `lerobot-rollout`.
"""

import json
import os
import shlex
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from rover_lib.onboard.durable import build_folder
from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.params import params
from rover_lib.onboard.policy.preprocess import prepare_frame
from rover_lib.onboard.recording.episode import HUMAN, NOBODY, POLICY
from rover_lib.workshop.pictures.turning import measure_sides
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings import samples as recorded_as
from rover_lib.workshop.recordings.episodes import load_recordings
from rover_lib.workshop.recordings.lerobot_dataset import CAR, DRIVEN_BY, INTERVENTION, REPORT
from rover_lib.workshop.recordings.names import ACTION, CAMERA, STATE
from rover_lib.workshop.recordings.samples import ACTION_NAMES, LEAST_RATED, Episode, Recordings, Sample
from rover_lib.workshop.recordings.source import Source
from rover_lib.workshop.states import OTHER_STATE

NAME = "cam_front"  # the camera's name, as in the trainer's policies
SIDES_PX = 16, 8192  # smallest and largest side of a picture that an artifact takes
SHORTEST = 2  # rows in the shortest episode: a single row has no spread to normalise by


def export_dataset(
    episodes: Path | str | Source,
    out: Path | str,
    *,
    size: tuple[int, int] | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Write all usable samples to `out`, a new folder, once it is complete, and return what was written and left out.

    episodes: the recordings' folder, or its Source. Pictures become PNG in parquet; `lerobot-edit-dataset` makes videos
    of them. size: (height, width) to which the pictures are resized; None keeps the recorded size. Raises EpisodeError
    for recordings that cannot be used, of several cars, rates or (without `size`) picture sizes, a size that no
    artifact takes, and an existing `out`; RoverError while another process makes `out`.
    """
    out = Path(out)
    if out.exists() or out.is_symlink():
        raise EpisodeError(f"{out}: is there already", remedy="give a new folder, or remove it")
    smallest, largest = SIDES_PX
    if size and not smallest <= min(size) <= max(size) <= largest:
        raise EpisodeError(f"pictures must have {smallest} to {largest} pixels a side", found=f"{size[1]}x{size[0]}")
    recordings = load_recordings(episodes, chunk=2, sync_s=params()["calibration"]["sync_s"], progress=progress)
    if recordings.layout.rate_hz is not None and not any(fault.kind == OTHER_STATE for fault in recordings.faults):
        raise EpisodeError(f"{recordings.root}: is a LeRobotDataset already", remedy="use it as it is")
    rate_hz = usual_rate_hz(recordings)
    car = recorded_as.car_of(recordings.samples)
    with build_folder(out) as new:
        dataset_folder = new / "dataset"  # LeRobot makes its folder itself
        report = _write(recordings, dataset_folder, rate_hz, size, progress) | {CAR: car.description()}
        for path in dataset_folder.iterdir():
            path.rename(new / path.name)
        dataset_folder.rmdir()
        (new / REPORT).write_text(json.dumps(report, indent=2) + "\n")
    return report


def usual_rate_hz(recordings: Recordings) -> float:
    """Return the frames per second of all episodes, as a whole number unless plans would last longer or shorter by it.

    Raises EpisodeError if they differ: a dataset has only one rate.
    """
    longest = max(len(e.samples) for e in recordings.episodes)
    rates: dict[str, float] = {}
    for episode in recordings.episodes:
        rate_hz = recorded_as.frame_rate_hz(episode.samples)
        if rate_hz is not None and len(episode.samples) >= min(longest, LEAST_RATED):
            rates[episode.id] = rate_hz
    if not rates:
        raise EpisodeError(f"{recordings.root}: no episode of two frames", remedy="record longer ones")
    usual_hz = float(np.median(list(rates.values())))
    if odd := {name: rate_hz for name, rate_hz in rates.items() if recorded_as.is_another_rate(rate_hz, usual_hz)}:
        problem = f"{recordings.root}: most episodes have {usual_hz:.1f} frames a second, {len(odd)} have another rate"
        name, odd_hz = next(iter(odd.items()))
        raise EpisodeError(problem, found=f"{odd_hz:.1f} in {name}", remedy="export those of each rate by themselves")
    return recorded_as.round_rate_hz(usual_hz)


def _parts(
    episode: Episode, size: tuple[int, int] | None, recorded_shape: tuple[int, ...], left_out: Counter[str]
) -> Iterator[list[tuple[Sample, np.ndarray]]]:
    """Yield the parts of an episode that have no hole, as samples with their RGB frames; a part may be empty.

    A part also ends where a sample's chunk does not reach into the next frame. left_out: counts what is no part's.
    Raises EpisodeError for a picture of another size than `recorded` if there is no `size`, (height, width).
    """
    rows: list[tuple[Sample, np.ndarray]] = []
    for sample in episode.samples:
        if rows and (sample.row != rows[-1][0].row + 1 or rows[-1][0].is_pad[1]):
            yield rows
            rows = []
        if sample.driver == NOBODY:
            left_out["nobody_drove"] += 1
            continue
        frame = sample.frame_bgr()
        if size is None and frame.shape != recorded_shape:
            sizes = f"{frame.shape[1]}x{frame.shape[0]} among those of {recorded_shape[1]}x{recorded_shape[0]}"
            raise EpisodeError(f"{sample.frame_path}: a picture of {sizes}", remedy="export all at one --size")
        rows.append((sample, prepare_frame(frame, *(size or recorded_shape[:2]))))
    yield rows


def _write(
    recordings: Recordings, root: Path, rate_hz: float, size: tuple[int, int] | None, progress: Progress
) -> dict[str, Any]:
    # Imported here, because it takes seconds that no other command should wait for.
    from datasets import disable_progress_bars
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    disable_progress_bars()
    episodes = recordings.episodes
    recorded_shape = recordings.samples[0].frame_bgr().shape
    shape = (*size, 3) if size else recorded_shape
    by_policy = any(e.by_policy for e in episodes)
    dataset = LeRobotDataset.create(
        repo_id=f"local/{root.name}",
        fps=rate_hz,
        features=_features(shape, by_policy),
        root=root,
        robot_type="rover",
        use_videos=False,
        image_writer_threads=min(4, os.cpu_count() or 1),  # half of the time goes into compressing PNG
    )
    left_out: Counter[str] = Counter(too_short=0, nobody_drove=0)
    rows_written: list[tuple[Episode, int, int]] = []  # the episode, the first frame, how many frames
    with warnings.catch_warnings():
        # numpy warns when LeRobot computes statistics of yes and no
        warnings.filterwarnings("ignore", "Converting input from bool")
        try:
            for episode in progress(episodes, desc="exporting", total=len(episodes)):
                for rows in _parts(episode, size, recorded_shape, left_out):
                    if len(rows) < SHORTEST:
                        left_out["too_short"] += len(rows)
                        continue
                    for sample, frame in rows:
                        row = _row(episode, sample, frame)
                        dataset.add_frame({k: v for k, v in row.items() if k in dataset.features or k == "task"})
                    dataset.save_episode()
                    rows_written.append((episode, rows[0][0].row, len(rows)))
        finally:  # else it would be done at some later time, in a folder that is gone
            if hasattr(dataset, "stop_image_writer"):  # else finalize() does it
                dataset.stop_image_writer()
            dataset.finalize()
    if not rows_written:
        raise EpisodeError(f"{recordings.root}: no two whole frames in a row", remedy="record again")
    lengths = [count for _, _, count in rows_written]
    return {
        "dataset": "LeRobotDataset v3, images",
        "pictures": f"{shape[1]}x{shape[0]}"
        + ("" if shape == recorded_shape else f", recorded {recorded_shape[1]}x{recorded_shape[0]}"),
        "episodes": len(rows_written),
        "frames": sum(lengths),
        "frames_in_a_usual_episode": int(np.median(lengths)),
        "frames_a_second": rate_hz,
        "recorded_episodes": len(episodes),
        **{f"left_out_{reason}": count for reason, count in left_out.items()},
        "recomputed": recordings.recomputed() or "no action",
        "steering": measure_sides(recordings, progress).words(),
        "faults": recordings.faults_by_kind(),
        "faults_while_reading": [asdict(fault) for fault in recordings.faults],
        "episodes_are": [f"{episode.id} from frame {first}" for episode, first, _ in rows_written],
        DRIVEN_BY: [POLICY if episode.by_policy else HUMAN for episode, _, _ in rows_written],
    }


def _features(shape: tuple[int, ...], by_policy: bool) -> dict[str, Any]:
    """Return the dataset's columns, as LeRobot's own commands declare them."""
    picture = {"dtype": "image", "shape": shape, "names": ["height", "width", "channels"]}
    numbers = {"dtype": "float32", "shape": (len(ACTION_NAMES),), "names": list(ACTION_NAMES)}
    features: dict[str, Any] = {f"{CAMERA}{NAME}": picture, STATE: numbers, ACTION: numbers}
    if by_policy:
        features[INTERVENTION] = {"dtype": "bool", "shape": (1,), "names": None}
    return features


def _row(episode: Episode, sample: Sample, frame: np.ndarray) -> dict[str, Any]:
    """Return one frame's values of all columns that a dataset can have."""
    return {
        f"{CAMERA}{NAME}": frame,
        STATE: sample.state,
        ACTION: sample.chunk[0],
        INTERVENTION: np.array([sample.driver == HUMAN and episode.by_policy]),
        "task": episode.label or "drive",
    }


def lerobot_train(dataset: Path | str) -> str:
    """Return the command of LeRobot's own that trains an ACT on a LeRobotDataset."""
    return (
        f"lerobot-train --dataset.repo_id=local/drives {shlex.quote(f'--dataset.root={dataset}')} --policy.type=act "
        "--policy.push_to_hub=false --policy.chunk_size=32 --policy.n_action_steps=32 --output_dir=trained"
    )


def lerobot_video(dataset: Path | str) -> str:
    """Return the command of LeRobot's own that makes videos of a LeRobotDataset's pictures, in <dataset>-video."""
    return (
        f"lerobot-edit-dataset --repo_id=local/drives {shlex.quote(f'--root={dataset}')} "
        f"--operation.type=convert_image_to_video {shlex.quote(f'--operation.output_dir={dataset}-video')}"
    )

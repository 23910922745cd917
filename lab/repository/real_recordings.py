"""What real recordings say, and what policies plan on them: results/real/recordings.json. Nobody drove.

tell_of("recordings", {"demo": "runs/demo-on-real"}, progress=...)      # what `python -m lab real` does
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rover_lib.onboard.car.camera import Camera
from rover_lib.onboard.drive.pilot import Sight
from rover_lib.onboard.drive.plan import Settings
from rover_lib.onboard.errors import CameraError
from rover_lib.onboard.params import params
from rover_lib.onboard.policy.load import load_policy
from rover_lib.onboard.stage import read_stage
from rover_lib.workshop.judge.compare import Fidelity, fidelity
from rover_lib.workshop.judge.guesses import against_guesses
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.episodes import load_recordings
from rover_lib.workshop.recordings.samples import Recordings, car_of, pick_evenly
from rover_lib.workshop.recordings.turning import measure_sides
from rover_lib.workshop.run.session import open_run

FRAMES = 120  # of a run's held-out frames


def tell_of(
    recordings: Path | str,
    runs: Mapping[str, Path] = {},
    elsewhere: Path | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Return the metrics of recordings.json.

    runs: name -> folder that `rover run` left on these recordings. elsewhere: a run on other recordings: if it is of
    the same checkpoint, its static artifact, calibrated there, is held against FP32 here too. Raises as reading does.
    """
    read = load_recordings(recordings, progress=progress)
    sides = measure_sides(read, progress)
    return {
        "episodes": len(read.episodes),
        "samples": len(read.samples),
        "recomputed": read.recomputed(),
        "faults": read.faults_by_kind(),
        "side": sides.words(),
        "turnings": {t.episode: {k: getattr(t, k) for k in ("correlation", "sure", "spread")} for t in sides.turnings},
        "camera": watch_pictures(read, progress),
        "guesses_pct": guess_each(read),
        "policies": {name: _policy(folder, elsewhere, progress) for name, folder in runs.items()},
    }


def watch_pictures(recordings: Recordings, progress: Progress = silent) -> dict[str, Any]:
    """Show all pictures to the camera's watch as to a car that drives, and count those at which it would stop.

    frozen: of these stops, those at a picture that is the one before it, byte for byte, as the recorded camera, or its
    program, had stopped. least: of all pictures, the contrast and the mean, in grey levels. most_equal: in a row.
    """
    settings, stops, frozen, frames = Settings.of(params()["drive"]), 0, 0, []
    for episode in progress(recordings.episodes, desc="watching the camera"):
        camera = Camera(episode.path)
        sight, before = Sight(camera, settings), np.empty(0)
        for sample in episode.samples:
            camera.add(sample.frame_bgr(), sample.time_s, None)
            if (frame := camera.latest()) is None:
                continue
            sight.sent(sample.time_s, settings.throttle_limit)
            try:
                sight.watch(frame, sample.time_s)
            except CameraError:
                stops += 1
                frozen += np.array_equal(frame.image, before)
            before = frame.image
            frames.append((frame.contrast, frame.mean, frame.repeats + 1))
    contrasts, means, equal = zip(*frames, strict=True)
    least = {"contrast": min(contrasts), "mean": min(means)}
    return {"pictures": len(frames), "stops": stops, "frozen": frozen, "least": least, "most_equal": max(equal)}


def guess_each(recordings: Recordings) -> dict[str, dict[str, dict[str, float]]]:
    """Return how far off each guess is on each episode, knowing only the others, in percent of the recorded range."""
    found, ranges = {}, recordings.action_range()
    for own in recordings.episodes:
        others = [s for e in recordings.episodes if e is not own for s in e.samples]
        recorded, is_pad = np.stack([s.chunk for s in own.samples]), np.stack([s.is_pad for s in own.samples])
        report = Fidelity(
            recordings.layout.action_names, ranges, own.samples, recorded, {}, recorded, is_pad, car_of(own.samples)
        )
        judged = against_guesses(report, others)
        found[own.id] = {g.name: g.errors_pct for g in judged.guesses} if judged else {}
    return found


def _policy(folder: Path, elsewhere: Path | None, progress: Progress) -> dict[str, Any]:
    compared, run = (read_stage(Path(folder) / f"{name}.json", name)["metrics"] for name in ("compare", "run"))
    static = compared["modes"]["static"]
    told = {"verdict": run["headline"], "against_driver": compared["guesses"], "static": _errors(static)}
    fp32 = load_policy(Path(folder) / "policy_fp32.pt")
    other = {"static": load_policy(Path(elsewhere) / "policy_static.pt")} if elsewhere else {}
    if other and other["static"].manifest["checkpoint"] == fp32.manifest["checkpoint"]:
        again = open_run(folder)
        frames = pick_evenly(again.parts.held_out, FRAMES)
        report = fidelity(fp32, other, frames, again.recordings.action_range(), progress)
        told["calibrated_elsewhere"] = _errors(report.summary("static"))
    return told


def _errors(found: Mapping[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in found.items() if k.endswith(("_mae_pct", "_of_spread_pct"))}

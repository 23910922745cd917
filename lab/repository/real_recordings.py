"""What real recordings say, and what policies plan on them: results/real/recordings.json. Nobody drove.

tell_of("recordings", {"demo": "runs/demo-on-real"}, progress=...)      # what `python -m lab real` does
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from lab.shorten import shorten
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
from rover_lib.workshop.recordings.samples import Episode, Recordings, car_of, pick_evenly
from rover_lib.workshop.recordings.turning import measure_sides
from rover_lib.workshop.run.session import open_run

FRAMES = 120  # of a run's held-out frames
SEEN = (16, 12)  # width and height of the pictures that the small models of `learn_each` see
STIFF = (1e2, 1e3, 1e4)  # how much the weights of these cost; the best is taken, so that the picture gets every chance
FADES = np.append(np.exp(-1 / np.array([5, 10, 20, 40, 80])), 1.0)  # of the last steering, a step


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
        "turnings": shorten(
            {t.episode: {k: getattr(t, k) for k in ("correlation", "sure", "spread")} for t in sides.turnings}
        ),
        "camera": watch_pictures(read, progress),
        "guesses_pct": shorten(guess_each(read)),
        "learned": learn_each(read, sides.mirrored, progress),
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


def learn_each(recordings: Recordings, mirrored: Sequence[str], progress: Progress = silent) -> dict[str, Any]:
    """Say how well small models plan each recording from the others: by the last action alone, and with the picture.

    fade: the last steering, that fades by as much a step as fits the others best, and the last throttle. The others add
    to it, or stand alone, by ridge regression on a thumbnail and how red it is, seen mirrored too. Each is held against
    the guesses as a verdict does, over all recordings; here the guesses know those, which makes them better. curve:
    the error of fade and picture, by the number of recordings to learn from; its end, of a + b / number. mirrored:
    episodes to turn over.
    """
    episodes = [_seen(e, e.id in mirrored) for e in progress(recordings.episodes, desc="looking")]

    def judge(plans: np.ndarray) -> dict[str, Any]:
        judged = against_guesses(_report(recordings, plans), recordings.samples)
        assert judged is not None
        better = {g.name: f"{g.better:.2f} ({g.low:.2f} to {g.high:.2f})" for g in judged.guesses}
        return {"errors_pct": {k: round(e, 2) for k, e in judged.errors_pct.items()}, "better": better}

    found: dict[str, Any] = {"curve": {}}
    for name, looks, stands in (("fade", False, True), ("fade and picture", True, True), ("picture", True, False)):
        each = [judge(_plan_each(episodes, len(episodes) - 1, looks, stands, c)) for c in (STIFF if looks else (0.0,))]
        found[name] = min(each, key=lambda j: sum(j["errors_pct"].values()))
    for count in range(1, len(episodes)):
        by_others = [
            judge(_plan_each(episodes, count, True, True, STIFF[-1], skip)) for skip in range(1, len(episodes))
        ]
        found["curve"][count] = np.mean([list(j["errors_pct"].values()) for j in by_others], 0).round(2).tolist()
    line = np.stack([np.ones(len(found["curve"])), [1 / n for n in found["curve"]]], 1)
    found["curve_ends_at"] = (
        np.linalg.lstsq(line, np.array([*found["curve"].values()]), rcond=None)[0][0].round(2).tolist()
    )
    return found


def _seen(episode: Episode, mirrored: bool) -> list[tuple[np.ndarray, ...]]:
    """Return what a model sees (n, features), the states (n, 2) and chunks (n, C, 2): as they are, and mirrored."""
    small = np.stack([cv2.resize(s.frame_bgr(), SEEN, interpolation=cv2.INTER_AREA) for s in episode.samples]) / 255
    small = small[:, :, ::-1] if mirrored else small
    red = (small[..., 2:] - small[..., :2].max(-1, keepdims=True)).clip(0)
    both = np.concatenate([small.mean(-1, keepdims=True), red], -1)
    views: list[tuple[np.ndarray, ...]] = []
    states, chunks = np.stack([s.state for s in episode.samples]), np.stack([s.chunk for s in episode.samples])
    for turned, side in ((both, (1, 1)), (both[:, :, ::-1], (-1, 1))):
        views.append((turned.reshape(len(both), -1), states * side, chunks * side))
    return views


def _plan_each(
    episodes: Sequence[Any], count: int, looks: bool, stands: bool, stiff: float, skip: int = 0
) -> np.ndarray:
    """Return each recording's plans, by `count` of the others; which, by `skip`."""
    plans = []
    for i, own in enumerate(episodes):
        others = [episodes[(i + 1 + (skip + k) % (len(episodes) - 1)) % len(episodes)] for k in range(count)]
        seen, states, chunks = (np.concatenate(part) for part in zip(*(v for e in others for v in e), strict=True))
        steps = np.arange(chunks.shape[1])
        fade = min(FADES, key=lambda f: np.abs(states[:, :1] * f**steps - chunks[..., 0]).mean())

        def held(states: np.ndarray, fade: float = fade, steps: np.ndarray = steps) -> np.ndarray:
            return stands * states[:, None] * np.stack([fade**steps, 1.0 + 0 * steps], -1)

        plan = held(own[0][1])
        if looks:
            mean, spread = seen.mean(0), seen.std(0) + 1e-2
            x, y = (seen - mean) / spread, (chunks - held(states)).reshape(len(seen), -1)
            weights = np.linalg.solve(x.T @ x + stiff * np.eye(x.shape[1]), x.T @ (y - y.mean(0)))
            plan = plan + ((own[0][0] - mean) / spread @ weights + y.mean(0)).reshape(plan.shape)
        plans.append(plan)
    return np.concatenate(plans).clip((-1, 0), 1).astype(np.float32)


def _report(recordings: Recordings, plans: np.ndarray) -> Fidelity:
    samples = recordings.samples
    recorded, is_pad = np.stack([s.chunk for s in samples]), np.stack([s.is_pad for s in samples])
    names, ranges = recordings.layout.action_names, recordings.action_range()
    return Fidelity(names, ranges, samples, plans, {}, recorded, is_pad, car_of(samples))


def _policy(folder: Path, elsewhere: Path | None, progress: Progress) -> dict[str, Any]:
    compared, run = (read_stage(Path(folder) / f"{name}.json", name)["metrics"] for name in ("compare", "run"))
    static = compared["modes"]["static"]
    against = {k: v for k, v in compared["guesses"].items() if k != "warnings"}
    told = {"verdict": run["headline"], "against_driver": against, "static": _errors(static)}
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

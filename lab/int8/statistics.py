"""Small policies whose frozen statistics were measured on other pictures than they drive in.

    content = judge_statistics("runs/demo/episodes", "runs/statistics", trainings=6)

Our own training measures the statistics of batch norm on the data that it drives in; a policy that comes from elsewhere
brings others, and may answer some frames far more strongly. Each training is done with each of STATISTICS, calibrated
and quantized as a run does it, and judged on held-out frames against its own plans in FP32.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rover_learn.train import TrainingRecipe, _train
from rover_learn.training import Resumable
from rover_lib.onboard.params import params
from rover_lib.onboard.stage import atomic_path, read_stage, write_stage
from rover_lib.workshop.act import ActConfig
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint
from rover_lib.workshop.int8.choose import Chooser
from rover_lib.workshop.int8.frames import describe_odd
from rover_lib.workshop.int8.observe import calibrate
from rover_lib.workshop.int8.quantize import quantize
from rover_lib.workshop.judge.compare import gate
from rover_lib.workshop.judge.recorded_range import worst
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.episodes import load_recordings, split
from rover_lib.workshop.recordings.samples import Recordings, pick_evenly
from rover_lib.workshop.run.pipeline import Recipe, prepare_chooser
from rover_lib.workshop.run.session import Opened

BLACK = -2.0  # about what normalised black is
STATISTICS: dict[str, Callable[[Tensor], Tensor]] = {
    "own": lambda seen: seen,
    "a dim room": lambda seen: BLACK + 0.3 * (seen - BLACK),
    "a bright room": lambda seen: (BLACK + 2 * (seen - BLACK)).clamp(max=2.4),
    "one picture": lambda seen: seen[:1].expand_as(seen),
    "no colours": lambda seen: seen.mean(1, keepdim=True).expand_as(seen),
}
SIZE = ActConfig(
    image_sizes=((48, 80),), dim=96, heads=4, feedforward=384, encoder_layers=1, decoder_layers=1, vae_layers=1
)
RECIPE = TrainingRecipe(200, 500, 30, 16, 16, 16, samples=2000, feature_samples=1500, judged=100)
LIMIT_PCT = 1.0  # static INT8 is at most this far off
MUST_HOLD = 28 / 30  # of the policies


def judge_statistics(
    episodes: Path | str,
    folder: Path | str,
    trainings: int = 6,
    recipe: TrainingRecipe = RECIPE,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Train and judge every policy that folder/statistics.json does not have yet, and return its content.

    Each row has the policy's training, its statistics, its odd frames, the observer that was chosen, and the errors of
    static INT8. After a kill the same call goes on with the policy that was not done.
    """
    folder = Path(folder)
    path = folder / "statistics.json"
    rows = read_stage(path, "statistics")["metrics"]["policies"] if path.is_file() else []
    done = {(row["training"], row["statistics"]) for row in rows}
    todo = [(seed, name) for seed in range(trainings) for name in STATISTICS if (seed, name) not in done]
    for seed, name in progress(todo, desc="policies"):
        rows.append({"training": seed, "statistics": name, **_judge(Path(episodes), folder, seed, name, recipe)})
        held = sum(row["passed"] for row in rows)
        gates = [gate("policies that hold, share", held / len(rows), ">=", MUST_HOLD)]
        write_stage(path, "statistics", params={"limit_pct": LIMIT_PCT}, metrics={"policies": rows, "gates": gates})
    return read_stage(path, "statistics")


def _judge(episodes: Path, folder: Path, seed: int, name: str, recipe: TrainingRecipe) -> dict[str, Any]:
    p = params()
    recordings = load_recordings(episodes, SIZE.chunk, p["calibration"]["sync_s"])
    parts = split(recordings, p["calibration"]["held_out_share"], p["calibration"]["seed"])
    weights = _weights(recordings, folder, seed, name, recipe)
    checkpoint = Checkpoint(folder, "trainer", SIZE, weights, f"{seed} {name}", {})
    how = Recipe.of(p)
    calibration = calibrate(checkpoint, how.choose(parts.calibration)[0], smooth=how.scheme.smooth)
    loaded = Opened(checkpoint, recordings, parts)
    scheme, _ = prepare_chooser(checkpoint, loaded, calibration).observer(how.scheme, how.observers)
    judge = Chooser(checkpoint, calibration, pick_evenly(parts.held_out, 120), recordings.action_range())
    errors = judge.error(quantize(checkpoint, scheme, calibration).module)
    by_histogram = judge.error(quantize(checkpoint, how.scheme, calibration).module)
    return {
        "odd": describe_odd(calibration.frames, calibration.seen),
        "observer": scheme.observer,
        **errors,
        "passed": (worst(errors) or 0.0) <= LIMIT_PCT,
        "histogram": by_histogram,
    }


def _weights(recordings: Recordings, folder: Path, seed: int, name: str, recipe: TrainingRecipe) -> dict[str, Tensor]:
    """Train the policy, unless an earlier call did. All of a training's backbones learn the same before their
    statistics are measured, so that only the first of them does.
    """
    policy, phases = folder / f"{seed}-{name.replace(' ', '-')}.pt", folder / f"training-{seed}"
    if not policy.is_file():
        with Resumable(phases) as saved:
            trained = _train(recordings, SIZE, recipe, seed, torch.device("cpu"), saved, STATISTICS[name])
        with atomic_path(policy) as temporary:
            torch.save(trained["model_state_dict"], temporary)
        for left in phases.iterdir():
            if left.name not in ("backbone.pt", "lock"):
                left.unlink()
    return {k.removeprefix("model."): v for k, v in torch.load(policy, weights_only=True).items()}

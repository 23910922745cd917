"""What becomes of recordings of real cars: a policy, a small CNN on the same split, INT8, a verdict, what is strange.

    python -m research.real_cars results/real/cars.json cars.yml

cars.yml has, by a name for the place: `tub`, its folder; `camera`; maybe `throttle`, as of `rover run`; `run`, the
folder of `rover run`, whose checkpoint is the policy; `cnn`, what research.donkey_cnn wrote of the tub. What has no run
is only shown to the others' policies. Nothing of the recordings goes into cars.json but these figures.
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from research.donkey_cnn import AHEAD_S, r2
from rover_learn.judges import Judges
from rover_lib.onboard.drive.plan import Smoother, is_unfamiliar
from rover_lib.onboard.params import params
from rover_lib.onboard.policy.load import Policy, load_policy
from rover_lib.onboard.stage import read_stage, write_stage
from rover_lib.workshop.act import ACT, inputs_of, predictions
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint
from rover_lib.workshop.int8.familiar import EVERY_S
from rover_lib.workshop.recordings.blocks import usual_rate_hz
from rover_lib.workshop.recordings.episodes import Split, load_recordings, split
from rover_lib.workshop.recordings.samples import Sample, block_of, frame_rate_hz, pick_evenly
from rover_lib.workshop.recordings.source import Source

WINDOW = 15  # pictures that follow one another
WINDOWS = 12  # of each car


def steering(car: dict[str, Any], parts: Split) -> dict[str, Any]:
    """Say how well the run's checkpoint steers on the held-out part: R² by seconds ahead, errors in % of the range."""
    loaded = read_stage(Path(car["run"], "load.json"), "load")
    checkpoint = load_checkpoint(Path(loaded["params"]["checkpoint"]))
    config, held_out = checkpoint.config, parts.held_out
    plans = predictions(ACT(config, checkpoint.weights), (inputs_of(s, config) for s in held_out)).numpy()
    chunks, is_pad = np.stack([s.chunk for s in held_out]), np.stack([s.is_pad for s in held_out])
    learned = np.stack([s.chunk for s in parts.calibration])
    learned_pad = np.stack([s.is_pad for s in parts.calibration])
    shares = {}
    for ahead_s in AHEAD_S:
        step = min(round(ahead_s * config.rate_hz), config.chunk - 1)
        rows = ~is_pad[:, step]
        planned, recorded = (torch.from_numpy(actions[rows, step, 0]).double() for actions in (plans, chunks))
        shares[f"{ahead_s:g}"] = round(r2(planned, recorded), 3)
    judges = Judges.of(config.action_names, learned, learned_pad, chunks, is_pad)
    return {
        "r2": shares,
        "off_pct": judges.errors_pct(plans).round(2).tolist(),
        "blind_pct": judges.blind_pct.round(2).tolist(),
    }


def of_int8(run: Path) -> dict[str, Any]:
    """Return what static INT8 costs, and the verdict's first sentence."""
    compared = read_stage(run / "compare.json", "compare")["metrics"]
    static = compared["modes"]["static"]
    delay_ms = [gate["found"] for gate in compared["gates"] if gate["gate"] == "static error, ms of delay"]
    verdict = read_stage(run / "run.json", "run")["metrics"]
    errors = [round(value, 3) for name, value in static.items() if name.endswith("_mae_pct")]
    return {"static_pct": errors, "static_ms": delay_ms, "ready": verdict["ready"], "verdict": verdict["headline"]}


def windows(samples: Sequence[Sample]) -> list[list[Sample]]:
    """Return stretches of WINDOW pictures, EVERY_S apart, evenly from all blocks."""
    blocks: dict[str, list[Sample]] = {}
    for sample in samples:
        blocks.setdefault(f"{sample.episode} {block_of(sample)}", []).append(sample)
    stretches = []
    for block in blocks.values():
        pictures = block[:: max(1, round((frame_rate_hz(block) or 1) * EVERY_S))]
        stretches += [pictures[i : i + WINDOW] for i in range(0, len(pictures) - WINDOW + 1, WINDOW)]
    return list(pick_evenly(stretches, WINDOWS))


def stopped(policy: Policy, window: Sequence[Sample]) -> bool:
    """Whether a window's pictures, with a car that stands, would stop the rover as unfamiliar."""
    smoother = Smoother()
    for sample in window:
        policy.predict_unclipped(sample.frame_bgr(), np.zeros_like(sample.state))
        if is_unfamiliar(smoother.add(policy.strange or 0.0)):
            return True
    return False


def main(out: str, described: str) -> None:
    """Write a row for each car, and the matrix: which share of whose windows each policy would stop at."""
    cars = yaml.safe_load(Path(described).read_text())
    p = params()["calibration"]
    rows, stretches = {}, {}
    for name, car in cars.items():
        recordings = load_recordings(Source.of(car["tub"], throttle=car.get("throttle", "")))
        parts = split(recordings, p["held_out_share"], p["seed"])
        stretches[name] = windows((*parts.choosing, *parts.held_out))
        rows[name] = {"camera": car["camera"], "pictures": len(recordings.samples)}
        rows[name] |= {"rate_hz": usual_rate_hz(recordings.episodes), "split": parts.note}
        if "run" in car:
            rows[name] |= steering(car, parts) | of_int8(Path(car["run"]))
            rows[name]["cnn_r2"] = json.loads(Path(car["cnn"]).read_text())[Path(car["tub"]).name]["r2"]
        print(name, rows[name], flush=True)
    matrix = {}
    for name, car in cars.items():
        if "run" not in car:
            continue
        policy = load_policy(Path(car["run"], "policy_static.pt"))
        if policy.familiar is not None:
            counts = {other: [stopped(policy, window) for window in of] for other, of in stretches.items()}
            matrix[name] = {other: f"{sum(flags)} of {len(flags)}" for other, flags in counts.items()}
            print(name, matrix[name], flush=True)
    write_stage(Path(out), "cars", params={}, metrics={"cars": rows, "stopped": matrix}, inputs={})


if __name__ == "__main__":
    main(*sys.argv[1:])

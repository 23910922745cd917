"""Which error tells the policies that drive worse? Drive degraded versions through the same worlds as FP32.

    python -m lab.judging runs/judging.json runs/demo/episodes runs/demo runs/tiny runs/slim

Each policy drives in FP32 and in every version of VERSIONS, pushed and with late plans. A version that hits fewer
worlds than FP32 by more than chance loses; each measure is held against that. Drives are kept in the cache, so that the
same command continues after an interruption.
"""

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from balloon_world import drives, world
from balloon_world.drives import SEED, drive_in, drive_missing
from balloon_world.world import World
from rover_lib.onboard.drive import loop, pilot, plan
from rover_lib.onboard.drive.plan import Settings
from rover_lib.onboard.params import params
from rover_lib.onboard.policy.load import Policy, load_policy
from rover_lib.onboard.stage import plain, sha256_of, write_stage
from rover_lib.workshop.act import block_of
from rover_lib.workshop.cache import cache_folder, cache_root, key_of
from rover_lib.workshop.int8.export import Exporter
from rover_lib.workshop.int8.observe import RangeObserver, calibrate, restore_observed
from rover_lib.workshop.int8.quantize import QuantizedPolicy, convert
from rover_lib.workshop.int8.scheme import Scheme
from rover_lib.workshop.judge.camera_use import look
from rover_lib.workshop.judge.compare import Fidelity, fidelity
from rover_lib.workshop.judge.pairs import CHANCE, compare_pairs, loses
from rover_lib.workshop.recordings.samples import pick_evenly
from rover_lib.workshop.run.session import Opened, load

FP32, DRIVING = "FP32", (world, drives, loop, pilot, plan)  # the modules that a drive depends on
WORLDS, PUSHES, LATENCY_S = 150, 4, 0.2
CALIBRATION, HELD_OUT, FIRST_STEPS = 60, 120, 8

VERSIONS: dict[str, dict[str, Any]] = {  # arguments of `degraded`
    "INT8": {},
    **{f"weights {bits}": {"weight_bits": bits} for bits in (7, 6, 5, 4, 3)},
    **{f"activations {bits}": {"activation_bits": bits} for bits in (7, 6, 5, 4, 3)},
    "noise of weights": {"noise": 0.3},
    "ranges": {"ranges": 0.3},
    "one block": {"weight_bits": 2, "block": "backbone.layer3"},
}


def degraded(
    opened: Opened, calibration: Any, weight_bits: int = 8, activation_bits: int = 8, noise: float = 0.0,
    ranges: float = 1.0, block: str = "",
) -> QuantizedPolicy:  # fmt: skip
    """Return static INT8 with all calibration frames' ranges, degraded, on the kernels of the rover.

    Fewer bits are fewer steps of the same INT8: weights are rounded beforehand, activations get a larger scale.
    noise: of weights, in their channel's standard deviation. ranges: a factor. block: only its weights are degraded.
    """
    config, scheme, rng = opened.checkpoint.config, Scheme(smooth=calibration.smooth), torch.Generator().manual_seed(0)
    prepared = restore_observed(opened.checkpoint, scheme, calibration)
    for name, m in prepared.named_modules():
        if isinstance(m, RangeObserver):
            m.quant_max = 2 ** (activation_bits - 1) - 1
            m.quant_min = -m.quant_max - 1
            m.min_val.mul_(ranges)
            m.max_val.mul_(ranges)
        elif isinstance(m, nn.Conv2d) and block in ("", block_of(name)):
            weight = m.weight.detach().flatten(1)
            weight = weight + noise * weight.std(1, keepdim=True) * torch.randn(weight.shape, generator=rng)
            step = weight.abs().amax(1, keepdim=True).clamp(min=1e-12) / (2 ** (weight_bits - 1) - 1)
            m.weight = nn.Parameter(((weight / step).round() * step).view_as(m.weight), requires_grad=False)
    return QuantizedPolicy(scheme, convert(prepared, config, scheme).eval(), {})


def errors_of(report: Fidelity, version: str, moved_pct: Mapping[str, Any]) -> dict[str, float]:
    """Return every measure of a version, of the worse action if it is none of the plan. moved_pct: of FP32's look."""
    found, reference = report.summary(version), report.reference.astype(np.float64)
    spread = np.abs(reference - reference.mean(0)).mean((0, 1))
    names, by_ms = report.action_names, {name: moved["by_100_ms"] / 100 for name, moved in moved_pct.items()}
    mae_pct = {name: found[f"{name}_mae_pct"] for name in names}
    return {
        "range_pct": max(mae_pct.values()),
        "spread_pct": max(100 * report.errors(version).mean((0, 1)) / spread),
        "first_steps_pct": max(np.mean(found[f"{name}_mae_per_step_pct"][:FIRST_STEPS]) for name in names),
        "steering_range_pct": mae_pct["steering"],
        "steering_delay_ms": mae_pct["steering"] / by_ms["steering"],
        "worse_action_delay_ms": max(mae_pct[name] / by_ms[name] for name in names),
        "delay_ms": sum(mae_pct.values()) / sum(by_ms.values()),
        "worst_tenth_pct": found["worst_tenth_pct"],
        "worst_tenth_delay_ms": found["worst_tenth_pct"] / sum(by_ms.values()),
    }


def prepare(checkpoint: Path, episodes: Path, folder: Path) -> None:
    """Write every version's artifact, and what it errs on held-out frames, to `folder`."""
    opened = load(checkpoint, episodes)
    parts, samples = opened.parts, pick_evenly(opened.parts.held_out, HELD_OUT)
    calibration = calibrate(opened.checkpoint, pick_evenly(parts.calibration, CALIBRATION))
    exporter, versions = Exporter(opened.checkpoint, samples[:1]), {}
    exporter.export(exporter.float_policy, folder / f"{FP32}.pt")
    for label, each in VERSIONS.items():
        exporter.export(degraded(opened, calibration, **each), folder / f"{label}.pt", calibration)
        versions[label] = load_policy(folder / f"{label}.pt", threads=1)
    fp32 = load_policy(folder / f"{FP32}.pt", threads=1)
    report = fidelity(fp32, versions, samples, opened.recordings.action_range())
    moved_pct = look(fp32, report, parts.held_out).moved_pct
    errors = {label: errors_of(report, label, moved_pct) for label in VERSIONS}
    (folder / "errors.json").write_text(json.dumps(plain(errors)))


def judge(run: Path, episodes: Path) -> list[dict[str, Any]]:
    """Return a row for each version of a policy: its pairs with FP32, and its errors. What was driven is kept."""
    checkpoint, settings = run / "best_model.pth", params()["drive"]
    made_of: dict[str, Any] = {"checkpoint": sha256_of(checkpoint), "versions": VERSIONS, "torch": torch.__version__}
    made_of |= {"frames": [CALIBRATION, HELD_OUT]}
    folder = cache_folder("judged", key_of(made_of), lambda new: prepare(checkpoint, episodes, new))
    how = {"drive": settings, "pushes": PUSHES, "latency": LATENCY_S, **made_of}
    path = cache_root() / f"drives-{key_of(how, *DRIVING)}.jsonl"
    hit = {label: hits(folder / f"{label}.pt", Settings.of(settings), path) for label in (FP32, *VERSIONS)}
    rows = []
    for label, errors in json.loads((folder / "errors.json").read_text()).items():
        pairs = compare_pairs(hit[FP32], hit[label])
        row = {"policy": run.name, "version": label, "fp32_hits": sum(hit[FP32]), "hits": sum(hit[label]), **pairs}
        rows.append(row | {"loses": loses(pairs), "errors": errors})
    return rows


def hits(artifact: Path, settings: Settings, path: Path) -> list[bool]:
    """Drive an artifact through the worlds; return which it hit. path: keeps the drives; others are driven."""

    def one(policy: Policy, asked: tuple[str, int]) -> dict[str, bool]:
        return {"hit": drive_in(policy, World(asked[1], PUSHES), LATENCY_S, settings).outcome == "hit"}

    asked = [(artifact.stem, SEED + i) for i in range(WORLDS)]
    found = drive_missing(artifact, asked, one, path)
    return [found[each]["hit"] for each in asked]


def roc(rows: Sequence[Mapping[str, Any]], measure: str) -> dict[str, Any]:
    """Return how well a measure tells versions that lose from those that do not.

    auc: of two versions, one of each kind, how often the loser has the larger error. least_of_losers: any limit below
    it lets no loser pass; refused: of the others, how many have at least that.
    """
    losers, others = (np.array([r["errors"][measure] for r in rows if r["loses"] is kind]) for kind in (True, False))
    auc = (losers[:, None] > others).mean() + 0.5 * (losers[:, None] == others).mean()
    return {"auc": auc, "least_of_losers": losers.min(), "refused": (others >= losers.min()).sum(), "of": len(others)}


def main(output: Path, episodes: Path, *runs: Path) -> None:
    """Judge the policies of these folders, each with its best_model.pth, and write the stage to `output`."""
    rows = [row for run in runs for row in judge(run, episodes)]
    measures = {measure: roc(rows, measure) for measure in rows[0]["errors"]}
    given: dict[str, Any] = {"worlds": WORLDS, "seed": SEED, "pushes": PUSHES, "latency_ms": 1e3 * LATENCY_S}
    given |= {"chance": CHANCE, "versions": VERSIONS, "drive": params()["drive"]}
    inputs = {f"{run.name}/best_model.pth": sha256_of(run / "best_model.pth") for run in runs}
    metrics = {"pairs": len(rows), "lose": sum(row["loses"] for row in rows), "measures": measures, "rows": rows}
    write_stage(output, "judging", params=given, metrics=metrics, inputs=inputs)
    print(json.dumps(plain(measures), indent=1))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))

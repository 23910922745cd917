"""Which error tells the policies that drive worse? Drive degraded versions through the same worlds as FP32.

    python -m research.judging runs/judging.json runs/demo/episodes runs/demo runs/tiny runs/slim

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
from rover_lib.workshop.judge.compare import Fidelity, error_limit_ms, fidelity
from rover_lib.workshop.judge.pairs import CHANCE, compare_pairs, loses
from rover_lib.workshop.recordings.samples import pick_evenly
from rover_lib.workshop.run.session import Opened, load

FP32, DRIVING = "FP32", (world, drives, loop, pilot, plan)  # the modules that a drive depends on
WORLDS, PUSHES, LATENCY_S = 200, 4, 0.2
CALIBRATION, HELD_OUT, FIRST_STEPS = 60, 120, 8

VERSIONS: dict[str, dict[str, Any]] = {  # arguments of `degraded`
    "INT8": {},
    **{f"weights {bits}": {"weight_bits": bits} for bits in (7, 6, 5, 4, 3)},
    **{f"activations {bits}": {"activation_bits": bits} for bits in (7, 6, 5, 4, 3)},
    "noise of weights": {"noise": 0.3},
    "other noise of weights": {"noise": 0.3, "seed": 1},
    "third noise of weights": {"noise": 0.3, "seed": 2},
    "ranges": {"ranges": 0.3},
    "one block": {"weight_bits": 2, "block": "backbone.layer3"},
}


def degraded(
    opened: Opened, calibration: Any, weight_bits: int = 8, activation_bits: int = 8, noise: float = 0.0,
    seed: int = 0, ranges: float = 1.0, block: str = "",
) -> QuantizedPolicy:  # fmt: skip
    """Return static INT8 with all calibration frames' ranges, degraded, on the kernels of the rover.

    Fewer bits are fewer steps of the same INT8: weights are rounded beforehand, activations get a larger scale.
    noise: of weights, in their channel's standard deviation, by seed. ranges: a factor. block: degraded alone.
    """
    scheme = Scheme(smooth=calibration.smooth)
    rng = torch.Generator().manual_seed(seed)
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
    return QuantizedPolicy(scheme, convert(prepared, opened.checkpoint.config, scheme).eval(), {})


def errors_of(report: Fidelity, version: str, moved_pct: Mapping[str, Any]) -> dict[str, float]:
    """Return every measure of a version, of the worse action if it is none of the plan. moved_pct: of FP32's look."""
    summary, reference = report.summary(version), report.reference.astype(np.float64)
    spread = np.abs(reference - reference.mean(0)).mean((0, 1))
    mae_pct = {name: summary[f"{name}_mae_pct"] for name in report.action_names}
    by_ms = sum(motion["by_100_ms"] / 100 for motion in moved_pct.values())
    return {
        "range_pct": max(mae_pct.values()),
        "spread_pct": max(100 * report.errors(version).mean((0, 1)) / spread),
        "first_steps_pct": max(np.mean(summary[f"{name}_mae_per_step_pct"][:FIRST_STEPS]) for name in mae_pct),
        "steering_range_pct": mae_pct["steering"],
        "delay_ms": sum(mae_pct.values()) / by_ms,
        "steering_less_pct": summary["steering_less_pct"],
        "worst_tenth_pct": summary["worst_tenth_pct"],
        "worst_tenth_delay_ms": summary["worst_tenth_pct"] / by_ms,
    }


def export_all(opened: Opened, folder: Path) -> None:
    """Write the artifacts of FP32 and of every version to `folder`."""
    calibration = calibrate(opened.checkpoint, pick_evenly(opened.parts.calibration, CALIBRATION))
    exporter = Exporter(opened.checkpoint, pick_evenly(opened.parts.held_out, HELD_OUT)[:1])
    exporter.export(exporter.float_policy, folder / f"{FP32}.pt")
    for label, arguments in VERSIONS.items():
        exporter.export(degraded(opened, calibration, **arguments), folder / f"{label}.pt", calibration)


def judge(run: Path, episodes: Path) -> list[dict[str, Any]]:
    """Return a row for each version of a policy: its pairs with FP32, and its errors. What was driven is kept."""
    opened, settings = load(run / "best_model.pth", episodes), params()["drive"]
    made_of: dict[str, Any] = {"checkpoint": opened.checkpoint.sha256, "versions": VERSIONS}
    made_of |= {"frames": [CALIBRATION, HELD_OUT], "torch": torch.__version__}
    folder = cache_folder("judged", key_of(made_of), lambda new: export_all(opened, new))
    made_of |= {"drive": settings, "how": [PUSHES, LATENCY_S]}
    path = cache_root() / f"drives-{key_of(made_of, *DRIVING)}.jsonl"
    hit = {label: hits(folder / f"{label}.pt", Settings.of(settings), path) for label in (FP32, *VERSIONS)}
    fp32, *policies = (load_policy(folder / f"{label}.pt", threads=1) for label in hit)
    versions, samples = dict(zip(VERSIONS, policies, strict=True)), pick_evenly(opened.parts.held_out, HELD_OUT)
    report = fidelity(fp32, versions, samples, opened.recordings.action_range())
    moved_pct, rows = look(fp32, report, opened.parts.held_out).moved_pct, []
    for label in VERSIONS:
        pairs, errors = compare_pairs(hit[FP32], hit[label]), errors_of(report, label, moved_pct)
        refused = errors["worst_tenth_delay_ms"] > error_limit_ms(errors, params()["gates"])
        row = {"policy": run.name, "version": label, "fp32_hits": sum(hit[FP32]), "hits": sum(hit[label]), **pairs}
        rows.append(row | {"loses": loses(pairs), "refused": refused, "errors": errors})
    return rows


def hits(artifact: Path, settings: Settings, path: Path) -> list[bool]:
    """Drive an artifact through the worlds; return which it hit. path: keeps the drives; others are driven."""

    def one(policy: Policy, question: tuple[str, int]) -> dict[str, bool]:
        return {"hit": drive_in(policy, World(question[1], PUSHES), LATENCY_S, settings).outcome == "hit"}

    questions = [(artifact.stem, SEED + i) for i in range(WORLDS)]
    rows = drive_missing(artifact, questions, one, path)
    return [rows[question]["hit"] for question in questions]


def roc(rows: Sequence[Mapping[str, Any]], measure: str) -> dict[str, Any]:
    """Return how well a measure tells versions that lose from those that do not.

    auc: of two versions, one of each kind, how often the loser has the larger error. least_of_losers: any limit below
    it lets no loser pass; refused: of the others, how many have at least that. left_out_passed: losers that pass the
    limit that the other policies' losers set.
    """
    losers, fair = (np.array([r["errors"][measure] for r in rows if r["loses"] is kind]) for kind in (True, False))
    auc = (losers[:, None] > fair).mean() + 0.5 * (losers[:, None] == fair).mean()
    whose = np.array([r["policy"] for r in rows if r["loses"]])
    passed = sum(of < losers[whose != policy].min(initial=np.inf) for of, policy in zip(losers, whose, strict=True))
    result = {"auc": auc, "least_of_losers": losers.min(), "refused": (fair >= losers.min()).sum(), "of": len(fair)}
    return result | {"left_out_passed": passed}


def main(output: Path, episodes: Path, *runs: Path) -> None:
    """Judge the policies of these folders, each with its best_model.pth, and write the stage to `output`."""
    torch.set_num_threads(1)  # or XNNPACK's pool gets a thread for each core, which the threads that drive wait for
    rows = [row for run in runs for row in judge(run, episodes)]
    metrics: dict[str, Any] = {"measures": {measure: roc(rows, measure) for measure in rows[0]["errors"]}}
    metrics |= {"pairs": len(rows), "lose": sum(row["loses"] for row in rows)}
    metrics["losers_passed"] = sum(row["loses"] and not row["refused"] for row in rows)
    metrics["others_refused"] = sum(row["refused"] and not row["loses"] for row in rows)
    settings: dict[str, Any] = {"worlds": WORLDS, "seed": SEED, "pushes": PUSHES, "latency_ms": 1e3 * LATENCY_S}
    settings |= {"chance": CHANCE, "versions": VERSIONS, "drive": params()["drive"], "gates": params()["gates"]}
    inputs = {f"{run.name}/best_model.pth": sha256_of(run / "best_model.pth") for run in runs}
    write_stage(output, "judging", params=settings, metrics=metrics | {"rows": rows}, inputs=inputs)
    print(json.dumps(plain(metrics), indent=1))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))

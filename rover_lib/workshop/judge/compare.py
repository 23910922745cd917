"""What quantization changed: the same frames through every artifact, differences in units that the car feels.

    report = fidelity(fp32, {"static": static}, split.held_out, recordings.action_range())
    compared = metrics(report, policies, trials)
    gates(compared, params()["gates"])

Errors are absolute differences to the FP32 artifact; `recorded_error` is against the driver. Near an episode's end a
sample has fewer recorded actions than a chunk is long: `mae` counts all steps, `recorded_error` only the recorded ones.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rover_lib.onboard.artifact.manifest import content_hash
from rover_lib.onboard.car.car import Car, this_car
from rover_lib.onboard.errors import PolicyError
from rover_lib.onboard.policy.load import Policy, action_limits, load_policy
from rover_lib.onboard.policy.preprocess import prepare_frame
from rover_lib.workshop.act_config import Affine, lerobot_act
from rover_lib.workshop.checkpoint.checkpoint import Checkpoint
from rover_lib.workshop.judge.pairs import compare_pairs, loses
from rover_lib.workshop.judge.recorded_range import not_judged, pct_of_range, worst
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.samples import by_camera, stack_chunks

MODES = ("dynamic", "static", "mixed")  # what a run makes beside fp32
ARTIFACTS = ("fp32", *MODES)
GATED_WORLDS = 40  # in which params.yml counts balloons
GATED = "static"  # the mode that a Pi is meant to run, and that the gates judge

WORLDS_LOST = "worlds lost at most, %"


@dataclass(frozen=True, eq=False)
class WorstFrame:
    """A frame on which a mode differs most from FP32. Chunks (C, A) float32; error_pct: mean of its steps."""

    mode: str
    action: str
    error_pct: float
    sample: Any
    reference: np.ndarray
    other: np.ndarray


@dataclass(frozen=True, eq=False)
class Fidelity:
    """Chunks of every artifact on the same n frames.

    reference: (n, C, A) float32 of FP32; chunks: the same by mode; recorded: (n, C, A); is_pad: (n, C) bool, steps
    after the end of the recording.
    """

    action_names: tuple[str, ...]
    action_range: dict[str, tuple[float, float]]
    samples: tuple[Any, ...]
    reference: np.ndarray
    chunks: dict[str, np.ndarray]
    recorded: np.ndarray
    is_pad: np.ndarray

    def errors(self, mode: str) -> np.ndarray:
        """(n, C, A) float64 absolute difference to FP32, in units of the action."""
        return np.abs(self.chunks[mode].astype(np.float64) - self.reference)

    def relative(self, mode: str) -> float:
        """The largest difference to FP32, as a share of the largest that is planned of that action, or of 1."""
        largest = np.abs(self.reference).max((0, 1)).clip(1)
        return float((self.errors(mode).max((0, 1)) / largest).max())

    def pct(self, action: str) -> float | None:
        """One unit of an action in percent of its recorded range; None for an action that is not judged."""
        return pct_of_range(1.0, self.action_range[action])

    def in_pct(self, errors: Any, action: str) -> Any:
        """Errors of an action, one or an array, in percent of its recorded range; None if it is not judged."""
        pct = self.pct(action)
        return None if pct is None else errors * pct

    def summary(self, mode: str) -> dict[str, Any]:
        """Everything about one mode, by action, in % of the recorded range; of an action not judged it is None.

        worst_tenth_pct: the sum of the actions' errors on the tenth of the frames where it is largest. less_pct: by an
        action, how much less it plans, on average, in the direction in which FP32 does; below 0, it plans more.
        """
        summary: dict[str, Any] = {}
        total = np.zeros(len(self.samples))
        for i, action in enumerate(self.action_names):
            e = self.errors(mode)[..., i]
            less = self.reference[..., i] - self.chunks[mode][..., i].astype(np.float64)
            total += e.mean(1) * (self.pct(action) or 0)
            numbers = {"mae": e.mean(), "p95": np.quantile(e, 0.95), "max": e.max(), "mae_per_step": e.mean(0)}
            numbers["less"] = (np.sign(self.reference[..., i]) * less).mean()
            summary |= {f"{action}_{name}_pct": self.in_pct(error, action) for name, error in numbers.items()}
        summary["worst_tenth_pct"] = np.sort(total)[-math.ceil(len(total) / 10) :].mean()
        return summary | self.recorded_error(self.chunks[mode])

    def recorded_error(self, chunks: np.ndarray) -> dict[str, float | None]:
        """How far plans (n, C, A) are from what the driver did, mean over the recorded steps."""
        e = np.abs(chunks.astype(np.float64) - self.recorded)[~self.is_pad].mean(0)
        return {f"{a}_vs_recorded_pct": self.in_pct(e[i], a) for i, a in enumerate(self.action_names)}

    def worst(self, mode: str, count: int = 3) -> list[WorstFrame]:
        """The `count` frames with the largest mean error over the plan, in whichever judged action, worst first."""
        units = {i: pct for i, a in enumerate(self.action_names) if (pct := self.pct(a)) is not None}
        if not units:
            return []
        per_frame = self.errors(mode).mean(1)[:, list(units)] * list(units.values())  # (n, judged actions)
        worst_frames = []
        for i in np.argsort(-per_frame.max(1), kind="stable")[:count]:
            action = self.action_names[list(units)[int(per_frame[i].argmax())]]
            plans = self.reference[i], self.chunks[mode][i]
            worst_frames.append(WorstFrame(mode, action, float(per_frame[i].max()), self.samples[i], *plans))
        return worst_frames


class LerobotEager:
    """LeRobot's own ACTPolicy in eager FP32, behind an artifact's interface. car: None is this machine's."""

    def __init__(self, checkpoint: Checkpoint, car: Car | None = None):
        c = self.config = checkpoint.config
        self.chunk = c.chunk
        self.action_names = c.action_names
        self.state_names = c.state_names
        self._policy = lerobot_act(c, checkpoint.weights).eval()
        self.car = car or this_car()
        self._low, self._high = action_limits(c.action_names, self.car)

    def predict_chunk(self, frame_bgr: np.ndarray | Mapping[str, np.ndarray], state: np.ndarray) -> np.ndarray:
        """As `Policy.predict_chunk`: (C, A) float32, clipped to what a pulse can express."""
        c = self.config
        frames = by_camera(frame_bgr, c.cameras[0])
        batch = {"observation.state": _affine(np.asarray(state, np.float32), c.state_norm)[None]}
        for name, size, norm in zip(c.cameras, c.image_sizes, c.image_norm, strict=True):
            pixels = prepare_frame(frames[name], *size).astype(np.float32) / 255
            batch[f"observation.images.{name}"] = _affine(pixels, norm).permute(2, 0, 1)[None].contiguous()
        with torch.inference_mode():
            chunk = self._policy.predict_action_chunk(batch)[0]
        return np.clip(_affine(chunk.numpy(), c.action_unnorm).numpy(), self._low, self._high)


def _affine(x: np.ndarray, affine: Affine | None) -> torch.Tensor:
    """Return x * scale + shift over the last axis."""
    if affine is None:
        return torch.from_numpy(x)
    return torch.from_numpy(x * np.asarray(affine.scale, np.float32) + np.asarray(affine.shift, np.float32))


def artifacts(run_dir: Path | str) -> dict[str, Path]:
    """The artifacts of a run by mode, in the order of ARTIFACTS; those that are not there are left out."""
    paths = {mode: Path(run_dir) / f"policy_{mode}.pt" for mode in ARTIFACTS}
    return {mode: path for mode, path in paths.items() if path.is_file()}


def load_policies(run_dir: Path | str, threads: int | None = None) -> dict[str, Policy]:
    """Every artifact of a run by mode, loaded and checked as on the Pi. Raises ArtifactError and PolicyError."""
    policies = {mode: load_policy(path, threads=threads) for mode, path in artifacts(run_dir).items()}
    if "fp32" not in policies:
        raise PolicyError(f"{run_dir}: no policy_fp32.pt in it", found=sorted(policies), remedy="run notebook 03")
    return policies


def hashes(run_dir: Path | str) -> dict[str, str]:
    """Content hash of every artifact of a run, by file name: what a comparison or benchmark was made of."""
    return {path.name: content_hash(path) for path in artifacts(run_dir).values()}


def fidelity(
    reference: Any,
    others: Mapping[str, Any],
    samples: Sequence[Any],
    action_range: Mapping[str, tuple[float, float]],
    progress: Progress = silent,
) -> Fidelity:
    """Run every policy on every sample.

    Args:
        reference: the policy in FP32.
        others: by mode; of the same actions and chunk.
        samples: with frame_bgr(), state, chunk (C, A) and is_pad (C,).
        action_range: by name, (least, most).
        progress: shows which sample is compared.

    Returns:
        The plans of each policy, beside what was recorded.

    Raises:
        PolicyError: no samples, policies of other actions or chunks, or an action without a range.
    """
    names = tuple(reference.action_names)
    if not samples:
        raise PolicyError("there are no frames to compare on", remedy="record more, or hold out a larger share")
    for mode, policy in others.items():
        if (tuple(policy.action_names), policy.chunk) != (names, reference.chunk):
            problem = f"{mode} plans {policy.chunk} steps of {list(policy.action_names)}, FP32 other ones"
            raise PolicyError(problem, remedy="compare artifacts of one checkpoint")
    if missing := [n for n in names if n not in action_range]:
        raise PolicyError(f"no recorded range of action {missing}", remedy="use other recordings")
    policies = {"": reference, **others}
    planned: dict[str, list[np.ndarray]] = {mode: [] for mode in policies}
    for sample in progress(samples, desc="comparing", total=len(samples)):
        frame = sample.frame_bgr()
        for mode, policy in policies.items():
            planned[mode].append(policy.predict_chunk(frame, sample.state))
    recorded, is_pad = stack_chunks(samples)
    return Fidelity(
        action_names=names,
        action_range={n: (float(action_range[n][0]), float(action_range[n][1])) for n in names},
        samples=tuple(samples),
        reference=np.stack(planned.pop("")),
        chunks={mode: np.stack(chunks) for mode, chunks in planned.items()},
        recorded=recorded,
        is_pad=is_pad,
    )


def metrics(report: Fidelity, policies: Mapping[str, Any], trials: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """The metrics of compare.json: fp32, modes and what they were measured on.

    policies: "fp32" and the modes. trials: reports by mode; modes that were not driven have None, not 0.
    """
    own = {}
    for mode in ("fp32", *report.chunks):
        trial = (trials or {}).get(mode)
        own[mode] = {
            "hits": getattr(trial, "hits", None),
            "trials": getattr(trial, "trials", None),
            "size_mb": policies[mode].path.stat().st_size / 1e6,
        }
    fp32 = own.pop("fp32")
    modes = {}
    for mode, row in own.items():
        # Both drove the same worlds, in the same order.
        pairs = compare_pairs(trials["fp32"].hit, trials[mode].hit) if trials and mode in trials else None
        modes[mode] = row | report.summary(mode) | {"pairs": pairs}
    worst = []
    for w in chain.from_iterable(map(report.worst, report.chunks)):
        at = {"episode": w.sample.episode, "frame": w.sample.frame_name}
        row = {"mode": w.mode, "action": w.action, "error_pct": w.error_pct}
        worst.append(row | at | {"fp32": w.reference, "int8": w.other})
    return {
        "fp32": fp32 | report.recorded_error(report.reference),
        "modes": modes,
        "action_range": report.action_range,
        "warnings": not_judged(report.action_range),
        "frames": len(report.samples),
        "worst": worst,
    }


def gate(name: str, found: float | None, relation: str, limit: Any) -> dict[str, Any]:
    """One row of the gates' table. passed is None where nothing was measured: no pass, no failure."""
    if found is None or math.isnan(found):
        return {"gate": name, "relation": relation, "limit": limit, "found": None, "passed": None}
    passed = bool(found <= limit if relation == "<=" else found >= limit)
    return {"gate": name, "relation": relation, "limit": limit, "found": found, "passed": passed}


def hits_needed(limits: Mapping[str, Any], trials: int | None) -> int:
    """Return how many balloons FP32 must hit in `trials` worlds; params.yml says it for GATED_WORLDS."""
    return math.floor(limits["fp32_hits"] * (trials or GATED_WORLDS) / GATED_WORLDS)


def worlds_lost(name: str, pairs: Mapping[str, Any] | None, worlds: int, limit_pct: float) -> dict[str, Any]:
    """The gate of how many of the same worlds may be lost, at 95 %. passed: None if neither that nor a loss shows."""
    row = gate(name, 100 * pairs["loss_high"] / worlds if pairs else None, "<=", limit_pct)
    return row if row["passed"] or (pairs and loses(pairs)) else row | {"passed": None}


def error_ms(compared: Mapping[str, Any], mode: str) -> float | None:
    """How old a picture moves FP32's plan as far as the mode is off in the worst tenth of frames; None: none moves it.

    Actions count together, in % of their ranges, as one that hardly varies has no delay of its own.
    """
    moved_pct = sum(v or 0 for k, v in compared.get("looking", {}).items() if k.endswith("_by_100_ms_pct"))
    return 100 * compared["modes"][mode]["worst_tenth_pct"] / moved_pct if moved_pct else None


def error_limit_ms(judged: Mapping[str, Any], limits: Mapping[str, Any]) -> float:
    """The limit of `error_ms`: what loses worlds steers less than FP32, so a mode that does not may be further off."""
    less = judged.get("steering_less_pct")
    return limits["error_ms" if less is None or less > 0 else "error_ms_no_less_steering"]


def gates(compared: Mapping[str, Any], limits: Mapping[str, Any], mode: str = GATED) -> list[dict[str, Any]]:
    """The gates of params.yml that a comparison can judge. compared: `metrics` with `looking`; limits: its `gates`.

    The error is judged only where worlds do not decide, in ms of delay; where none tells, in % of the recorded range.
    """
    fp32 = compared["fp32"]
    scores = compared["modes"][mode]
    lost = worlds_lost(f"{mode} {WORLDS_LOST}", scores.get("pairs"), fp32.get("trials"), limits["worlds_lost_pct"])
    hits = gate("fp32 hits", fp32["hits"], ">=", hits_needed(limits, fp32.get("trials")))
    size = gate(f"{mode} size_mb", scores["size_mb"], "<=", limits["size_mb"][mode])
    if lost["passed"] is not None:
        return [hits, lost, size]
    if (ms := error_ms(compared, mode)) is not None:
        error = gate(f"{mode} error, ms of delay", ms, "<=", error_limit_ms(scores, limits))
    else:
        worst_pct = worst(scores[key] for key in scores if key.endswith("_mae_pct"))
        error = gate(f"{mode} error, % of the recorded range", worst_pct, "<=", limits["error_pct"])
    return [error, hits, lost, size]

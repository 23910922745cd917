"""Decide by a rule which artifact to deploy, and what to do about what failed, from the JSON of a run's stages.

    stages = {name: read_stage(...)["metrics"] for name in ("load", "quantize", "compare", "benchmark")}
    judged = verdict(stages, params(), Names("runs/mine", "best_model.pth", "episodes"))

The rule takes its limits from the sections `verdict` and `gates` of params.yml. Of the modes that keep every gate, it
keeps those about as fast as the fastest; of these, those about as true to FP32 as the truest; of these, those about as
small as the smallest; and if several are left, it takes the first of PREFERRED. FP32 has no gates of error to miss, so
there is an artifact to deploy whenever the policy itself drives.
"""

import json
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rover_lib.onboard.artifact.acceptance import MAY_DIFFER
from rover_lib.onboard.columns import ratio
from rover_lib.workshop.judge import recorded_range as judge
from rover_lib.workshop.judge.compare import GATED, MODES, gate, gates, hits_needed

CALLED = {"fp32": "FP32", "dynamic": "dynamic INT8", "static": "static INT8", "mixed": "mixed INT8"}
OF_BENCHMARKS = {  # the original's acceptance table
    "latency_mean_ms": "time of a plan, mean, ms",
    "latency_p95_ms": "time of a plan, 95th percentile, ms",
    "throughput_fps": "plans a second",
    "control_rate_hz": "commands a second",
    "model_size_mb": "size of the artifact, MB",
    "memory_mb": "memory, MB",
    "cpu_pct": "processor, % of all cores",
    "accuracy_loss_pct": "largest error, % of the recorded range",
    "temperature_c": "temperature, Celsius",
    "throttled": "what the Pi's firmware throttled",
}
PREFERRED = ("fp32", "static", "mixed", "dynamic")  # between equals: the policy as trained, then the simplest
COUNTED = "counted on an emulated Cortex-A76"
NEXT_COMMANDS = 3
MOST_EPISODES = 3  # a remedy names at most this many
EARLY_FRAMES = 30  # odd frames below this number all belong to the beginning of a drive

Stages = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True)
class Names:
    """What a user types, from the current folder, for the run's folder, its checkpoint and its recordings."""

    run: str
    checkpoint: str
    episodes: str

    @property
    def name(self) -> str:
        return self.run.rstrip("/").rpartition("/")[2]

    def artifact(self, mode: str) -> str:
        return f"{self.run.rstrip('/')}/policy_{mode}.pt"


def verdict(
    stages: Stages, params: Mapping[str, Any], names: Names, refusals: Mapping[str, Mapping[str, str]] | None = None
) -> dict[str, Any]:
    """Return the verdict on a run, as run.json stores it.

    stages: the metrics of the stages load, quantize, compare and benchmark, and of arm and distill if they were made.
    params: the content of params.yml. refusals: by mode, what a rover would refuse its artifact for, as
    `release.Expected.refusals`. "ready" in the result: whether the policy drives; "deploy" is None if no artifact of it
    should drive this car.
    """
    rows = _rows(stages, params)
    failed = _list_failures(stages, params, names, rows)
    unfit = _not_ready(stages, failed)
    best = _best(list(rows.values()), params["verdict"])
    slow = {} if best["mode"] in ("static", "mixed") else {"mode": "it is slow"}
    refused = (refusals or {}).get(best["mode"], slow)
    deploy = None if unfit or set(refused) - set(MAY_DIFFER) else best["mode"]
    for row in rows.values():
        row["because"] = _because(row, best, params["verdict"])
    if deploy is None:
        best["because"] = "the best of them"
    judged = {
        "ready": not unfit,
        "deploy": deploy,
        "artifact": None if deploy is None else f"policy_{deploy}.pt",
        "why": (unfit or _why(best, rows["fp32"])) + _for_another_robot(refused),
        "refused": dict(refused),
        "timing": _timing(rows),
        "compared": "least ms" if time_key(stages["benchmark"], params["verdict"]) == "latency_min_ms" else "p50 ms",
        "modes": list(rows.values()),
        "failed": failed,
        "cautions": _cautions(stages, params, rows, best, deploy is not None) + _allowed(deploy, refused),
    }
    return judged | {"next": _next(judged, best["mode"], stages, names)}


# --- the modes beside each other --------------------------------------------------------------------------------------


def _rows(stages: Stages, params: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return a row for each mode that was compared, FP32 first. Units are in the keys."""
    compared, timed = stages["compare"], stages["benchmark"]["artifacts"]
    counted = stages.get("arm", {}).get("artifacts", {})
    fp32 = compared["fp32"]
    key = time_key(stages["benchmark"], params["verdict"])
    rows = {}
    for mode in ("fp32", *(m for m in MODES if m in compared["modes"])):
        found, time = fp32 if mode == "fp32" else compared["modes"][mode], timed.get(mode, {})
        errors = {k: v for k, v in found.items() if k.endswith("_mae_pct")}
        rows[mode] = {
            "mode": mode,
            "size_mb": found["size_mb"],
            "times_smaller": fp32["size_mb"] / found["size_mb"],
            "latency_p50_ms": time.get("latency_p50_ms"),
            "latency_p95_ms": time.get("latency_p95_ms"),
            "time_ms": time.get(key),
            "times_faster": ratio(timed.get("fp32", {}).get(key), time.get(key)),
            "floor_ms": time.get("floor_ms"),
            "instructions_g": counted.get(f"policy_{mode}", {}).get("instructions_g"),
            "errors_pct": {k.removesuffix("_mae_pct"): v for k, v in errors.items()},
            "hits": found["hits"],
            "trials": found["trials"],
            "float_blocks": stages["quantize"]["modes"].get(mode, {}).get("float_blocks", []),
            "not_timed": "",
            "missed_gates": [] if mode == "fp32" else _list_missed(compared, params["gates"], mode),
        }
    static, mixed = rows.get("static"), rows.get("mixed")
    if static and mixed and static["time_ms"] and mixed["time_ms"] and mixed["time_ms"] < static["time_ms"]:
        # It does the same work and some of it in float, so that its shorter time is chance.
        shorter = f"the {mixed['time_ms']:.1f} ms measured for it are chance"
        mixed["not_timed"] = (
            f"it does what static INT8 does and more, so that {shorter} and its time is given as static's"
        )
        mixed |= {"time_ms": static["time_ms"], "times_faster": static["times_faster"]}
    return rows


def _list_missed(compared: Mapping[str, Any], limits: Mapping[str, Any], mode: str) -> list[dict[str, Any]]:
    """Return the gates that a mode misses, each once.

    The original's general gates of accuracy and size are left out if a gate of our own for the same thing is missed.
    """
    rows = [r for r in gates(compared, limits, mode) if r["passed"] is False and r["gate"].startswith(f"{mode} ")]
    keys = {r["gate"].partition(" ")[2] for r in rows}
    doubled = set()
    if any(k.endswith("_mae_pct") for k in keys):
        doubled.add("accuracy_loss_pct")
    if "size_mb" in keys:
        doubled.add("model_size_mb")
    return [_with_words(r) for r in rows if r["gate"].partition(" ")[2] not in doubled]


def _best(rows: Sequence[dict[str, Any]], limits: Mapping[str, Any]) -> dict[str, Any]:
    """Return the row that the rule takes. FP32 has no gates to miss, so there always is one."""
    same = 1 + limits["worth_pct"] / 100
    left = _candidates(rows)
    key = _work_key(left)
    if key:
        fastest = min(row[key] for row in left)
        left = [row for row in left if row[key] <= fastest * same]
    truest = min(error_pct(row) for row in left)
    left = [row for row in left if error_pct(row) <= truest + limits["better_points"]]
    smallest = min(row["size_mb"] for row in left)
    left = [row for row in left if row["size_mb"] <= smallest * same]
    return min(left, key=lambda row: PREFERRED.index(row["mode"]))


def _candidates(rows: Iterable[Mapping[str, Any]]) -> list[Any]:
    """Return the modes that keep their gates, but not a mixed one with no block in float: that is static INT8 again."""
    return [row for row in rows if not row["missed_gates"] and (row["mode"] != "mixed" or row["float_blocks"])]


def _work_key(rows: Sequence[Mapping[str, Any]]) -> str | None:
    """Return the key to compare speed by: instructions if all rows have them, else the time here, else None."""
    return next((k for k in ("instructions_g", "time_ms") if all(row[k] for row in rows)), None)


def error_pct(row: Mapping[str, Any]) -> float:
    """Return the larger of the actions' errors, in percent of the recorded range; 0 for FP32 or if none was judged."""
    return judge.worst(row["errors_pct"]) or 0.0


def _timing(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """Say where the figures of speed come from."""
    key = _work_key(_candidates(rows.values()))
    return {"instructions_g": COUNTED, "time_ms": "measured here", None: "not measured"}[key]


def time_key(benchmark: Mapping[str, Any], limits: Mapping[str, Any]) -> str:
    """Return which time of a mode is compared: the median, or the smallest if the machine was busy with other things.

    INT8's engine waits for all its threads at each layer, so another process that takes part of a core can make its
    median slower than FP32's.
    """
    least = all("latency_min_ms" in timed for timed in benchmark["artifacts"].values())
    return "latency_min_ms" if least and _busy(benchmark, limits) else "latency_p50_ms"


def _busy(benchmark: Mapping[str, Any], limits: Mapping[str, Any]) -> str:
    """Say what shows that the machine did other things while it took the times; empty if nothing does."""
    cores, own_pct = benchmark.get("cpu_per_core_pct"), benchmark.get("cpu_pct")
    if cores and own_pct is not None and len(cores) == benchmark.get("cores"):
        others_pct = sum(cores) / len(cores) - own_pct
        if others_pct > limits["busy_pct"]:
            return f"other programs had {others_pct:.0f} % of it"
    times = [t for mode, t in benchmark["artifacts"].items() if mode in CALLED and t["latency_p50_ms"]]
    spread = max((t["latency_p95_ms"] / t["latency_p50_ms"] for t in times), default=0)
    return f"p95 is {spread:.1f} times p50" if spread > limits["busy_p95"] else ""


# --- what failed, and what to do --------------------------------------------------------------------------------------


def _with_words(row: Mapping[str, Any]) -> dict[str, Any]:
    """Return a row of `compare.gates` with its gate in words added."""
    mode, _, key = row["gate"].partition(" ")
    return {**row, "words": in_words(mode, key)}


def in_words(mode: str, key: str) -> str:
    """Return what people call a gate, such as "throttle error of static INT8, % of the recorded range"."""
    of = CALLED.get(mode, mode)
    if key.endswith("_mae_pct"):
        return f"{key.removesuffix('_mae_pct')} error of {of}, % of the recorded range"
    if key.endswith("_of_spread_pct"):
        return f"{key.removesuffix('_of_spread_pct')} error of {of}, % of how much the plans vary"
    return {
        "instructions_g": f"instructions of a plan of {of}, 10^9",
        "simd_g": f"SIMD instructions of a plan of {of}, 10^9",
        "peak_memory_mb": f"memory of {of} while it predicts, MB",
        "peak_memory_loading_mb": f"memory of {of} while it is loaded, MB",
        "hits": f"balloons that {of} hits",
        "hits lost": f"balloons that {of} misses and FP32 hits",
        "size_mb": f"size of {of}, MB",
        "model_size_mb": f"size of {of}, MB",
        "accuracy_loss_pct": f"largest error of {of}, % of the recorded range",
        "floor_ms": f"a plan of {of} on a Pi 5 at the very best, ms (computed)",
    }.get(key, f"{key}, of {of}")


def gate_in_words(gate: str) -> str:
    """Return any gate's name as notebooks show it: of a comparison, a benchmark, a drive, a count or a student.

    A name that is already in words stays as it is.
    """
    name, _, key = gate.partition(" ")
    stem, dot, _ = name.removeprefix("policy_").partition(".onnx")
    mode, _, size = stem.partition("_")
    if mode not in CALLED or not key:
        for known, words in OF_BENCHMARKS.items():
            gate = gate.replace(known, words)
        return gate
    original = ", as the original promised" if key in ("model_size_mb", "accuracy_loss_pct") else ""
    at = f" at {'x'.join(reversed(size.split('x')))}" if size else ""
    engine = " for ONNX Runtime" if dot else ""
    return (in_words(mode, key) + original).replace(CALLED[mode], f"{CALLED[mode]}{at}{engine}")


def _list_failures(
    stages: Stages, params: Mapping[str, Any], names: Names, rows: Mapping[str, Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Return each gate that the policy, or the mode that a Pi is meant to run, misses, with its remedies, best first.

    Time and memory measured on this workstation are not judged here: those gates are for a Pi.
    """
    limits, hits = params["gates"], stages["compare"]["fp32"]["hits"]
    failed = []
    trained = gate("fp32 hits", hits, ">=", hits_needed(limits, stages["compare"]["fp32"]["trials"]))
    if trained["passed"] is False:
        remedies = [
            "No other format can fix this: train longer, on more recordings.",
            "Record drives in which the car has left its way and is steered back, so that the policy learns it.",
        ]
        failed.append(_with_words(trained) | {"remedies": remedies})
    for row in rows[GATED]["missed_gates"] if GATED in rows else []:
        failed.append(row | {"remedies": _remedies(row["gate"].partition(" ")[2], stages, params, names, rows)})
    promised = limits["original"]["latency_mean_ms"][1]
    floor = gate(f"{GATED} floor_ms", rows.get(GATED, {}).get("floor_ms"), "<=", promised)
    if floor["passed"] is False:
        remedies = [
            "Driving at 30 Hz does not need it: one plan covers a second. No program can make this policy faster.",
            f"A smaller policy can: `{_smaller(stages, names)}`.",
        ]
        failed.append(_with_words(floor) | {"remedies": remedies})
    return failed


def _remedies(
    key: str, stages: Stages, params: Mapping[str, Any], names: Names, rows: Mapping[str, Mapping[str, Any]]
) -> list[str]:
    """Say what to do about a gate that static INT8 misses, the cheapest remedy first."""
    if key in ("size_mb", "model_size_mb"):
        return [f"INT8 cannot make it smaller; a smaller policy can: `{_smaller(stages, names)}`."]
    action = key.removesuffix("_mae_pct").removesuffix("_of_spread_pct") if key.endswith("_pct") else None
    remedies = [_of_mixed(params, rows)]
    # Where frames are odd, training with INT8's rounding began from bad ranges and repaired little. From good
    # ones it is untried.
    if stages["quantize"].get("odd"):
        remedies.append(
            "The frames that the cautions name take the steps of INT8 from all others: leave out drives that should "
            "not be there, or train on more frames like them, so that the policy answers them as it does the others."
        )
    else:
        remedies.append(f"Train it for INT8: `{_qat(names)}`, then `rover run` on what it leaves.")
    if action and (block := _worst_block(stages["quantize"].get("sensitivity", {}), action)):
        remedies.append(f"Most of it comes from {block[0]}: {block[1]:.2f} % with that alone in INT8 (notebook 03).")
    if clipped := _clipped(stages["quantize"], params):
        remedies.append(
            f"{clipped} met larger values than in calibration: record more of what was missing there, such as other "
            "light, other places, sharper turns."
        )
    if action and (worst := _worst_episodes(stages["compare"], action)):
        remedies.append(f"Record more drives like {worst}, where the error is largest (notebook 04 shows the frames).")
    return remedies


def _of_mixed(params: Mapping[str, Any], rows: Mapping[str, Mapping[str, Any]]) -> str:
    mixed = rows.get("mixed")
    if mixed is None or not mixed["float_blocks"]:
        most = params["quantization"]["mixed_max_cost_pct"]
        return f"Mixed can leave no block in float within a cost of {most:g} %: raise mixed_max_cost_pct in params.yml."
    blocks = ", ".join(mixed["float_blocks"])
    if mixed["missed_gates"]:
        missed = ", ".join(row["words"] for row in mixed["missed_gates"])
        return f"Mixed does not fix it: it leaves {blocks} in float, and still misses: {missed}."
    return f"Mixed fixes it: it leaves {blocks} in float, and its largest error is {error_pct(mixed):.2f} %."


def _worst_block(sensitivity: Mapping[str, Mapping[str, float | None]], action: str) -> tuple[str, float] | None:
    alone = {block: errors.get(f"{action}_mae_pct") for block, errors in sensitivity.items()}
    judged = {block: error for block, error in alone.items() if error is not None}
    return max(judged.items(), key=lambda item: item[1], default=None)


def _clipped(quantized: Mapping[str, Any], params: Mapping[str, Any]) -> str:
    limit = params["quantization"]["clipped_warn_pct"]
    return _some([row["name"] for row in quantized.get("layers", []) if (row.get("clipped_pct") or 0) > limit])


def _worst_episodes(compared: Mapping[str, Any], action: str) -> str:
    frames = [w for w in compared.get("worst", []) if (w["mode"], w["action"]) == (GATED, action) and w["episode"]]
    return _some(list(dict.fromkeys(str(w["episode"]) for w in frames)))


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - MOST_EPISODES} more" if len(names) > MOST_EPISODES else ""
    return ", ".join(names[:MOST_EPISODES]) + more


def _qat(names: Names) -> str:
    return f"rover distill {_shell(names.checkpoint, names.episodes)} --qat --name {_shell(f'{names.name}-qat')}"


def _smaller(stages: Stages, names: Names) -> str:
    """Return a `rover distill` command for a smaller policy.

    It halves the picture's sides if they are known, and asks for two decoder layers if there are more. If neither
    applies, it asks for a narrower feed-forward layer.
    """
    report = stages["load"]["checkpoint"]
    config = report.get("trainer_config") or {}
    width, height = config.get("image_width"), config.get("image_height")
    shape = [f"--size {width // 2}x{height // 2}"] if width and height else []
    layers = len({block.split(".")[1] for block in report["macs_by_block"] if block.startswith("decoder.")})
    if layers > 2:
        shape.append("--decoder-layers 2")
    if not shape:
        shape.append("--feedforward 1600")
    name = _shell(f"{names.name}-small")
    return f"rover distill {_shell(names.checkpoint, names.episodes)} {' '.join(shape)} --name {name}"


def _shell(*words: str) -> str:
    return shlex.join(words)


# --- in sentences -----------------------------------------------------------------------------------------------------


def _not_ready(stages: Stages, failed: Sequence[Mapping[str, Any]]) -> list[str]:
    """Say why no artifact of this policy should drive a car, and what helps; empty if nothing speaks against it."""
    compared, lines = stages["compare"], []
    unbeaten = compared.get("guesses", {}).get("warnings", [])
    for warning in (*unbeaten, *stages["load"].get("fit", {}).get("warnings", [])):
        lines.append(f"{warning[0].upper()}{warning[1:]}{'' if warning.endswith('?') else '.'}")
    looking = compared.get("looking", {})
    actions = [k.removesuffix("_apart_pct") for k, v in looking.items() if k.endswith("_apart_pct") and v is not None]
    if actions and not any(judge.follows(looking[f"{a}_by_picture_pct"], looking[f"{a}_apart_pct"]) for a in actions):
        lines.append("The policy ignores its camera, and copies its state or always plans the same.")
    if any(row["gate"] == "fp32 hits" for row in failed):
        fp32 = compared["fp32"]
        lines.append(f"As it was trained, in FP32, it hits {fp32['hits']} of {fp32['trials']} balloons.")
    if lines:
        count_of = len({name for part in stages["load"]["split"].values() for name in part})
        lines.append(
            "What helps: the dataset that it was trained on, if this is another; more training steps; more recordings "
            f"than these {count_of}, with standing starts, other places and light (docs: which recordings help)."
        )
    return lines


def _for_another_robot(refused: Mapping[str, str]) -> list[str]:
    """Say what a rover would refuse the artifact for and cannot be allowed; empty if there is nothing."""
    whys = "; ".join(why for kind, why in refused.items() if kind not in MAY_DIFFER)
    robot = "A policy for another robot" if "actions" in refused else "A rover refuses it"
    return [f"{robot}, to benchmark only: {whys}."] if whys else []


def _allowed(deploy: str | None, refused: Mapping[str, str]) -> list[str]:
    """Say what a rover takes the artifact for only if it is told to, but for the mode, which the table shows."""
    whys = "; ".join(why for kind, why in refused.items() if kind in MAY_DIFFER and kind != "mode")
    return (
        [f"Was it trained for this car? A rover takes it only if rover_allow says so: {whys}."]
        if deploy and whys
        else []
    )


def _why(best: Mapping[str, Any], fp32: Mapping[str, Any]) -> list[str]:
    """Say why this mode was chosen, each reason in a sentence."""
    if best is fp32:
        return ["No INT8 mode keeps every gate and is worth its cost, so this is FP32, the policy as it was trained."]
    errors = [f"{action} {e:.2f} %" for action, e in best["errors_pct"].items() if e is not None]
    differs = f": it differs from FP32 by {', '.join(errors)} of the recorded range" if errors else ""
    lines = [f"It keeps every gate{differs}."]
    if best["trials"]:
        lines.append(f"It hits {best['hits']} of {best['trials']} balloons; FP32 hits {fp32['hits']}.")
    size = f"It has {best['size_mb']:.1f} MB, {best['times_smaller']:.1f} times smaller than FP32"
    if best["instructions_g"] and fp32["instructions_g"]:
        counts = f"{best['instructions_g']:.3g} G instructions instead of {fp32['instructions_g']:.3g}"
        lines.append(f"{size}, and needs {counts} ({COUNTED}).")
    elif best["times_faster"]:
        times = f"{best['time_ms']:.1f} ms instead of {fp32['time_ms']:.1f}"
        which = "p50" if best["time_ms"] == best["latency_p50_ms"] else "the least of each"
        lines.append(f"{size}, and {best['times_faster']:.1f} times as fast ({times}, {which}, measured here).")
    else:
        lines.append(f"{size}.")
    return lines


def _because(row: Mapping[str, Any], best: Mapping[str, Any], limits: Mapping[str, Any]) -> str:
    """Say in one phrase why a mode is the one to deploy, or why it is not worth it."""
    if row is best:
        return "the one to deploy"
    if row["missed_gates"]:
        return "misses " + "; ".join(against(missed) for missed in row["missed_gates"])
    if row["not_timed"] and best["mode"] == "static":
        return f"is no faster than static INT8: {row['not_timed']}"
    if row["mode"] == "mixed" and not row["float_blocks"]:
        return "is the same as static INT8: no block had to stay in float"
    key = _work_key([row, best])
    other = CALLED[best["mode"]]
    if key and row[key] > best[key] * (1 + limits["worth_pct"] / 100):
        times, size = row[key] / best[key], row["size_mb"] / best["size_mb"]
        how = "takes {:.1f} times as long as {}" if key == "time_ms" else "needs {:.1f} times the instructions of {}"
        larger = f", and its file is {size:.1f} times as large" if size > 1 + limits["worth_pct"] / 100 else ""
        better = error_pct(best) - error_pct(row)
        truer = (
            f" for {better:.2f} points less error" if better > limits["better_points"] and row["mode"] != "fp32" else ""
        )
        return how.format(times, other) + larger + truer
    if error_pct(row) > error_pct(best) + limits["better_points"]:
        return f"is no faster than {other}, and its error is {error_pct(row):.2f} %"
    return f"is no better than {other}: as fast, as accurate and no smaller"


def against(row: Mapping[str, Any]) -> str:
    """Put a judged gate in words: what it limits, what was found, and the limit."""
    return (
        f"{row['words']}: {row['found']:.3g}, {'at least' if row['relation'] == '>=' else 'at most'} {row['limit']:g}"
    )


def _cautions(
    stages: Stages,
    params: Mapping[str, Any],
    rows: Mapping[str, Mapping[str, Any]],
    best: Mapping[str, Any],
    drives: bool,
) -> list[str]:
    """Say what weakens the verdict, such as numbers that do not fit, too few recordings, no trial drives, or times that
    were not measured on a Pi.
    """
    compared, split = stages["compare"], stages["load"]["split"]
    lines: list[str] = []
    if recomputed := stages["load"].get("recordings", {}).get("recomputed"):
        lines.append(f"{recomputed[0].upper()}{recomputed[1:]}.")
    if units := (stages["load"]["checkpoint"].get("normalisation") or {}).get("units"):
        lines.append(f"The policy was {units} once, in its artifacts: its 0.1687 meant stopped.")
    steering = stages["load"].get("steering", {})
    if steering.get("denied"):
        lines.append(
            f"The pictures show that positive steering turns {steering['side']}, and their car's file says otherwise: "
            "is the camera's picture mirrored? `rover doctor` tells after a recorded minute."
        )
    if mirrored := steering.get("mirrored", []):
        lines.append(
            f"The pictures of {_some(mirrored)} are mirrored beside the others': leave them out, or turn them."
        )
    most, limit = compared.get("action_range", {}).get("throttle", (0, 0))[1], params["drive"]["throttle_limit"]
    if most > limit:
        lines.append(
            f"The recordings have throttle up to {most:.2f}, and a rover cuts it at {limit:g}: throttle_limit in "
            "rover_lib/onboard/params.yml."
        )
    shared = set(split["held_out"]) & set(split["calibration"])
    if shared or len(split["held_out"]) < params["verdict"]["held_out_episodes"]:
        alone = ", which were also used to calibrate" if shared else ""
        lines.append(
            f"Judged on {compared['frames']} frames of {count(len(split['held_out']), 'episode')}{alone}: too few to "
            "be sure. Record some 20 drives more, in other light and places."
        )
    if drives and not compared["fp32"]["trials"]:
        lines.append(
            "Nobody drove: only errors on recordings were judged. The first metres are the test, so hold the stick."
        )
    notes = stages["load"]["checkpoint"].get("notes", [])
    told = (*notes, *compared.get("warnings", []), *stages["quantize"].get("warnings", []))
    if odd := stages["quantize"].get("odd"):
        lines.append(_of_odd_frames(odd))
    lines += [f"{warning}." for warning in dict.fromkeys(told)]  # two stages may say the same
    if _timing(rows) == "measured here":
        lines.append(
            "The times are this machine's; on a Pi another mode may be fastest: `ansible/benchmark.yml` measures it."
        )
    if how := _busy(stages["benchmark"], params["verdict"]):
        least = time_key(stages["benchmark"], params["verdict"]) == "latency_min_ms"
        judged = "the least time of each mode is compared, and " if least else ""
        lines.append(
            f"This machine was busy when it took the times ({how}): {judged}a quiet machine gives better figures."
        )
    if best["mode"] == "fp32" and best["floor_ms"]:
        lines.append(f"A plan in FP32 takes a Pi 5 at least {best['floor_ms']:.0f} ms (computed).")
    student = stages.get("students", {}).get("recommendation", {}).get("name", "teacher")
    if student != "teacher":
        lines.append(f"A smaller policy may replace this one: {student}, as `rover world students` found.")
    return lines


def _of_odd_frames(odd: Mapping[str, Any]) -> str:
    """Name the frames that the policy answers far more strongly than the others, and how far INT8 is off there.

    odd: `frames.describe_odd`, and errors: {usual, odd: {<action>_mae_pct}} of static INT8.
    """
    off = {
        kind: ", ".join(f"{k.removesuffix('_mae_pct')} {v:.2f}" for k, v in errors.items() if v is not None)
        for kind, errors in odd["errors"].items()
    }
    others = f", by {off['usual']} % on the others" if "usual" in off else ""
    episodes, rows = list(odd["episodes"]), odd["rows"]
    at_start = f", frame {max(rows)} or earlier" if max(rows) < EARLY_FRAMES else ""
    return (
        f"In {odd['share_pct']:.1f} % of the frames ({_some(episodes)}{at_start}) {odd['block']} answers "
        f"{odd['times']:.0f} times more than usual: what is special there? Static INT8 is off by {off['odd']} % on "
        f"them{others}."
    )


def count(number: int, what: str) -> str:
    """Return a number with its noun, such as "2 episodes"."""
    return f"{number} {what}{'' if number == 1 else 's'}"


def _next(judged: Mapping[str, Any], best: str, stages: Stages, names: Names) -> list[dict[str, str]]:
    """Return at most three commands to type next, with the reason for each."""
    deploy, drove = judged["deploy"], bool(stages["compare"]["fp32"]["trials"])
    student = f"{names.name}-qat"
    left = "pretrained_model" if stages["load"]["checkpoint"].get("format") == "lerobot" else "best_model.pth"
    run = _shell("rover", "run", f"runs/{student}/{left}", names.episodes, "--name", student)
    if set(judged["refused"]) - set(MAY_DIFFER):
        why = "how long a plan takes, on any machine"
        return [{"command": _shell("rover", "benchmark", names.artifact(best)), "why": why}]
    if deploy is None:
        commands = [
            (
                f"make notebooks-open NAME={_shell(names.name)}",
                "look at notebook 01, what the car saw, and 04, what it plans",
            ),
            ("rover record --max-seconds 30 episodes", "more drives, with corrections; on the car"),
            (_shell("rover", "inspect", names.episodes), "what is in the recordings, and what is wrong with them"),
        ]
        return [{"command": command, "why": why} for command, why in commands]
    artifact = names.artifact(deploy)
    allow = json.dumps({"rover_allow": sorted(judged["refused"])}) if judged["refused"] else ""
    deploying = f"ansible-playbook -i inventory.ini ansible/deploy.yml -e {_shell(f'rover_artifact={artifact}')}"
    deploying += f" -e '{allow}'" if allow else ""
    play = "ansible-playbook -i inventory.ini ansible/"
    commands = []
    if drove:
        commands.append((_shell("rover", "view", artifact), "watch it drive, in your browser"))
    if not any(row["gate"].startswith(GATED) and not row["gate"].endswith("floor_ms") for row in judged["failed"]):
        commands.append((deploying, "put it on the rover"))
        commands.append((f"{play}benchmark.yml", "measure its time there"))
        commands.append((f"{play}drive.yml --limit rover1", "drive, transmitter in hand"))
    else:
        if deploy == "mixed":
            commands.append((deploying, "put it on the rover"))
        if not stages["quantize"].get("odd"):
            commands.append((_qat(names), "train static INT8 to keep its gates"))
            commands.append((run, "and judge that"))
        commands.append((f"make notebooks-open NAME={_shell(names.name)}", "notebook 03 has the blocks, 04 the frames"))
    return [{"command": command, "why": why} for command, why in commands[:NEXT_COMMANDS]]

"""Decide by a rule which artifact to deploy, from the JSON of a run's stages.

    stages = {name: read_stage(...)["metrics"] for name in ("load", "quantize", "compare", "benchmark")}
    judged = verdict(stages, params(), Names("runs/mine", "best_model.pth", "episodes"))

The rule takes its limits from the sections `verdict` and `gates` of params.yml. Of the modes that keep every gate, it
keeps those about as fast as the fastest; of these, those about as true to FP32 as the truest; of these, those about as
small as the smallest; and if several are left, it takes the first of PREFERRED. FP32 has no gates of error to miss, so
there is an artifact to deploy whenever the policy itself drives. `advice` says what to do about what failed.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rover_lib.onboard.artifact.acceptance import MAY_DIFFER
from rover_lib.onboard.columns import ratio
from rover_lib.workshop.judge import advice
from rover_lib.workshop.judge.advice import CALLED, Names, Stages, count, error_pct, gate_in_words
from rover_lib.workshop.judge.compare import GATED, MODES, WORLDS_LOST, error_ms, gate, gates, hits_needed
from rover_lib.workshop.judge.recorded_range import follows, worst

PREFERRED = ("fp32", "static", "mixed", "dynamic")  # between equals: the policy as trained, then the simplest
COUNTED = "counted on an emulated Cortex-A76"


def verdict(
    stages: Stages, params: Mapping[str, Any], names: Names, refusals: Mapping[str, Mapping[str, str]] | None = None
) -> dict[str, Any]:
    """Judge a run.

    Args:
        stages: the metrics of load, quantize, compare and benchmark, and of arm and students if they were made.
        params: the content of params.yml.
        names: of the checkpoint, the recordings and the run, for commands to type.
        refusals: by mode, as `Expected.refusals`.

    Returns:
        The verdict as run.json stores it. "ready": whether the policy drives. "deploy": the mode, or None if no
        artifact of it should drive this car.
    """
    limits = params["verdict"]
    benchmark = stages["benchmark"]
    rows = _rows(stages, params)
    failed = _list_failures(stages, params, names, rows)
    unfit = _list_unfit(stages, failed)
    best = _best(list(rows.values()), limits)
    slow = {} if best["mode"] in ("static", "mixed") else {"mode": "it is slow"}
    refused = (refusals or {}).get(best["mode"], slow)
    other_robot = [kind for kind in refused if kind not in MAY_DIFFER]
    deploy = None if unfit or other_robot else best["mode"]
    for row in rows.values():
        work = _work_key([row, best])
        row["because"] = advice.fill_in("because.txt", row=row, best=best, limits=limits, work=work, called=CALLED)[0]
    if deploy is None:
        best["because"] = "the best of them"
    familiar = stages["quantize"]["modes"].get(best["mode"], {}).get("familiar")
    notes = stages["compare"].get("guesses", {}).get("notes", [])
    context = {"familiar": familiar, "counted": COUNTED, "notes": notes}
    why = unfit or advice.fill_in("why.txt", best=best, fp32=rows["fp32"], **context)
    if other_robot:
        robot = "A policy for another robot" if "actions" in refused else "A rover refuses it"
        why.append(f"{robot}, to benchmark only: {'; '.join(refused[kind] for kind in other_robot)}.")
    work = _work_key(_candidates(rows.values()))  # where the figures of speed come from
    result = {
        "ready": not unfit,
        "deploy": deploy,
        "artifact": None if deploy is None else f"policy_{deploy}.pt",
        "why": why,
        "refused": dict(refused),
        "timing": {"instructions_g": COUNTED, "time_ms": "measured here", None: "not measured"}[work],
        "compared": "least ms" if time_key(benchmark, limits) == "latency_min_ms" else "p50 ms",
        "modes": list(rows.values()),
        "failed": failed,
    }
    result["cautions"] = advice.list_cautions(stages, params, result, best, _busy(benchmark, limits))
    return result | {"next": advice.list_next(result, best["mode"], stages, names)}


def _rows(stages: Stages, params: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return a row for each mode that was compared, FP32 first. Units are in the keys."""
    compared = stages["compare"]
    timed = stages["benchmark"]["artifacts"]
    instructions = stages.get("arm", {}).get("artifacts", {})
    key = time_key(stages["benchmark"], params["verdict"])
    all_found = {"fp32": compared["fp32"]} | {m: compared["modes"][m] for m in MODES if m in compared["modes"]}
    rows = {}
    for mode, metrics in all_found.items():
        time = timed.get(mode, {})
        gate_rows = [] if mode == "fp32" else gates(compared, params["gates"], mode)
        missed = [r for r in gate_rows if r["passed"] is False and mode in r["gate"]]
        rows[mode] = {
            "mode": mode,
            "size_mb": metrics["size_mb"],
            "times_smaller": compared["fp32"]["size_mb"] / metrics["size_mb"],
            "time_ms": time.get(key),
            "times_faster": ratio(timed.get("fp32", {}).get(key), time.get(key)),
            "floor_ms": time.get("floor_ms"),
            "instructions_g": instructions.get(f"policy_{mode}", {}).get("instructions_g"),
            "errors_pct": {k.removesuffix("_mae_pct"): v for k, v in metrics.items() if k.endswith("_mae_pct")},
            "error_ms": None if mode == "fp32" else error_ms(compared, mode),
            "recorded_pct": worst(v for k, v in metrics.items() if k.endswith("_vs_recorded_pct")),
            "hits": metrics["hits"],
            "trials": metrics["trials"],
            "pairs": metrics.get("pairs"),
            "float_blocks": stages["quantize"]["modes"].get(mode, {}).get("float_blocks", []),
            "worlds_decide": any(r["gate"].endswith(WORLDS_LOST) and r["passed"] is not None for r in gate_rows),
            "missed_gates": [r | {"words": gate_in_words(r["gate"])} for r in missed],
        }
    static = rows.get("static")
    mixed = rows.get("mixed")
    if static and mixed and static["time_ms"] and mixed["time_ms"] and mixed["time_ms"] < static["time_ms"]:
        # It does the same work and some of it in float: its shorter time is chance.
        mixed |= {key: static[key] for key in ("time_ms", "times_faster")}
    return rows


def _best(rows: Sequence[dict[str, Any]], limits: Mapping[str, Any]) -> dict[str, Any]:
    """Return the row that the rule takes. FP32 has no gates to miss, so there always is one."""
    same = 1 + limits["worth_pct"] / 100
    rest = _candidates(rows)
    if key := _work_key(rest):
        fastest = min(row[key] for row in rest)
        rest = [row for row in rest if row[key] <= fastest * same]
    truest = min(error_pct(row) for row in rest)
    rest = [row for row in rest if error_pct(row) <= truest + limits["better_points"]]
    smallest = min(row["size_mb"] for row in rest)
    rest = [row for row in rest if row["size_mb"] <= smallest * same]
    return min(rest, key=lambda row: PREFERRED.index(row["mode"]))


def _candidates(rows: Iterable[Mapping[str, Any]]) -> list[Any]:
    return [row for row in rows if not row["missed_gates"]]


def _work_key(rows: Sequence[Mapping[str, Any]]) -> str | None:
    """Return the key to compare speed by: instructions if all rows have them, else the time here, else None."""
    return next((k for k in ("instructions_g", "time_ms") if all(row[k] for row in rows)), None)


def time_key(benchmark: Mapping[str, Any], limits: Mapping[str, Any]) -> str:
    """Return which time of a mode is compared: the median, or the smallest if the machine was busy."""
    return "latency_min_ms" if _busy(benchmark, limits) else "latency_p50_ms"


def _busy(benchmark: Mapping[str, Any], limits: Mapping[str, Any]) -> str:
    """Say what shows that the machine did other things while it took the times; empty if nothing does."""
    cores = benchmark.get("cpu_per_core_pct")
    own_pct = benchmark.get("cpu_pct")
    if cores and own_pct is not None and len(cores) == benchmark.get("cores"):
        others_pct = sum(cores) / len(cores) - own_pct
        if others_pct > limits["busy_pct"]:
            return f"other programs had {others_pct:.0f} % of it"
    times = [t for mode, t in benchmark["artifacts"].items() if mode in CALLED and t["latency_p50_ms"]]
    spread = max((t["latency_p95_ms"] / t["latency_p50_ms"] for t in times), default=0)
    return f"p95 is {spread:.1f} times p50" if spread > limits["busy_p95"] else ""


def _list_failures(
    stages: Stages, params: Mapping[str, Any], names: Names, rows: Mapping[str, Mapping[str, Any]]
) -> list[dict[str, Any]]:
    """Return each gate that FP32 or static misses, with its remedies; those of a Pi's time and memory are left out."""
    limits = params["gates"]
    fp32 = stages["compare"]["fp32"]
    static = rows.get(GATED, {})
    promised = limits["original"]["latency_mean_ms"][1]
    trained = gate("fp32 hits", fp32["hits"], ">=", hits_needed(limits, fp32["trials"]))
    floor = gate(f"{GATED} floor_ms", static.get("floor_ms"), "<=", promised)
    failed = []
    for row in (trained, *static.get("missed_gates", []), floor):
        if row["passed"] is False:
            remedies = advice.list_remedies(row["gate"], stages, params, names, rows)
            failed.append({**row, "words": gate_in_words(row["gate"]), "remedies": remedies})
    return failed


def _list_unfit(stages: Stages, failed: Sequence[Mapping[str, Any]]) -> list[str]:
    """Say why no artifact of this policy should drive a car, and what helps; empty if nothing speaks against it."""
    compared = stages["compare"]
    looking = compared.get("looking", {})
    guesses = compared.get("guesses", {})
    fit = stages["load"].get("fit", {}).get("warnings", [])
    constant = [action for action, guess in guesses.get("actions", {}).items() if guess["held"]]
    actions = [k.removesuffix("_apart_pct") for k, v in looking.items() if k.endswith("_apart_pct") and v is not None]
    actions = [action for action in actions if action not in constant]
    blind = [a for a in actions if not follows(looking[f"{a}_by_picture_pct"], looking[f"{a}_apart_pct"])]
    return advice.fill_in(
        "unfit.txt",
        warnings=[*guesses.get("warnings", []), *fit],
        notes=guesses.get("notes", []),
        blind=blind,
        all_blind=len(blind) == len(actions),
        unlearned=[action for action, lost in guesses.get("lost", {}).items() if lost or action in blind],
        fit=fit,
        misses=any(row["gate"] == "fp32 hits" for row in failed),
        fp32=compared["fp32"],
        cautions=stages["load"].get("recordings", {}).get("cautions", []),
    )


def headline(judged: Mapping[str, Any]) -> str:
    """The verdict in one line, as `rover inspect` lists it."""
    failed = judged["failed"]
    misses = f"; {count(len(failed), 'gate')} failed" if failed else ""
    if judged["deploy"] is None:
        return f"{'to benchmark only: no policy for this car' if judged['ready'] else 'not ready to drive'}{misses}"
    row = next(row for row in judged["modes"] if row["mode"] == judged["deploy"])
    return f"deploy {judged['artifact']}, {row['size_mb']:.1f} MB, {error_pct(row):.2f} % off{misses}"

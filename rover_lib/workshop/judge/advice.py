"""Say what to do about what failed in a run, what weakens its verdict, and what to type next."""

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import ChainableUndefined, Environment, FileSystemLoader

from rover_lib.onboard.artifact.acceptance import MAY_DIFFER
from rover_lib.workshop.judge import recorded_range as judge
from rover_lib.workshop.judge.compare import GATED

CALLED = {"fp32": "FP32", "dynamic": "dynamic INT8", "static": "static INT8", "mixed": "mixed INT8"}
PHRASES = {  # what people call the parts of a gate's name
    "mae_pct": "error, % of the recorded range",
    "hits": "balloons hit",
    "simd_g": "SIMD instructions, 10^9",
    "instructions_g": "instructions, 10^9",
    "model_size_mb": "size, MB, as the original promised",
    "size_mb": "size, MB",
    "peak_memory_loading_mb": "memory while loading, MB",
    "peak_memory_mb": "memory, MB",
    "memory_mb": "memory, MB",
    "floor_ms": "time of a plan on a Pi 5 at the very best, ms (computed)",
    "latency_mean_ms": "time of a plan, mean, ms",
    "latency_p95_ms": "time of a plan, 95th percentile, ms",
    "throughput_fps": "plans a second",
    "control_rate_hz": "commands a second",
    "cpu_pct": "processor, % of all cores",
    "temperature_c": "temperature, Celsius",
    "throttled": "what the Pi's firmware throttled",
}
NEXT_COMMANDS, MOST_CAUTIONS = 3, 5
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
        return Path(self.run).name

    def artifact(self, mode: str) -> str:
        return f"{self.run.rstrip('/')}/policy_{mode}.pt"


def gate_in_words(gate: str) -> str:
    """Return any gate's name as people read it; a name that is already in words stays as it is."""
    subject, _, key = gate.removeprefix("policy_").partition(" ")
    mode = subject.partition("_")[0].partition(".")[0]
    if mode in CALLED and key:
        gate = f"{subject.replace(mode, CALLED[mode], 1)}: {key}"
    for known in [known for known in PHRASES if known in gate][:1]:
        gate = gate.replace(known, PHRASES[known])
    return gate.replace("_", " ")


def against(row: Mapping[str, Any]) -> str:
    """Put a judged gate in words: what it limits, what was found, and the limit."""
    most = "at least" if row["relation"] == ">=" else "at most"
    return f"{row['words']}: {row['found']:.3g}, {most} {row['limit']:g}"


def error_pct(row: Mapping[str, Any]) -> float:
    """Return the larger of the actions' errors, in percent of the recorded range; 0 for FP32 or if none was judged."""
    return judge.worst(row["errors_pct"]) or 0.0


def count(number: int, what: str) -> str:
    """Return a number with its noun, such as "2 episodes"."""
    return f"{number} {what}{'' if number == 1 else 's'}"


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - MOST_EPISODES} more" if len(names) > MOST_EPISODES else ""
    return ", ".join(names[:MOST_EPISODES]) + more


def _lines(template: str, **values: Any) -> list[str]:
    """Fill in a template of this folder, and return its lines that are not empty."""
    pages = Environment(loader=FileSystemLoader(Path(__file__).parent), undefined=ChainableUndefined)
    text = pages.get_template(template).render(
        some=_some, count=count, error_pct=error_pct, worst=judge.worst, **values
    )
    return [line.strip() for line in text.splitlines() if line.strip()]


def list_remedies(
    gate: str, stages: Stages, params: Mapping[str, Any], names: Names, rows: Mapping[str, Mapping[str, Any]]
) -> list[str]:
    """Say what to do about a gate that FP32 or static INT8 misses, the cheapest remedy first: remedies.txt."""
    key, quantized = gate.partition(" ")[2], stages["quantize"]
    alone = {block: judge.worst(errors) or 0.0 for block, errors in quantized.get("sensitivity", {}).items()}
    worst = [w for w in stages["compare"].get("worst", []) if w["mode"] == GATED]
    return _lines(
        "remedies.txt",
        gate=gate,
        key=key,
        smaller=_smaller(stages, names),
        mixed=rows.get("mixed", {}),
        most_cost_pct=params["quantization"]["mixed_max_cost_pct"],
        odd=quantized.get("odd"),
        worst_block=max(alone.items(), key=lambda item: item[1], default=None),
        episodes=list(dict.fromkeys(str(w["episode"]) for w in worst if w["episode"])),
    )


def _smaller(stages: Stages, names: Names) -> str:
    """Return a `rover distill` command for half the picture's sides, or for a narrower policy."""
    config = stages["load"]["checkpoint"].get("trainer_config") or {}
    width, height = (config.get(f"image_{side}", 0) // 2 for side in ("width", "height"))
    shape = ["--size", f"{width}x{height}"] if width and height else ["--feedforward", "1600"]
    return shlex.join(["rover", "distill", names.checkpoint, names.episodes, *shape, "--name", f"{names.name}-small"])


def list_cautions(
    stages: Stages, params: Mapping[str, Any], judged: Mapping[str, Any], best: Mapping[str, Any], busy: str
) -> list[str]:
    """Say what weakens the verdict, at most MOST_CAUTIONS lines of cautions.txt, the most important first.

    best: the row of the mode that the rule takes. busy: what shows that the machine was.
    """
    load, compared, quantized = stages["load"], stages["compare"], stages["quantize"]
    clipped = quantized.get("clipped", {})
    if quantized["modes"].get(GATED, {}).get("scheme", {}).get("observer") == "frames":
        clipped = {}  # it clips odd frames on purpose
    cautions = _lines(
        "cautions.txt",
        **stages,
        judged=judged,
        best=best,
        busy=busy,
        limits=params["verdict"],
        early_frames=EARLY_FRAMES,
        odd=quantized.get("odd"),
        clipped=clipped if clipped.get("clipped_pct", 0) > params["quantization"]["clipped_warn_pct"] else {},
        most_throttle=compared.get("action_range", {}).get("throttle", (0, 0))[1],
        throttle_limit=params["drive"]["throttle_limit"],
        held_out=load["split"]["held_out"],
        shared=set(load["split"]["held_out"]) & set(load["split"]["calibration"]),
        warnings=dict.fromkeys(w for stage in (compared, quantized) for w in stage.get("warnings", [])),
        allowed=[why for kind, why in judged["refused"].items() if kind in MAY_DIFFER and kind != "mode"],
    )
    return cautions[:MOST_CAUTIONS]


def list_next(judged: Mapping[str, Any], best: str, stages: Stages, names: Names) -> list[dict[str, str]]:
    """Return at most three commands to type next, with the reason for each. No command drives what is not to drive."""
    deploy, artifact = judged["deploy"], names.artifact(judged["deploy"] or best)
    notebooks = f"make notebooks-open NAME={shlex.quote(names.name)}"
    commands: list[tuple[str, str]] = []
    if set(judged["refused"]) - set(MAY_DIFFER):
        commands.append((shlex.join(["rover", "benchmark", artifact]), "how long a plan takes, on any machine"))
    elif deploy is None:
        inspect = shlex.join(["rover", "inspect", names.episodes])
        commands += [
            (notebooks, "look at notebook 01, what the car saw, and 04, what it plans"),
            ("rover record --max-seconds 30 episodes", "more drives, with corrections; on the car"),
            (inspect, "what is in the recordings, and what is wrong with them"),
        ]
    else:
        commands += _to_drive(judged, stages, names, artifact)
    if deploy and any(row["gate"].startswith(GATED) for row in judged["failed"]):
        commands.append((notebooks, "notebook 03 has the blocks, 04 the frames"))
    return [{"command": command, "why": why} for command, why in commands[:NEXT_COMMANDS]]


def _to_drive(judged: Mapping[str, Any], stages: Stages, names: Names, artifact: str) -> list[tuple[str, str]]:
    if stages["compare"]["fp32"]["trials"]:  # it learned in the balloon world, or would not drive there
        watch = "make watch" if names.name == "demo" else shlex.join(["rover", "view", artifact])
        record = "rover record --max-seconds 30 episodes"
        return [(watch, "watch it drive, in your browser"), (record, "record your own drives, on the car")]
    play = "ansible-playbook -i inventory.ini ansible/"
    allow = json.dumps({"rover_allow": sorted(judged["refused"])}) if judged["refused"] else ""
    deploying = f"{play}deploy.yml -e {shlex.quote(f'rover_artifact={artifact}')}" + (f" -e '{allow}'" if allow else "")
    if not any(row["gate"].startswith(GATED) and not row["gate"].endswith("floor_ms") for row in judged["failed"]):
        return [
            (deploying, "put it on the rover"),
            (f"{play}benchmark.yml", "measure its time there"),
            (f"{play}drive.yml --limit rover1", "drive, transmitter in hand"),
        ]
    return [(deploying, "put it on the rover")] if judged["deploy"] == "mixed" else []

"""Say what to do about what failed in a run, what weakens its verdict, and what to type next."""

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rover_lib.onboard.care.release import MAY_DIFFER
from rover_lib.workshop.judge import recorded_range as judge
from rover_lib.workshop.judge.compare import GATED

CALLED = {"fp32": "FP32", "dynamic": "dynamic INT8", "static": "static INT8", "mixed": "mixed INT8"}
PHRASES = {  # what people call the parts of a gate's name
    "of_spread_pct": "error, % of how much the plans vary",
    "mae_pct": "error, % of the recorded range",
    "accuracy_loss_pct": "largest error, % of the recorded range, as the original promised",
    "hits lost": "balloons missed that FP32 hits",
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

    def distill(self, *options: str, name: str) -> str:
        """A `rover distill` command on the same files, with the name of what it makes."""
        return shlex.join(["rover", "distill", self.checkpoint, self.episodes, *options, "--name", name])


def gate_in_words(gate: str) -> str:
    """Return any gate's name as people read it: of a comparison, a benchmark, a drive, a count or a student.

    A name that is already in words stays as it is.
    """
    subject, _, key = gate.removeprefix("policy_").partition(" ")
    mode = subject.partition("_")[0].partition(".")[0]
    if mode in CALLED and key:
        gate = f"{subject.replace(mode, CALLED[mode], 1)}: {key}"
    for known, words in PHRASES.items():
        if known in gate:
            gate = gate.replace(known, words)
            break
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


# --- what to do about a gate that was missed --------------------------------------------------------------------------


def list_remedies(
    gate: str, stages: Stages, params: Mapping[str, Any], names: Names, rows: Mapping[str, Mapping[str, Any]]
) -> list[str]:
    """Say what to do about a gate that FP32 or static INT8 misses, the cheapest remedy first."""
    key = gate.partition(" ")[2]
    if gate == "fp32 hits":
        return [
            "No other format can fix this: train longer, on more recordings.",
            "Record drives in which the car has left its way and is steered back, so that the policy learns it.",
        ]
    smaller = f"a smaller policy can: `{_smaller(stages, names)}`."
    if key == "floor_ms":
        return [f"Driving at 30 Hz does not need it: one plan covers a second. No program can be faster, but {smaller}"]
    if key in ("size_mb", "model_size_mb"):
        return [f"INT8 cannot make it smaller; {smaller}"]
    return _of_errors(key.removesuffix("_mae_pct").removesuffix("_of_spread_pct"), stages, params, names, rows)


def _of_errors(
    action: str, stages: Stages, params: Mapping[str, Any], names: Names, rows: Mapping[str, Mapping[str, Any]]
) -> list[str]:
    quantized = stages["quantize"]
    remedies = [_of_mixed(params, rows)]
    # Where frames are odd, training with INT8's rounding began from bad ranges and repaired little. From good
    # ones it is untried.
    if quantized.get("odd"):
        remedies.append(
            "The frames that the cautions name take the steps of INT8 from all others: leave out drives that should "
            "not be there, or train on more frames like them, so that the policy answers them as it does the others."
        )
    else:
        remedies.append(f"Train it for INT8: `{_qat(names)}`, then `rover run` on what it leaves.")
    alone = {block: errors.get(f"{action}_mae_pct") for block, errors in quantized.get("sensitivity", {}).items()}
    if judged := {block: error for block, error in alone.items() if error is not None}:
        block = max(judged, key=lambda name: judged[name])
        remedies.append(f"Most of it comes from {block}: {judged[block]:.2f} % with that alone in INT8 (notebook 03).")
    limit = params["quantization"]["clipped_warn_pct"]
    if clipped := [row["name"] for row in quantized.get("layers", []) if (row.get("clipped_pct") or 0) > limit]:
        remedies.append(
            f"{_some(clipped)} met larger values than in calibration: record more of what was missing there, such as "
            "other light, other places, sharper turns."
        )
    frames = [w for w in stages["compare"].get("worst", []) if (w["mode"], w["action"]) == (GATED, action)]
    if worst := list(dict.fromkeys(str(w["episode"]) for w in frames if w["episode"])):
        where = "where the error is largest (notebook 04 shows the frames)"
        remedies.append(f"Record more drives like {_some(worst)}, {where}.")
    return remedies


def _of_mixed(params: Mapping[str, Any], rows: Mapping[str, Mapping[str, Any]]) -> str:
    mixed = rows.get("mixed")
    if mixed is None or not mixed["float_blocks"]:
        most = params["quantization"]["mixed_max_cost_pct"]
        return f"Mixed can leave no block in float within a cost of {most:g} %: raise mixed_max_cost_pct in params.yml."
    leaves = f"it leaves {', '.join(mixed['float_blocks'])} in float"
    if mixed["missed_gates"]:
        missed = ", ".join(row["words"] for row in mixed["missed_gates"])
        return f"Mixed does not fix it: {leaves}, and still misses: {missed}."
    return f"Mixed fixes it: {leaves}, and its largest error is {error_pct(mixed):.2f} %."


def _qat(names: Names) -> str:
    return names.distill("--qat", name=f"{names.name}-qat")


def _smaller(stages: Stages, names: Names) -> str:
    """Return a `rover distill` command for a smaller policy.

    It halves the picture's sides if they are known, and asks for two decoder layers if there are more. If neither
    applies, it asks for a narrower feed-forward layer.
    """
    report = stages["load"]["checkpoint"]
    config = report.get("trainer_config") or {}
    width, height = config.get("image_width"), config.get("image_height")
    shape = ["--size", f"{width // 2}x{height // 2}"] if width and height else []
    layers = len({block.split(".")[1] for block in report["macs_by_block"] if block.startswith("decoder.")})
    if layers > 2:
        shape += ["--decoder-layers", "2"]
    return names.distill(*(shape or ["--feedforward", "1600"]), name=f"{names.name}-small")


# --- what weakens the verdict -----------------------------------------------------------------------------------------


def list_cautions(
    stages: Stages, params: Mapping[str, Any], judged: Mapping[str, Any], best: Mapping[str, Any], busy: str
) -> list[str]:
    """Say what weakens the verdict, such as numbers that do not fit, too few recordings, no trial drives, or times that
    were not measured on a Pi. best: the row of the mode that the rule takes. busy: what shows that the machine was.
    """
    compared, deploy = stages["compare"], judged["deploy"]
    lines = _of_recordings(stages, params)
    if deploy and not compared["fp32"]["trials"]:
        lines.append(
            "Nobody drove: only errors on recordings were judged. The first metres are the test, so hold the stick."
        )
    if odd := stages["quantize"].get("odd"):
        lines.append(_of_odd_frames(odd))
    notes = stages["load"]["checkpoint"].get("notes", [])
    told = (*notes, *compared.get("warnings", []), *stages["quantize"].get("warnings", []))
    lines += [f"{warning}." for warning in dict.fromkeys(told)]  # two stages may say the same
    if judged["timing"] == "measured here":
        lines.append(
            "The times are this machine's; on a Pi another mode may be fastest: `ansible/benchmark.yml` measures it."
        )
    if busy:
        least = "the least time of each mode is compared, and " if judged["compared"] == "least ms" else ""
        lines.append(
            f"This machine was busy when it took the times ({busy}): {least}a quiet machine gives better figures."
        )
    if best["mode"] == "fp32" and best["floor_ms"]:
        lines.append(f"A plan in FP32 takes a Pi 5 at least {best['floor_ms']:.0f} ms (computed).")
    student = stages.get("students", {}).get("recommendation", {}).get("name", "teacher")
    if student != "teacher":
        lines.append(f"A smaller policy may replace this one: {student}, as `rover world students` found.")
    allowed = [why for kind, why in judged["refused"].items() if kind in MAY_DIFFER and kind != "mode"]
    if deploy and allowed:
        lines.append(
            f"Was it trained for this car? A rover takes it only if rover_allow says so: {'; '.join(allowed)}."
        )
    return lines


def _of_recordings(stages: Stages, params: Mapping[str, Any]) -> list[str]:
    load, compared, lines = stages["load"], stages["compare"], []
    if recomputed := load.get("recordings", {}).get("recomputed"):
        lines.append(f"{recomputed[0].upper()}{recomputed[1:]}.")
    if units := (load["checkpoint"].get("normalisation") or {}).get("units"):
        lines.append(f"The policy was {units} once, in its artifacts: its 0.1687 meant stopped.")
    steering = load.get("steering", {})
    if steering.get("denied"):
        lines.append(
            f"The pictures show that positive steering turns {steering['side']}, and their car's file says otherwise: "
            "is the camera's picture mirrored? `rover doctor` tells after a recorded minute."
        )
    if mirrored := steering.get("mirrored", []):
        lines.append(f"Pictures of {_some(mirrored)} are mirrored beside the others': leave them out, or turn them.")
    most, limit = compared.get("action_range", {}).get("throttle", (0, 0))[1], params["drive"]["throttle_limit"]
    if most > limit:
        place = "throttle_limit in rover_lib/onboard/params.yml"
        lines.append(f"The recordings have throttle up to {most:.2f}, and a rover cuts it at {limit:g}: {place}.")
    held_out = load["split"]["held_out"]
    shared = set(held_out) & set(load["split"]["calibration"])
    if shared or len(held_out) < params["verdict"]["held_out_episodes"]:
        alone = ", which were also used to calibrate" if shared else ""
        few = f"Judged on {compared['frames']} frames of {count(len(held_out), 'episode')}{alone}"
        lines.append(f"{few}: too few to be sure. Record some 20 drives more, in other light and places.")
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
    at_start = f", frame {max(odd['rows'])} or earlier" if max(odd["rows"]) < EARLY_FRAMES else ""
    return (
        f"In {odd['share_pct']:.1f} % of the frames ({_some(list(odd['episodes']))}{at_start}) {odd['block']} answers "
        f"{odd['times']:.0f} times more than usual: what is special there? Static INT8 is off by {off['odd']} % on "
        f"them{others}."
    )


# --- what to type next ------------------------------------------------------------------------------------------------


def list_next(judged: Mapping[str, Any], best: str, stages: Stages, names: Names) -> list[dict[str, str]]:
    """Return at most three commands to type next, with the reason for each. No command drives what is not to drive."""
    deploy, artifact = judged["deploy"], names.artifact(judged["deploy"] or best)
    notebooks = f"make notebooks-open NAME={shlex.quote(names.name)}"
    commands: list[tuple[str, str]] = []
    if set(judged["refused"]) - set(MAY_DIFFER):
        commands.append((shlex.join(["rover", "benchmark", artifact]), "how long a plan takes, on any machine"))
    elif deploy is None:
        commands += [
            (notebooks, "look at notebook 01, what the car saw, and 04, what it plans"),
            ("rover record --max-seconds 30 episodes", "more drives, with corrections; on the car"),
            (
                shlex.join(["rover", "inspect", names.episodes]),
                "what is in the recordings, and what is wrong with them",
            ),
        ]
    else:
        commands += _to_drive(judged, stages, names, artifact)
    if deploy and any(row["gate"].startswith(GATED) for row in judged["failed"]):
        commands.append((notebooks, "notebook 03 has the blocks, 04 the frames"))
    return [{"command": command, "why": why} for command, why in commands[:NEXT_COMMANDS]]


def _to_drive(judged: Mapping[str, Any], stages: Stages, names: Names, artifact: str) -> list[tuple[str, str]]:
    play = "ansible-playbook -i inventory.ini ansible/"
    allow = json.dumps({"rover_allow": sorted(judged["refused"])}) if judged["refused"] else ""
    deploying = f"{play}deploy.yml -e {shlex.quote(f'rover_artifact={artifact}')}" + (f" -e '{allow}'" if allow else "")
    commands = []
    if stages["compare"]["fp32"]["trials"]:
        commands.append((shlex.join(["rover", "view", artifact]), "watch it drive, in your browser"))
    if not any(row["gate"].startswith(GATED) and not row["gate"].endswith("floor_ms") for row in judged["failed"]):
        return [
            *commands,
            (deploying, "put it on the rover"),
            (f"{play}benchmark.yml", "measure its time there"),
            (f"{play}drive.yml --limit rover1", "drive, transmitter in hand"),
        ]
    if judged["deploy"] == "mixed":
        commands.append((deploying, "put it on the rover"))
    if not stages["quantize"].get("odd"):
        name = f"{names.name}-qat"
        left = "pretrained_model" if stages["load"]["checkpoint"].get("format") == "lerobot" else "best_model.pth"
        run = shlex.join(["rover", "run", f"runs/{name}/{left}", names.episodes, "--name", name])
        commands += [(_qat(names), "train static INT8 to keep its gates"), (run, "and judge that")]
    return commands

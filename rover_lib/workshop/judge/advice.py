"""Say what to do about what failed in a run, what weakens its verdict, and what to type next."""

import json
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import ChainableUndefined, Environment, FileSystemLoader

from rover_lib.onboard.artifact.acceptance import MAY_DIFFER
from rover_lib.onboard.columns import UNITS
from rover_lib.workshop.judge.compare import GATED
from rover_lib.workshop.judge.recorded_range import worst

CALLED = {"fp32": "FP32", "dynamic": "dynamic INT8", "static": "static INT8", "mixed": "mixed INT8"}
NEXT_COMMANDS, MOST_CAUTIONS = 3, 5
MOST_EPISODES = 3  # a remedy names at most this many

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
    words, _, unit = gate.replace("floor_ms", "time of a plan on a Pi 5 at the very best (computed)_ms").rpartition("_")
    return f"{words}, {UNITS[unit]}".replace("_", " ") if unit in UNITS else gate.replace("_", " ")


def against(row: Mapping[str, Any]) -> str:
    """Put a judged gate in words: what it limits, what was found, and the limit."""
    bound = "at least" if row["relation"] == ">=" else "at most"
    return f"{row['words']}: {row['found']:.3g}, {bound} {row['limit']:g}"


def error_pct(row: Mapping[str, Any]) -> float:
    """Return the larger of the actions' errors, in percent of the recorded range; 0 for FP32 or if none was judged."""
    return worst(row["errors_pct"]) or 0.0


def count(number: int, what: str) -> str:
    """Return a number with its noun, such as "2 episodes"."""
    return f"{number} {what}{'' if number == 1 else 's'}"


def _some(names: Sequence[str]) -> str:
    more = f" and {len(names) - MOST_EPISODES} more" if len(names) > MOST_EPISODES else ""
    return ", ".join(names[:MOST_EPISODES]) + more


def fill_in(template: str, **values: Any) -> list[str]:
    """Fill in a template of this folder, and return its lines that are not empty."""
    pages = Environment(loader=FileSystemLoader(Path(__file__).parent), undefined=ChainableUndefined)
    # A name that breaks its line must not put a command of its own on the next one.
    pages.filters |= {"quote": lambda name: shlex.quote(" ".join(name.splitlines())), "against": against}
    text = pages.get_template(template).render(some=_some, count=count, error_pct=error_pct, worst=worst, **values)
    return [line.strip() for line in text.splitlines() if line.strip()]


def list_remedies(
    gate: str, stages: Stages, params: Mapping[str, Any], names: Names, rows: Mapping[str, Mapping[str, Any]]
) -> list[str]:
    """Say what to do about a gate that FP32 or static INT8 misses, the cheapest remedy first: remedies.txt."""
    alone = {block: worst(errors) or 0.0 for block, errors in stages["quantize"].get("sensitivity", {}).items()}
    block = max(alone.items(), key=lambda item: item[1], default=None)
    return fill_in(
        "remedies.txt",
        **stages,
        params=params,
        gate=gate,
        rows=rows,
        worst_block=block,
        smaller=_smaller(stages, names),
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
    allowed = [why for kind, why in judged["refused"].items() if kind in MAY_DIFFER and kind != "mode"]
    cautions = fill_in("cautions.txt", **stages, params=params, judged=judged, best=best, busy=busy, allowed=allowed)
    return cautions[:MOST_CAUTIONS]


def list_next(judged: Mapping[str, Any], best: str, stages: Stages, names: Names) -> list[dict[str, str]]:
    """Return at most three commands to type next, with the reason for each: next.txt."""
    failed = [row["gate"] for row in judged["failed"] if row["gate"].startswith(GATED)]
    artifact = names.artifact(judged["deploy"] or best)
    lines = fill_in(
        "next.txt",
        judged=judged,
        compare=stages["compare"],
        load=stages.get("load", {}),
        names=names,
        artifact=artifact,
        deployed=_deployed(artifact, sorted(judged["refused"])),
        other_robot=set(judged["refused"]) - set(MAY_DIFFER),
        failed=failed,
    )
    steps = [line.rpartition("  # ") for line in lines[:NEXT_COMMANDS]]
    return [{"command": command, "why": why} for command, _, why in steps]


def _deployed(artifact: str, allow: Sequence[str]) -> str:
    """What deploy.yml is told by -e. Ansible splits name=value at spaces, and reads JSON as it is."""
    if not allow and re.fullmatch(r"[\w./-]+", artifact):
        return f"rover_artifact={artifact}"
    settings: dict[str, Any] = {"rover_artifact": artifact}
    return json.dumps(settings | ({"rover_allow": list(allow)} if allow else {}), ensure_ascii=False)

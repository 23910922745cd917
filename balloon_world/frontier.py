"""Which student may take its teacher's place? A rule decides: it holds students.json's rows to limits from params.yml.

verdict = recommendation(rows, params()["students"])
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from rover_lib.workshop.judge.compare import gate
from rover_lib.workshop.judge.recorded_range import format_pct, worst
from rover_lib.workshop.notebook_table import Table

NOBODY_DROVE = "Nobody drove: judged by errors on recordings alone."
DRIVES = {"": "left alone", "pushed_": "pushed"}  # how a row's keys begin, and the words for that kind of drive


def sign_test(only_one: int, only_other: int) -> float:
    """Return p: how likely chance alone divides the worlds that only one of two policies hits at least as unevenly.

    This is the exact two-sided sign test on discordant pairs (McNemar's exact test); p is 1 if there are none.
    """
    n, fewer = only_one + only_other, min(only_one, only_other)
    return min(1.0, 2 * sum(math.comb(n, k) for k in range(fewer + 1)) / 2**n)


def pair_worlds(row: Mapping[str, Any], teacher: Mapping[str, Any], drive: str) -> dict[str, Any] | None:
    """Compare a student with its teacher in the same worlds: count the worlds that only one of them hit.

    drive: a key of DRIVES. Returns None if either did not drive that way.
    """
    if row[f"{drive}missed"] is None or teacher[f"{drive}missed"] is None:
        return None
    own, teachers = set(row[f"{drive}missed"]), set(teacher[f"{drive}missed"])
    only_student, only_teacher = len(teachers - own), len(own - teachers)
    return {
        "only_student": only_student,
        "only_teacher": only_teacher,
        "sign_test_p": sign_test(only_student, only_teacher),
    }


def points_above(row: Mapping[str, Any], teacher: Mapping[str, Any]) -> float | None:
    """Return by how many percentage points a student's error to the recordings exceeds its teacher's; the worst action.

    None if no action's error is known for both.
    """
    keys = [key for key in row if key.startswith("recorded_") and key.endswith("_pct")]
    return worst(row[key] - teacher[key] for key in keys if row[key] is not None and teacher[key] is not None)


def gates_of(row: Mapping[str, Any], teacher: Mapping[str, Any], limits: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Hold a student to the rule; return rows of `compare.gate`. limits: params.yml's section `students`.

    Drives are judged only if the teacher drove. Then a kind of drive that is missing neither passes nor fails.
    """
    rows = []
    for drive, how in DRIVES.items() if teacher["trials"] else ():
        lost = None
        if row[f"{drive}trials"] and teacher[f"{drive}trials"]:
            lost = 100 * (teacher[f"{drive}hits"] - row[f"{drive}hits"]) / teacher[f"{drive}trials"]
        rows.append(gate(f"{row['name']} worlds lost, {how}, %", lost, "<=", limits[f"{drive}worlds_lost_pct"]))
    above, limit = points_above(row, teacher), limits["recorded_points"]
    return [*rows, gate(f"{row['name']} error to the recordings, points above", above, "<=", limit)]


def work_key(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the key that decides which row is fastest: instructions if all are counted, else multiply-accumulates."""
    return "gmac" if any(row["instructions_g"] is None for row in rows) else "instructions_g"


def recommendation(rows: Sequence[Mapping[str, Any]], limits: Mapping[str, Any]) -> dict[str, Any]:
    """Choose the fastest student that passes every gate, or the teacher if none does.

    rows: of students.json, the teacher first. Returns {"name", "fastest_by", "gates": of all students}.
    """
    teacher, *students = rows
    gates = {row["name"]: gates_of(row, teacher, limits) for row in students}
    key = work_key(rows)
    passed = [row for row in students if all(g["passed"] for g in gates[row["name"]])]
    fastest = min(passed, key=lambda row: row[key], default=teacher)
    return {"name": fastest["name"], "fastest_by": key, "gates": [g for its_gates in gates.values() for g in its_gates]}


# --- in words ---------------------------------------------------------------------------------------------------------


def shape_of(row: Mapping[str, Any]) -> str:
    layers = f"{row['decoder_layers']} decoder layer{'s' if row['decoder_layers'] != 1 else ''}"
    share = f", {row['backbone_channels']:.0%} of the channels" if row.get("backbone_channels") else ""
    return f"{row['width']}x{row['height']}, {layers} of {row['feedforward']}{share}{', QAT' if row['qat'] else ''}"


def table(metrics: Mapping[str, Any]) -> Table:
    """Show a teacher and its students as a table, a row each. metrics: of students.json."""
    actions = _actions(metrics["students"][0])
    header = ("", "MB", "GMAC", "10^9 instructions", "ms, computed", "left alone", "pushed")
    rows = []
    for row in metrics["students"]:
        counted = "-" if row["instructions_g"] is None else f"{row['instructions_g']:.3g}"
        span = "not counted" if row["computed_ms"] is None else "{:.3g} to {:.3g}".format(*row["computed_ms"])
        pushed = _of(row, "pushed_") + (f" at {row['pushed_latency_ms']:.0f} ms" if row["pushed_trials"] else "")
        errors = (" / ".join(_plain(row[f"{to}_{action}_pct"]) for action in actions) for to in ("teacher", "recorded"))
        work = (f"{row['size_mb']:.1f}", f"{row['gmac']:.3g}", counted, span)
        rows.append((f"{row['name']}: {shape_of(row)}", *work, _of(row, ""), pushed, *errors))
    what = f"errors in {' / '.join(actions)}, of the static INT8 artifact, % of the recorded range"
    notes = (what, *metrics["notes"], *metrics["warnings"])
    return Table((*header, "to the teacher, %", "to the recordings, %"), rows, notes=notes)


def sentences(metrics: Mapping[str, Any]) -> list[str]:
    """Say the recommendation in plain English, a sentence to a line. metrics: of students.json."""
    teacher, *students = metrics["students"]
    verdict, limits = metrics["recommendation"], metrics["limits"]
    lines = [_rule(limits, bool(teacher["trials"]))]
    chosen = next((row for row in students if row["name"] == verdict["name"]), None)
    if chosen is None:
        lines.append("No student keeps to that: stay with the teacher.")
    else:
        by = {"instructions_g": "fewest instructions", "gmac": "fewest multiply-accumulates"}[verdict["fastest_by"]]
        lines.append(f"Recommended: {chosen['name']} ({shape_of(chosen)}), which has the {by} of those that do.")
    for row in students:
        lines += [f"{row['name']}, {how}: {_in_pairs(row, teacher, d)}" for d, how in DRIVES.items() if row["trials"]]
    for found in verdict["gates"]:
        if not found["passed"]:
            seen = "not measured" if found["found"] is None else f"{found['found']:.2f}, at most {found['limit']:g}"
            lines.append(f"Not kept: {found['gate']}: {seen}.")
    return lines if teacher["trials"] else [*lines, NOBODY_DROVE]


def _rule(limits: Mapping[str, Any], drove: bool) -> str:
    drives = (
        f"loses at most {limits['worlds_lost_pct']:g} % of the worlds when left alone and "
        f"{limits['pushed_worlds_lost_pct']:g} % when pushed, and "
        if drove
        else ""
    )
    return (
        f"The rule: the fastest student that {drives}is at most {limits['recorded_points']:g} points further from the "
        "recordings than its teacher."
    )


def _in_pairs(row: Mapping[str, Any], teacher: Mapping[str, Any], drive: str) -> str:
    found = pair_worlds(row, teacher, drive)
    if found is None:
        return "not driven."
    uneven, even = found["only_student"] + found["only_teacher"], found["sign_test_p"]
    text = f"{_of(row, drive)} worlds, its teacher {_of(teacher, drive)}"
    if not uneven:
        return f"{text}; the very same ones."
    sure = "chance alone seldom does that" if even < 0.05 else "chance alone does as much"
    return (
        f"{text}; {found['only_student']} only the student hit, {found['only_teacher']} only the teacher: {sure} "
        f"(sign test, p = {even:.2g})."
    )


def _actions(row: Mapping[str, Any]) -> list[str]:
    return [key.removeprefix("teacher_").removesuffix("_pct") for key in row if key.startswith("teacher_")]


def _of(row: Mapping[str, Any], drive: str) -> str:
    return f"{row[f'{drive}hits']} of {row[f'{drive}trials']}" if row[f"{drive}trials"] else "-"


def _plain(value: float | None) -> str:
    return format_pct(value).strip().removesuffix(" %")

"""Say in a sentence what a figure shows. It is computed from what is drawn, so it also says when the opposite is true.

A function returns an empty text if what it would compare is not there.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from rover_lib.onboard.params import params
from rover_lib.workshop.judge.compare import GATED, Fidelity, WorstFrame
from rover_lib.workshop.judge.recorded_range import worst
from rover_lib.workshop.judge.verdict import CALLED, time_key


def _upper(text: str) -> str:
    return text[:1].upper() + text[1:]


def _called(mode: str) -> str:
    return CALLED.get(mode, mode)


def times(over: float | None, under: float | None, more: str, less: str) -> str:
    """Return "4.2 times as fast", for example, or "... as slow"; an empty text if one was not measured, or is 0."""
    if not over or not under:
        return ""
    ratio = over / under
    if round(ratio, 1) == 1.0:
        return f"as {more}"
    return f"{ratio:.1f} times as {more}" if ratio > 1 else f"{1 / ratio:.1f} times as {less}"


# --- INT8 beside FP32 -------------------------------------------------------------------------------------------------


def size(sizes_mb: Mapping[str, float]) -> str:
    """sizes_mb: of the artifacts, by mode."""
    if not (GATED in sizes_mb and "fp32" in sizes_mb):
        return ""
    return f"{_upper(_called(GATED))} is {times(sizes_mb['fp32'], sizes_mb[GATED], 'small', 'large')} as FP32"


def error(report: Fidelity, mode: str = GATED) -> str:
    if mode not in report.chunks:
        return ""
    means = {action: report.summary(mode)[f"{action}_mae_pct"] for action in report.action_names}
    known = {action: pct for action, pct in means.items() if pct is not None}
    if not known:
        return ""
    action = max(known, key=lambda name: known[name])
    how = f"at most {known[action]:.2f} % of the recorded range" if known[action] >= 0.005 else "less than 0.01 %"
    return f"{_upper(_called(mode))} is off by {how}, most in {action}"


def odd_frames(odd: Mapping[str, Any], most: float) -> str:
    """odd: `frames.describe_odd`. most: how many times the median frame's largest value any frame's is."""
    if not odd:
        return f"No frame is odd: none has values above {most:.1f} times the median frame's"
    return f"On {odd['share_pct']:.1f} % of the frames {odd['block']} answers {odd['times']:.0f} times more than usual"


def worst_frame(frame: WorstFrame) -> str:
    return f"On its worst frame {_called(frame.mode)} is {frame.error_pct:.2f} % off, in {frame.action}"


def hits(metrics: Mapping[str, Any], mode: str = GATED) -> str:
    """metrics: those of compare.json."""
    fp32, other = metrics["fp32"], metrics["modes"].get(mode, {})
    if not (fp32.get("trials") and other.get("trials")):
        return ""
    more = other["hits"] - fp32["hits"]
    if not more:
        return f"{_upper(_called(mode))} hits what FP32 hits: {fp32['hits']} of {fp32['trials']}"
    return f"{_upper(_called(mode))} hits {abs(more)} {'more' if more > 0 else 'fewer'} of {fp32['trials']} than FP32"


def apart(most_m: float, worlds: int) -> str:
    """most_m: the largest distance between two drives in one world, in metres."""
    return f"In {worlds} worlds the drives part by at most {100 * most_m:.0f} cm"


# --- speed ------------------------------------------------------------------------------------------------------------


def speed(benchmarks: Mapping[str, Mapping[str, Any]]) -> str:
    """Compare the first host's times as the verdict does: medians, or the least where the machine was busy.

    benchmarks: contents of benchmark-<host>.json by host.
    """
    host, content = next(iter(benchmarks.items()))
    key = time_key(content["metrics"], params()["verdict"])
    compared = {name: v[key] for name, v in content["metrics"]["artifacts"].items()}
    how = times(compared.get("fp32"), compared.get(GATED), "fast", "slow")
    by = "" if key == "latency_p50_ms" else ", by the least time of each"
    return f"{_upper(_called(GATED))} is {how} as FP32 on {host}{by}" if how else ""


def instructions(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """rows: counts by mode, as in arm.json."""
    fp32, static = (rows.get(mode, {}).get("instructions_g") for mode in ("fp32", GATED))
    if not (fp32 and static):
        return ""
    over = static / rows[GATED]["floor_g"]
    return (
        f"{_upper(_called(GATED))}: {fp32 / static:.1f} times fewer instructions than FP32, {over:.2f} times the floor"
    )


def smaller_picture(rows: Sequence[Mapping[str, Any]]) -> str:
    """rows: the static artifacts of arm.json, the one with the least work first."""
    least, most = rows[0], rows[-1]
    if least is most:
        return ""
    share = most["instructions_g"] / least["instructions_g"]
    sizes = [f"{m['image_width']}x{m['image_height']}" for m in (least, most)]
    return f"A plan at {sizes[0]} takes {share:.1f} times fewer instructions than at {sizes[1]}"


# --- the checkpoint and its calibration -------------------------------------------------------------------------------


def work(parameters: Mapping[str, int], macs: Mapping[str, int], part: str = "backbone") -> str:
    """Say what share of the work and of the weights a part of the policy has. parameters, macs: by block."""

    def share(amounts: Mapping[str, int]) -> float:
        of_part = sum(n for block, n in amounts.items() if block.split(".")[0] == part)
        return 100 * of_part / max(sum(amounts.values()), 1)

    return f"The {part} has {share(macs):.0f} % of the work, and {share(parameters):.0f} % of the weights"


def coverage(chosen: Sequence[Sequence[float]], pool: Sequence[Sequence[float]], names: Sequence[str]) -> str:
    """Say how much of each action's recorded range the chosen frames reach. chosen, pool: (n, actions)."""
    shares = []
    for name, own, every in zip(names, zip(*chosen, strict=True), zip(*pool, strict=True), strict=False):
        whole = max(every) - min(every)
        if whole > 0:
            shares.append(f"{100 * (max(own) - min(own)) / whole:.0f} % of {name}")
    if not shares:
        return ""
    least = shares if len(shares) <= 2 else sorted(shares, key=lambda share: float(share.split()[0]))[:1]
    return f"{len(chosen)} of {len(pool)} frames reach {' and '.join(least)}'s recorded range"


def clipped(rows: Sequence[Mapping[str, Any]], limit_pct: float) -> str:
    """rows: from `inspect_layers`."""
    count = sum(row["clipped_pct"] > limit_pct for row in rows)
    return f"{count or 'None'} of {len(rows)} layers clip{'s' if count == 1 else ''} more than {limit_pct:g} %"


def even(before: float, after: float) -> str:
    """before, after: the worst projection's largest channel divided by its median one."""
    if after >= before:
        return f"Channel scales do not help the worst projection: {before:.0f} times its median channel before"
    return f"Channel scales take the worst projection from {before:.0f} to {after:.1f} times its median channel"


def least_wrong(table: Mapping[str, Mapping[str, float | None]]) -> str:
    """table: {choice: {<action>_mae_pct}}."""
    found = {choice: value for choice, row in table.items() if (value := worst(row)) is not None}
    if len(found) < 2:
        return ""
    best = min(found, key=lambda choice: found[choice])
    return f"{_upper(best)} is least wrong: {found[best]:.2f} %, the others up to {max(found.values()):.2f} %"


def most_sensitive(table: Mapping[str, Mapping[str, float | None]]) -> str:
    """table: {block: {<action>_mae_pct}}."""
    found = {block: value for block, row in table.items() if (value := worst(row)) is not None}
    if not found:
        return ""
    block = max(found, key=lambda name: found[name])
    return f"{block} suffers most: {found[block]:.2f} % from it alone"


# --- late plans and students ------------------------------------------------------------------------------------------


def late_hits(alone: Sequence[Mapping[str, Any]]) -> str:
    """Say how late plans may be without losing a balloon. alone: compensated rows of drive.json, of cars left alone."""
    rows = sorted(alone, key=lambda row: row["latency_ms"])
    if not rows:
        return ""
    best, late = rows[0]["hits"], None
    for row in rows:
        if row["hits"] < best:
            break
        late = row["latency_ms"]
    return f"Left alone, plans may be {late:g} ms late and no balloon is lost" if late else ""


def beside(compensated: Mapping[float, float], others: Mapping[float, float]) -> str:
    """Say at which latencies compensation keeps the car closer, and at which not.

    compensated, others: median cm from the path, by the latency in ms.
    """
    common = sorted(ms for ms in compensated.keys() & others.keys() if compensated[ms] and others[ms])
    closer = [ms for ms in common if compensated[ms] < others[ms]]
    if not common:
        return ""
    if not closer:
        return "Compensation keeps the car no closer to its path"
    further = [ms for ms in common if ms not in closer]
    but = f", and not at {_and(further)} ms" if further else ""
    return f"Compensation keeps the car closer to its path at {_and(closer)} ms{but}"


def _and(numbers: Sequence[float]) -> str:
    *first, last = (f"{number:g}" for number in numbers)
    return f"{', '.join(first)} and {last}" if first else last


def student(students: Sequence[Mapping[str, Any]], chosen: str) -> str:
    """students: rows of students.json, the teacher first. chosen: the name of the recommended one."""
    teacher = students[0]
    row = next((r for r in students[1:] if r["name"] == chosen), None)
    if row is None:
        return "No student keeps to the rule: the teacher stays"
    less = f"{teacher['gmac'] / row['gmac']:.1f} times less work"
    if not (row["trials"] and teacher["trials"]):
        return f"{chosen}: {less}; nobody drove"
    lost = teacher["hits"] - row["hits"]
    return f"{chosen}: {less}, and {f'{lost} balloons lost' if lost > 0 else 'no balloon lost'} when left alone"


# --- corrected and demonstrated ---------------------------------------------------------------------------------------


def learned(policies: Sequence[Mapping[str, Any]]) -> str:
    """policies: rows of learn.json, first the one that all began with."""
    first, last = policies[0], max(row["round"] for row in policies)
    of = {row["arm"]: row["pushed"] for row in policies if row["round"] == last}
    if not {"corrected", "demonstrated"} <= of.keys():
        return ""
    own, other, before = of["corrected"]["hits"], of["demonstrated"]["hits"], first["pushed"]["hits"]
    among = f"of {first['pushed']['trials']} worlds"
    return f"Pushed, it hit {before} {among}; corrected {own}, after as many seconds of demonstrations {other}"

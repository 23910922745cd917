"""Writes the tables in the pages: results from the JSON in results/, parameters from the notebooks.

    python -m lab.repository.page_tables        # what `make notebooks` does at its end

A table stands once in README.md, a page of docs/ or the role's README.md, between `<!-- table NAME, by page_tables -->`
and `<!-- end -->`. Nobody edits them by hand. A field without its JSON is empty, and a row without any measurement is
left out.
"""

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import nbformat
import yaml

from balloon_world.learn import HOW
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.stage import read_stage
from rover_lib.workshop.run.run import parameters_in

ROOT = Path(__file__).parents[2]
EXPLAINED = {  # the modes, in words that need no other page
    "fp32": "FP32, as trained",
    "dynamic": "*dynamic* INT8: linear layers only",
    "static": "***static* INT8**: all layers",
    "mixed": "*mixed*: static, the most sensitive parts in FP32",
}
BEST = "static"
ROLE = Path("ansible", "roles", "rover")
PLACE = re.compile(r"(<!-- table (\w+), by page_tables -->\n)(.*?)(<!-- end -->)", re.S)

Row = tuple[str, ...]


def changed_pages(root: Path = ROOT) -> dict[Path, str]:
    """Return the new texts of the pages in `root` whose tables differ from its results/ and notebooks/.

    Raises RoverError unless the pages have each table once.
    """
    pages = (root / "README.md", root / ROLE / "README.md", *sorted((root / "docs").glob("*.md")))
    texts = {path: path.read_text() for path in pages}
    names = [match[2] for text in texts.values() for match in PLACE.finditer(text)]
    if sorted(names) != sorted(TABLES):
        raise RoverError("the pages must have each table once", found=names or "none", remedy=f"mark {sorted(TABLES)}")

    def place(match: re.Match[str]) -> str:
        header, *rows = TABLES[match[2]](root)
        lines = [header, ("---",) * len(header), *rows]
        return match[1] + "".join(map(_line, lines)) + match[4]

    new = {path: PLACE.sub(place, text) for path, text in texts.items()}
    return {path: text for path, text in new.items() if text != texts[path]}


def _line(fields: Row) -> str:
    return "|" + "".join(f" {field} |" if field else " |" for field in fields) + "\n"


def _demo(root: Path) -> list[Row]:
    """The demo's policy, a row for each mode; a mixed one without blocks in float is static."""
    compared = _metrics(root / "results" / "demo", "compare")
    timed = _metrics(root / "results" / "demo", "benchmark-*")["artifacts"]
    modes = {"fp32": compared["fp32"]} | compared["modes"]
    if not _metrics(root / "results" / "demo", "quantize")["modes"].get("mixed", {}).get("float_blocks"):
        modes.pop("mixed", None)

    def row(mode: str) -> Row:
        metrics = modes[mode]
        errors = [f"{metrics[f'{action}_mae_pct']:.2f}" for action in ("steering", "throttle") if mode != "fp32"]
        hits = f"{metrics['hits']} of {metrics['trials']}"
        faster = f"{timed['fp32']['latency_p50_ms'] / timed[mode]['latency_p50_ms']:.1f}"
        fields = (f"{metrics['size_mb']:.1f}", hits, " / ".join(errors), faster)
        return EXPLAINED[mode], *(f"**{field}**" if mode == BEST else field for field in fields)

    return [("", "MB", "balloons hit", "error, %", "times faster"), *(row(mode) for mode in EXPLAINED if mode in modes)]


def _faults(root: Path) -> list[Row]:
    """What was done to a driving car, and what became of it."""
    report, random = (_metrics(root / "results" / "lab", name) for name in ("faults", "random"))

    def right(expected: str) -> str:
        rows = [fault for fault in report["faults"] if fault["expected"] == expected]
        return f"{sum(not fault['wrong'] for fault in rows)} of {len(rows)}"

    broken = f"{len(random['broken'])} of {random['drives']:,}"
    worst, takeover = (report["summary"][key] for key in ("worst_stopped_after_ms", "takeover_ms"))
    return [
        ("what", "figure"),
        ("faults that must stop a driving car: throttle off", f"{right('stopped')}, after at most {worst:.0f} ms"),
        ("faults that must not stop it: it drove on while its plan was young enough", right("continues")),
        ("faults that must keep it from being armed", right("refused")),
        ("from a moved stick to the human's pulses", f"at most {takeover:.0f} ms"),
        ("random drives in virtual time that broke a safety rule", broken),
    ]


def _drives(root: Path) -> list[Row]:
    """Hits of the demo's policy when its plans are late, and when the car is pushed."""
    rows = [r for r in _metrics(root / "results" / "demo", "drive")["rows"] if r["compensate"] and r["hits"]]
    alone, pushed = ({r["latency_ms"]: r for r in rows if bool(r["pushes"]) == way} for way in (False, True))
    latencies = sorted(alone.keys() & pushed.keys())
    trials = rows[0]["trials"]
    return [
        (f"balloons hit of {trials}, with plans that take", *(f"{latency:.0f} ms" for latency in latencies)),
        ("left alone", *(str(alone[latency]["hits"]) for latency in latencies)),
        ("pushed on its way", *(str(pushed[latency]["hits"]) for latency in latencies)),
    ]


def _cars(root: Path) -> list[Row]:
    """What became of the recordings of each real car."""
    rows: list[Row] = [
        ("place, camera", "pictures", "steering, R²: policy / CNN", "off, % (blind guess)", "static, % / ms", "verdict")
    ]
    for place, car in _metrics(root / "results" / "real", "cars")["cars"].items():
        if "r2" not in car:
            continue
        r2 = f"{car['r2']['0.5']:.2f} / {car['cnn_r2']['0.5']:.2f}"
        off = f"{car['off_pct'][0]:.1f} ({car['blind_pct'][0]:.1f})"
        static = f"{max(car['static_pct']):.2f} / {car['static_ms'][0]:.0f}"
        verdict = "ready" if car["ready"] else "not ready"
        rows.append((f"{place}, {car['camera']}", f"{car['pictures']:,}", r2, off, static, verdict))
    return rows


def _learning(root: Path) -> list[Row]:
    """The demo's policy before and after learning on, from corrections and from demonstrations."""
    policies = _metrics(root / "results" / "demo", "learn")["policies"]
    conditions = {key: value["trials"] for key, value in policies[0].items() if isinstance(value, dict)}

    def row(policy: Mapping[str, Any]) -> Row:
        name = policy["arm"] + (f", round {policy['round']}" if policy["round"] else "")
        return (name, f"{policy['human_s']:.0f}", *(str(policy[condition]["hits"]) for condition in conditions))

    hits = (f"{HOW[condition]}: hits of {trials}" for condition, trials in conditions.items())
    return [("policy", "seconds by a human", *hits), *map(row, policies)]


def _judging(root: Path) -> list[Row]:
    """How well each measure tells the versions of policies that lose worlds from the others, the best first."""
    measures = _metrics(root / "results" / "lab", "judging")["measures"]
    rows: list[Row] = [("error", "area", "least of losers", "others above")]
    for name, measure in sorted(measures.items(), key=lambda item: -item[1]["auc"]):
        words = name.replace("_ms", ", ms").replace("_pct", ", %").replace("_", " ")
        rows.append((words, f"{measure['auc']:.2f}", f"{measure['least_of_losers']:.3g}", str(measure["refused"])))
    return rows


def _parameters(root: Path) -> list[Row]:
    """The notebooks' titles, and what papermill's -p sets; run_dir is in all of them."""
    rows: list[Row] = []
    for path in sorted((root / "notebooks").glob("*.ipynb")):
        title = nbformat.read(path, as_version=4).cells[0].source.partition("\n")[0].removeprefix("# ")
        names = ", ".join(f"`{name}`" for name, *_ in parameters_in(path) if name != "run_dir")
        rows.append((f"[{path.stem}](../notebooks/{path.name})", title, names))
    return [("notebook", "question", "parameters to turn"), *rows]


def _variables(root: Path) -> list[Row]:
    """The role's variables, each once, as its argument specs describe them."""
    specs = yaml.safe_load((root / ROLE / "meta" / "argument_specs.yml").read_text())["argument_specs"]
    options = {name: option for spec in specs.values() for name, option in spec["options"].items()}
    rows: list[Row] = []
    for name, option in sorted(options.items()):
        default = "needed" if option.get("required") else f"`{json.dumps(option['default'], ensure_ascii=False)}`"
        rows.append((f"`{name}`", option["description"], default.replace("|", "\\|")))
    return [("variable", "what it means", "default"), *rows]


TABLES: dict[str, Callable[[Path], list[Row]]] = {
    "demo": _demo,
    "faults": _faults,
    "drives": _drives,
    "cars": _cars,
    "learning": _learning,
    "judging": _judging,
    "parameters": _parameters,
    "variables": _variables,
}


def _metrics(folder: Path, stage: str) -> dict[str, Any]:
    """A stage's metrics. Raises RoverError if it is not there."""
    path = next(folder.glob(f"{stage}.json"), folder / f"{stage}.json")
    return read_stage(path, stage.removesuffix("-*"))["metrics"]


if __name__ == "__main__":
    for path, text in changed_pages().items():
        path.write_text(text)
        print(f"{path.name}: written")

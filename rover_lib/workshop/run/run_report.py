"""What a run ends with: its verdict as run.json, in words, and as a model card.

content = write("runs/mine")        # run.json, from the JSON that its stages left
print(text(content["metrics"]))
"""

from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import yaml
from jinja2 import Template

from rover_lib.onboard.artifact.acceptance import THIS_CAR
from rover_lib.onboard.artifact.manifest import content_hash, read_manifest
from rover_lib.onboard.columns import align, number
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.params import params
from rover_lib.onboard.stage import atomic_path, read_stage, sha256_of, write_stage
from rover_lib.workshop.installed import relative, typed
from rover_lib.workshop.judge.advice import CALLED, Names, against
from rover_lib.workshop.judge.hosts import benchmark_of, is_of
from rover_lib.workshop.judge.verdict import headline, verdict

STAGES = ("load", "quantize", "compare")  # without which there is nothing to judge, nor without a benchmark
CARD = "rover-policy"  # this project's name, by which a card that we wrote is known
AGAIN = "'rover run' of its checkpoint makes it again"


def write(run_dir: Path | str) -> dict[str, Any]:
    """Judge a run and leave run.json in its folder. Returns its content.

    Made anew of what is there, with what `make count` and `rover world students` added. Raises RoverError where a stage
    is missing, is of other artifacts or lacks what is to be judged, and for an artifact that was not compared.
    """
    folder = Path(run_dir)
    p = params()
    files = _files(folder)
    contents = {stage: read_stage(path, stage) for stage, path in files.items()}
    try:
        modes = contents["quantize"]["metrics"]["modes"]
        _refuse_other_artifacts(folder, modes, contents["compare"]["inputs"])
        if (timed := benchmark_of(folder, modes)) is None:
            raise RoverError(f"{folder}: no benchmark of its artifacts", remedy=AGAIN)
        files["benchmark"] = timed
        contents["benchmark"] = read_stage(files["benchmark"], "benchmark")
        loaded = contents["load"]["params"]
        names = Names(*(relative(path) for path in (folder.resolve(), loaded["checkpoint"], loaded["episodes"])))
        there = {mode: path for mode in modes if (path := folder / f"policy_{mode}.pt").is_file()}
        refusals = {mode: THIS_CAR.refusals(read_manifest(path)) for mode, path in there.items()}
        result = verdict({stage: content["metrics"] for stage, content in contents.items()}, p, names, refusals)
        result = {"headline": headline(result), "host": contents["benchmark"]["env"]["host"], **result}
    except KeyError as missing:
        raise RoverError(f"{folder}: its stages lack {missing}, as of another version", remedy=AGAIN) from missing
    inputs = {path.name: sha256_of(path) for path in files.values()}
    loaded = {"verdict": p["verdict"], "gates": p["gates"]}
    return write_stage(folder / "run.json", "run", params=loaded, metrics=result, inputs=inputs)


def _files(folder: Path) -> dict[str, Path]:
    """The JSON of each stage but the benchmark. Raises RoverError for one that is missing."""
    files = {stage: folder / f"{stage}.json" for stage in (*STAGES, "arm", "students")}
    if missing := [files[stage].name for stage in STAGES if not files[stage].is_file()]:
        raise RoverError(f"{folder}: no verdict without {', '.join(missing)}", remedy=AGAIN)
    return {stage: path for stage, path in files.items() if path.is_file()}


def _refuse_other_artifacts(folder: Path, modes: Mapping[str, Any], compared: Mapping[str, str]) -> None:
    """Raise RoverError for a comparison of other artifacts, and for a policy_<mode>.pt that was put there later.

    modes: quantize.json's. compared: compare.json's inputs.
    """
    if not is_of(compared, modes):
        raise RoverError(f"{folder / 'compare.json'}: is of other artifacts than this run's", remedy=AGAIN)
    for mode, entry in modes.items():
        path = folder / f"policy_{mode}.pt"
        if path.is_file() and (actual_hash := content_hash(path)) != entry["content_hash"]:
            contents = f"content {actual_hash[:12]} instead of {entry['content_hash'][:12]}"
            raise RoverError(f"{path}: not the artifact that this run made", found=contents, remedy=AGAIN)


def text(judged: Mapping[str, Any]) -> str:
    """The verdict for a terminal, in lines."""
    lines = [f"Verdict: {judged['headline']}", *(f"  {line}" for line in judged["why"]), ""]
    lines += align(columns(judged))
    lines += [f"{CALLED[row['mode']]}: {row['because']}" for row in judged["modes"]]
    if judged["failed"]:
        lines += ["", "What failed:"]
        for row in judged["failed"]:
            lines += [f"  {against(row)}", *(f"    - {remedy}" for remedy in row["remedies"])]
    if judged["cautions"]:
        lines += ["", "Keep in mind:", *(f"  {line}" for line in judged["cautions"])]
    lines += ["", "Next:", *(f"  {typed(step['command'])}\n      {step['why']}" for step in judged["next"])]
    return "\n".join(lines)


def columns(judged: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """The modes beside each other, a header first: for a terminal and for a card. A dash where nothing was measured."""
    actions = list(dict.fromkeys(chain.from_iterable(row["errors_pct"] for row in judged["modes"])))
    instructions = ("10^9 instructions",) if any(row["instructions_g"] for row in judged["modes"]) else ()
    errors = (f"{action} error, %" for action in actions)
    lines = [("", "MB", "times smaller", *errors, "hits", judged["compared"], "times faster", *instructions)]
    for row in judged["modes"]:
        cells = [CALLED[row["mode"]], number(row["size_mb"]), number(row["times_smaller"])]
        cells += [number(row["errors_pct"].get(action), ".2f") for action in actions]
        cells += [f"{row['hits']} of {row['trials']}" if row["trials"] else "-", number(row["time_ms"])]
        cells += [number(row["times_faster"]), *(number(row["instructions_g"], ".3g") for _ in instructions)]
        lines.append(tuple(cells))
    return lines


def write_card(run_dir: Path | str, **given: str | None) -> Path:
    """Write README.md, a model card for the Hub, into a run's folder; return its path.

    given: license and base_model of the Hub's metadata; without them a LeRobot checkpoint's own, if it has any.
    Raises RoverError if the run has no verdict, and if there is a README.md that this has not written.
    """
    folder = Path(run_dir)
    result, load = (read_stage(folder / f"{name}.json", name)["metrics"] for name in ("run", "load"))
    path = folder / "README.md"
    if path.exists() and CARD not in path.read_text(errors="replace"):
        raise RoverError(f"{path}: is not a card that this has written", remedy="move it away")
    header, *rows = columns(result)
    recordings = load["recordings"]
    metadata = {key: given.get(key) or load["checkpoint"].get(key) for key in ("license", "base_model")}
    hub = {key: value for key, value in metadata.items() if value}
    if "base_model" in hub:
        hub["base_model_relation"] = "quantized"
    values = {"name": folder.resolve().name, "judged": result, "header": header, "rows": rows, "recordings": recordings}
    values["hub"] = yaml.safe_dump(hub) if hub else ""
    with atomic_path(path) as temporary:
        temporary.write_text(Template(Path(__file__).with_name("card.md").read_text()).render(values))
    return path

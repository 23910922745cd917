"""Put what runs showed into the repository: outputs into its notebooks, the JSON behind them into results/, pictures.

    python -m lab.repository.publish       # what `make notebooks` does

results/<run>/<stage>.json is what the run left, less paths of this machine, the hashes of every recorded frame, and the
digits of a number after its sixth. What quotes a number reads it there. A picture has the hash of the JSON behind it.
"""

import hashlib
import json
import re
from pathlib import Path
from typing import Any

import nbformat
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.stage import atomic_path, sha256_of
from rover_lib.workshop.run.run import NAMES, NOTEBOOKS

RESULTS_OF = {"05_benchmark": "benchmark-*", "08_distill": "students"}  # the others' stages are their names
# Where make leaves them.
OF_LABORATORY = ("faults*.json", "random.json", "mutants.json", "strange.json", "judging.json", "drives*.json")
PICTURES = {"sensitivity": ("03_sensitivity", "quantize"), "worst_frames": ("04_worst_frames", "compare")}  # of figures
LIMIT = 1_000_000  # bytes, of a committed notebook or JSON
DIGITS = 6  # of each number: pages, notebooks and tests read four
MANY_INPUTS = 40  # hashes of files; more of them are summed up in one
ABSOLUTE = re.compile(r"/(?:home|root|tmp|Users|work|var|opt|mnt)/|[A-Z]:\\\\")


def publish_all(runs_dir: Path | str = "runs", notebooks_dir: Path | str = NOTEBOOKS) -> list[Path]:
    """Publish the demo's run; the count and the students of runs/full; what `rover distill` and the laboratory left.

    What is not there is left out, except for the demo's own five notebooks. Returns the files written. Raises
    RoverError if a notebook was not run, has changed since, holds a path of this machine, or is too large; then
    nothing is written.
    """
    runs_dir, root = Path(runs_dir), Path(notebooks_dir).resolve().parent
    texts: dict[Path, str] = {}
    for run, names in (("demo", (*NAMES, "07_drive", "08_distill", "09_learn")), ("full", ("06_arm", "08_distill"))):
        for name in names:
            if name in NAMES or (runs_dir / run / f"{name}.ipynb").is_file():
                texts |= _of_notebook(name, runs_dir / run, root)
    reports = {path: "lab" for pattern in OF_LABORATORY for path in runs_dir.glob(pattern)}
    reports |= {runs_dir / "demo" / "arm.json": "demo"}
    texts |= {root / "results" / to / path.name: result(path) for path, to in reports.items() if path.is_file()}
    for path in sorted(runs_dir.glob("*/distill.json")):
        texts[root / "results" / "students" / f"{path.parent.name}.json"] = result(path)
    for target, text in texts.items():
        if len(text) > LIMIT:
            raise RoverError(f"{target.name}: {len(text) / 1e6:.1f} MB of at most 1", remedy="draw or tell less")
        if path_shown := ABSOLUTE.search(text):
            around = text[max(path_shown.start() - 40, 0) : path_shown.end() + 40]
            raise RoverError(f"{target.name}: shows a path of this machine", found=around, remedy="write names only")
    for target, text in texts.items():
        with atomic_path(target) as temporary:
            temporary.write_text(text)
    pictures = []
    for name, (figure, stage) in PICTURES.items():
        pictures.append(root / "pictures" / f"{name}.png")
        stored = root / "results" / "demo" / f"{stage}.json"
        store_picture(runs_dir / "demo" / "figures" / f"{figure}.png", pictures[-1], stored)
    return [*texts, *pictures]


def store_picture(figure: Path, target: Path, shown: Path) -> None:
    """Store a run's figure in 256 colours, which says what JSON it shows."""
    info = PngInfo()
    info.add_text("Source", source_of(shown))
    with Image.open(figure) as drawn, atomic_path(target) as temporary:
        drawn.convert("RGB").quantize(256).save(temporary, "png", optimize=True, pnginfo=info)


def source_of(shown: Path) -> str:
    """Return what a picture's metadata says of the JSON that it shows: its place in results/, and its SHA-256."""
    return f"{shown.parent.name}/{shown.name} {sha256_of(shown)}"


def _of_notebook(name: str, run_dir: Path, root: Path) -> dict[Path, str]:
    """Return the notebook's text with a run's outputs, and its stage's JSON, by where they belong."""
    target, executed = root / "notebooks" / f"{name}.ipynb", run_dir / f"{name}.ipynb"
    if not executed.is_file():
        raise RoverError(f"{executed}: not there", remedy="execute the run first")
    texts = {target: with_outputs(nbformat.read(target, as_version=4), nbformat.read(executed, as_version=4), name)}
    for path in sorted(run_dir.glob(f"{RESULTS_OF.get(name, name.partition('_')[2])}.json")):
        texts[root / "results" / run_dir.name / path.name] = result(path)
    return texts


def with_outputs(source: Any, executed: Any, name: str) -> str:
    """Return a notebook with the outputs of its execution: no counts, no stderr, no metadata. Cells match by id."""
    ran = {cell.id: cell for cell in executed.cells}
    for cell in source.cells:
        if cell.cell_type != "code":
            continue
        is_parameters = "parameters" in cell.metadata.get("tags", [])  # a run writes its own values there
        if cell.id not in ran or (ran[cell.id].source != cell.source and not is_parameters):
            raise RoverError(f"{name}: cell '{cell.id}' is not what was executed", remedy="execute the run again")
        cell.outputs = [_plain(output) for output in ran[cell.id].outputs if output.get("name") != "stderr"]
        cell.execution_count = None
    return nbformat.writes(source) + "\n"


def _plain(output: Any) -> Any:
    output = nbformat.from_dict(dict(output))
    output.pop("transient", None)
    if "execution_count" in output:
        output.execution_count = None
    if picture := output.get("data", {}).get("image/png"):
        output.data = {"image/png": picture}  # without "<Figure size ...>"
    if "metadata" in output:
        output.metadata = {kind: size for kind, size in output.metadata.items() if kind == "image/png"}  # its size
    return output


def result(path: Path) -> str:
    """Return a stage's JSON as it is committed: names instead of paths, and numbers of DIGITS digits."""
    content = _shorter(json.loads(path.read_text()))
    if len(inputs := content.get("inputs", {})) > MANY_INPUTS:
        together = hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()
        content["inputs"] = {f"{len(inputs)} files": together}
    return json.dumps(content, indent=1) + "\n"


def _shorter(value: Any) -> Any:
    if isinstance(value, dict):
        return {_shorter(k): _shorter(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_shorter(v) for v in value]
    if isinstance(value, str) and Path(value).is_absolute():
        return Path(value).name
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


if __name__ == "__main__":
    for path in publish_all():
        print(path.name)

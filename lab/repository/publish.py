"""Put what runs showed into the repository: outputs into its notebooks, and the JSON behind them into results/.

    python -m lab.repository.publish       # what `make notebooks` does

results/<run>/<stage>.json is what the run left, less paths of this machine, the hashes of every recorded frame, and the
digits of a number after its sixth. What quotes a number reads it there.
"""

import hashlib
import io
import json
import re
import sys
import tempfile
from base64 import b64decode, b64encode
from pathlib import Path
from typing import Any

import nbformat
from PIL import Image

from lab.shorten import shorten
from rover_lib.onboard.stage import atomic_path
from rover_lib.workshop.run.run import NAMES, NOTEBOOKS, NotebookError

RESULTS_OF = {  # stages that a notebook leaves
    "01_load": "load",
    "02_calibrate": "calibrate",
    "03_quantize": "quantize",
    "04_compare": "compare",
    "05_benchmark": "benchmark-*",
    "06_arm": "arm",
    "07_drive": "drive",
    "08_distill": "students",
    "09_learn": "learn",
}
OF_LABORATORY = (  # in runs/, where make leaves them
    "faults.json",
    "faults-crawler.json",
    "faults-inverted.json",
    "faults-gamepad.json",
    "random.json",
    "mutants.json",
    "kills.json",
    "pi.json",
)
IMAGE_LIMIT = 120_000  # bytes; larger pictures are committed with 256 colours
NOTEBOOK_LIMIT = 1_000_000  # bytes, of a committed notebook
RESULT_LIMIT = 200_000  # bytes, of a committed JSON
DIGITS = 6  # of each number: pages, notebooks and tests read four
MANY_INPUTS = 40  # hashes of files; more of them are summed up in one
ABSOLUTE = re.compile(r"/(?:home|root|tmp|Users|work|var|opt|mnt)/|[A-Z]:\\\\")


def publish(
    run_dir: Path | str, notebooks_dir: Path | str = NOTEBOOKS, names: tuple[str, ...] | None = None
) -> list[Path]:
    """Put a run's outputs into the repository's notebooks: no counts, no papermill metadata, no paths of this machine;
    and the JSON behind them into results/<run>, beside the notebooks' folder.

    names: of the notebooks, without .ipynb; the five of a run if None. Cells are matched by id, and their sources must
    be the same. Large pictures get 256 colours. Returns the files written. Raises NotebookError if a notebook was not
    run, has changed since, still holds a path, or is larger than 1 MB; then nothing is written.
    """
    run_dir, notebooks_dir = Path(run_dir).resolve(), Path(notebooks_dir).resolve()
    texts: dict[Path, str] = {}
    for name in NAMES if names is None else names:
        target, executed = notebooks_dir / f"{name}.ipynb", run_dir / f"{name}.ipynb"
        if not executed.is_file():
            raise NotebookError(f"{executed}: not there", remedy="execute the run first")
        text = _publish(nbformat.read(target, as_version=4), nbformat.read(executed, as_version=4), name)
        for folder in (run_dir, notebooks_dir.parent, Path.home(), Path(tempfile.gettempdir()), Path(sys.prefix)):
            if len(str(folder)) > 1 and f"{folder}/" in text:
                raise NotebookError(f"{name}: an output shows a path below {folder}", remedy="print names, not paths")
        if len(text) > NOTEBOOK_LIMIT:
            size = f"{len(text) / 1e6:.1f} MB with its outputs"
            raise NotebookError(f"{name}: {size}", remedy="draw less, 1 MB is the limit")
        texts[target] = text
        for path in sorted(run_dir.glob(f"{RESULTS_OF[name]}.json")):
            texts[notebooks_dir.parent / "results" / run_dir.name / path.name] = _result(path)
    return _write(texts)


def publish_all(runs_dir: Path | str = "runs", notebooks_dir: Path | str = NOTEBOOKS) -> list[Path]:
    """Publish the demo, its count, its student and what it learned; of runs/full its count and its students; what
    `rover distill` left of each student; of the laboratory its reports: where they are there.
    """
    runs_dir, notebooks_dir = Path(runs_dir), Path(notebooks_dir)
    learned = ("09_learn",) if (runs_dir / "demo" / "09_learn.ipynb").is_file() else ()
    written = publish(runs_dir / "demo", notebooks_dir, (*NAMES, "07_drive", "08_distill", *learned))
    of_full = tuple(name for name in ("06_arm", "08_distill") if (runs_dir / "full" / f"{name}.ipynb").is_file())
    if of_full:
        written += publish(runs_dir / "full", notebooks_dir, of_full)
    results = notebooks_dir.resolve().parent / "results"
    reports = {runs_dir / name: results / "lab" / name for name in OF_LABORATORY}
    for name in ("arm.json", "arm-cortex-a72.json"):  # notebook 06 shows the full size's count
        reports[runs_dir / "demo" / name] = results / "demo" / name
    reports |= {path: results / "students" / f"{path.parent.name}.json" for path in students(runs_dir)}
    return written + _write({target: _result(path) for path, target in reports.items() if path.is_file()})


def students(runs_dir: Path) -> list[Path]:
    """What `rover distill` left of each student."""
    return sorted(runs_dir.glob("*/distill.json"))


def _write(texts: dict[Path, str]) -> list[Path]:
    for target, text in texts.items():
        with atomic_path(target) as temporary:
            temporary.write_text(text)
    return list(texts)


# --- the JSON ---------------------------------------------------------------------------------------------------------


def _result(path: Path) -> str:
    """A stage's JSON as it is committed. Raises NotebookError if it still holds a path, or is large."""
    content = json.loads(path.read_text())
    if len(inputs := content.get("inputs", {})) > MANY_INPUTS:
        lines = "".join(f"{sha256}  {name}\n" for name, sha256 in sorted(inputs.items()))
        content["inputs"] = {f"{len(inputs)} files": hashlib.sha256(lines.encode()).hexdigest()}
    text = json.dumps(shorten(_names_only(content), DIGITS), indent=1) + "\n"
    if (shown := ABSOLUTE.search(text)) is not None:
        around = text[max(shown.start() - 40, 0) : shown.end() + 40]
        raise NotebookError(f"{path.name}: shows a path of this machine", found=around, remedy="write names, not paths")
    if len(text) > RESULT_LIMIT:
        size = f"{len(text) / 1e3:.0f} kB"
        raise NotebookError(
            f"{path.name}: {size}, of at most {RESULT_LIMIT / 1e3:.0f}", remedy="leave out what is bulk"
        )
    return text


def _names_only(value: Any) -> Any:
    """The same value, with the last part of every absolute path in it."""
    if isinstance(value, dict):
        return {_names_only(k): _names_only(v) for k, v in value.items()}
    if isinstance(value, list):
        return [_names_only(v) for v in value]
    if isinstance(value, str) and Path(value).is_absolute():
        return Path(value).name
    return value


# --- the notebooks ----------------------------------------------------------------------------------------------------


def _publish(source: Any, executed: Any, name: str) -> str:
    outputs = {c.id: c for c in executed.cells if c.cell_type == "code"}
    for cell in source.cells:
        if cell.cell_type != "code":
            continue
        ran = outputs.get(cell.id)
        if ran is None or ran.source != cell.source:
            what = f"{name}: cell '{cell.id}' is not what was executed"
            raise NotebookError(what, remedy="execute the run again")
        cell.outputs = [_plain_output(o) for o in ran.outputs if o.get("name") != "stderr"]
        cell.execution_count = None
    return nbformat.writes(source) + "\n"


def _plain_output(output: Any) -> Any:
    output = nbformat.from_dict(dict(output))
    if "execution_count" in output:
        output.execution_count = None
    output.pop("transient", None)
    if picture := output.get("data", {}).get("image/png"):
        output.data = {"image/png": _smaller(picture)}  # without "<Figure size ...>"
    if "metadata" in output:
        output.metadata = {kind: how for kind, how in output.metadata.items() if kind == "image/png"}  # its size
    return output


def _smaller(picture: str) -> str:
    """A base64 PNG, with 256 colours if it is large and they make it smaller."""
    raw = b64decode(picture)
    if len(raw) > IMAGE_LIMIT:
        buffer = io.BytesIO()
        Image.open(io.BytesIO(raw)).convert("RGB").quantize(256).save(buffer, "PNG", optimize=True)
        raw = min(raw, buffer.getvalue(), key=len)
    return b64encode(raw).decode()


if __name__ == "__main__":
    for path in publish_all():
        print(path.name)

"""Execute the five notebooks on a checkpoint and recordings.

    folder = run("best_model.pth", "episodes", "mine")

A run is a folder: load.json, calibrate.json, quantize.json, compare.json, benchmark-<host>.json, calibration.pt,
policy_<mode>.pt, figures/*.png and the executed notebooks. The notebooks know each other only through these files.
"""

import json
import logging
import os
import re
import shutil
import socket
import sys
from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import Any
from unittest.mock import patch

import nbformat
from jupyter_client.kernelspec import KernelSpec
from jupyter_client.manager import AsyncKernelManager

from rover_lib.onboard import errors
from rover_lib.onboard.artifact.manifest import ONNX_SUFFIX
from rover_lib.onboard.durable import ASKED, build_folder, sync_disk
from rover_lib.onboard.errors import RoverError, of_system
from rover_lib.onboard.params import params
from rover_lib.onboard.policy.confine import refuse_root
from rover_lib.onboard.stage import atomic_path, read_stage
from rover_lib.workshop.installed import SHIPPED
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.run import run_folder
from rover_lib.workshop.run.parameters import check_parameters

NOTEBOOKS = SHIPPED / "notebooks"
JUPYTER = Path(__file__).parents[1] / "jupyter"  # what JupyterLab is told beside its own settings
NAMES = ("01_load", "02_calibrate", "03_quantize", "04_compare", "05_benchmark")
# Notebooks for a finished run, which `make count`, `rover run --only 07`, `rover world students` and `learn` execute.
AFTERWARDS = ("06_arm", "07_drive", "08_distill", "09_learn")
OWN_FILES = ("calibration*.pt", "policy_*.pt", f"policy_*{ONNX_SUFFIX}")
# Parameters of notebooks whose defaults are in params.yml, with their places there.
IN_PARAMS = {
    "samples": ("calibration", "samples"),
    "seed": ("calibration", "seed"),
    "smooth": ("quantization", "smooth"),
    "observers": ("quantization", "observers"),
    "iterations": ("benchmark", "iterations"),
    "threads": ("benchmark", "threads"),
}
KERNEL_ENVIRONMENT = {
    "OMP_WAIT_POLICY": "PASSIVE",  # rover_lib/__init__.py says why; a cell may import torch before it
    # Two known warnings would only be noise in a stored output: QNNPACK ignores reduce_range, tqdm misses widgets.
    "PYTHONWARNINGS": "ignore:Currently,ignore:IProgress not found",
    "TORCH_CPP_LOG_LEVEL": "ERROR",
}
START_S = 600  # papermill's 60 did not suffice on a machine with seven busy programs for each core
LINE = re.compile(r"^(\w+) *= *(.*?) *(?:# *(.*))?$", re.M)  # of a parameters cell


class ThisPython(AsyncKernelManager):
    """A kernel of the interpreter that runs this code, whichever kernels the user has registered as "python3"."""

    @property
    def kernel_spec(self) -> KernelSpec:
        argv = [sys.executable, "-m", "ipykernel_launcher", "--log-level=50", "-f", "{connection_file}"]
        return KernelSpec(argv=argv, display_name="Python 3", language="python")


def parameters_of(notebook: Path) -> set[str]:
    """Return the names that the notebook's `parameters` cell sets."""
    return {name for name, _, _ in parameters_in(notebook)}


def parameters_in(notebook: Path) -> list[tuple[str, str, str]]:
    """Return (name, literal, comment) for each line of the notebook's `parameters` cell."""
    return LINE.findall(_parameters_cell(notebook)[1].source)


def _parameters_cell(notebook: Path) -> tuple[Any, Any]:
    """Read a notebook; return it with its `parameters` cell, which is empty and elsewhere if it has none."""
    content = nbformat.read(notebook, as_version=4)
    cells = [cell for cell in content.cells if "parameters" in cell.metadata.get("tags", [])]
    return content, cells[0] if cells else nbformat.v4.new_code_cell()


def run(
    checkpoint: Path | str,
    episodes: Path | str,
    name: str = "mine",
    *,
    runs_dir: Path | str = "runs",
    progress: Progress = silent,
    **overrides: Any,
) -> Path:
    """Execute the five notebooks in order.

    The new run is made in .<name>.new beside the old one of that name, and its files (`files_of_a_run`) replace the old
    one's when it is complete; recordings, a checkpoint and benchmarks of other hosts stay. After an error, Ctrl-C or
    kill -9 the old run is as it was, and what the finished notebooks made waits in .<name>.new: the same call goes on.

    Args:
        checkpoint: a trainer's file or a LeRobot folder.
        episodes: recordings, a LeRobotDataset, or donkeycar tubs.
        name: of the run's folder in runs_dir.
        runs_dir: where runs are kept.
        progress: shows which notebook is executed.
        overrides: any of the notebooks' parameters, say worlds=40, samples=200, iterations=100.

    Returns:
        The run's folder.

    Raises:
        RoverError: in one sentence with the notebook, the cell and its error; or another process makes that run.
        ArtifactError: root may not load artifacts.
    """
    refuse_root()
    folder = run_folder(runs_dir, name, RoverError)
    sources = [NOTEBOOKS / f"{n}.ipynb" for n in NAMES]
    _refuse_senseless(sources, overrides)
    parameters = {"checkpoint": str(Path(checkpoint).resolve()), "episodes": str(Path(episodes).resolve()), **overrides}
    texts = [s.read_text() for s in sources]
    request = json.dumps([str(folder), parameters, params(), texts], sort_keys=True, default=str)
    with build_folder(folder, files_of_a_run, request) as new:
        finished = {path.name for path in new.glob("*.ipynb")}
        for path in folder.glob("benchmark-*.json"):  # notebook 05 shows those of other hosts
            shutil.copy2(path, new)
        try:
            for source in progress(sources, desc="notebooks", total=len(sources)):
                if source.name not in finished:
                    known_to_it = {k: v for k, v in parameters.items() if k in parameters_of(source)}
                    _execute(source, new, known_to_it, progress is not silent)
        except BaseException:
            if {path.name for path in new.glob("*.ipynb")} <= finished:  # the next one shall not fail there again
                (new / ASKED).unlink(missing_ok=True)
            raise
    return folder


def files_of_a_run(folder: Path) -> list[Path]:
    """List what a run left in its folder and what was later made from its artifacts. A new run replaces all of it."""
    stages = ("load", "calibrate", "quantize", "compare", "run", "arm", "parts", "drive", "students", "learn")
    names = [f"{stage}.json" for stage in (*stages, f"benchmark-{socket.gethostname()}")]
    names += [*(f"{n}.ipynb" for n in NAMES + AFTERWARDS), "figures", "hailo", "report.html"]
    own = [*(folder / name for name in names), *chain.from_iterable(map(folder.glob, OWN_FILES))]
    return [path for path in own if path.exists()]


def execute(name: str, run_dir: Path | str, **overrides: Any) -> Path:
    """Execute one notebook on an existing run.

    Args:
        name: of the notebook, or its beginning, such as 04.
        run_dir: the run's folder.
        overrides: of the notebook's parameters.

    Returns:
        The path of the executed notebook in the run's folder.

    Raises:
        RoverError: for an unknown notebook or parameter, or with the cell and its error; an earlier executed one stays.
    """
    matches = [notebook for notebook in NAMES + AFTERWARDS if notebook.startswith(name.removesuffix(".ipynb"))]
    if len(matches) != 1:
        raise RoverError(f"no notebook {name}", remedy=f"known are {', '.join(NAMES + AFTERWARDS)}")
    folder = Path(run_dir).resolve()
    source = NOTEBOOKS / f"{matches[0]}.ipynb"
    if not folder.is_dir():
        raise RoverError(f"{folder}: not found", remedy="rover inspect shows the runs that there are")
    _refuse_senseless([source], overrides)
    if matches == [NAMES[0]] and (folder / "load.json").is_file():  # what the run was made of, unless said otherwise
        overrides = read_stage(folder / "load.json", "load")["params"] | overrides
    _execute(source, folder, overrides, False)
    return folder / source.name


def _refuse_senseless(notebooks: list[Path], given: Mapping[str, Any]) -> None:
    """Raise RoverError for parameters that none of the notebooks has, impossible values, and missing notebooks."""
    if missing := [path for path in notebooks if not path.is_file()]:
        raise RoverError(f"{missing[0]}: not found", remedy="install the project again")
    accepted = set().union(*(parameters_of(path) for path in notebooks)) - {"run_dir"}
    if unknown := sorted(given.keys() - accepted):
        raise RoverError(f"no parameter {', '.join(unknown)}", remedy=f"known are {sorted(accepted)}")
    check_parameters(**given)


def _execute(source: Path, folder: Path, given: Mapping[str, Any], bars: bool) -> None:
    """Execute a notebook in a run's folder. given: what its parameters are, instead of params.yml's and its own."""
    import papermill  # here, because it takes a second that the kernels, which import this module too, do not need
    from nbclient.exceptions import DeadKernelError

    logging.getLogger("papermill").setLevel(logging.ERROR)  # it says what it executes; the bar does that
    bar = {"leave": False} if bars and sys.stderr.isatty() else False  # of its cells
    options: dict[str, Any] = {"cwd": str(folder), "progress_bar": bar, "start_timeout": START_S}
    options |= {"kernel_name": "python3", "kernel_manager_class": ThisPython}
    with patch.dict(os.environ, KERNEL_ENVIRONMENT), atomic_path(folder / source.name) as temporary:
        try:
            papermill.execute_notebook(with_parameters(source, given), str(temporary), **options)
            sync_disk(folder)  # a power cut must not leave the notebook without what it wrote
        except papermill.PapermillExecutionError as e:
            if e.ename == "KeyboardInterrupt":  # Ctrl-C reaches the kernel too
                raise KeyboardInterrupt from e
            raise RoverError(f"{source.name}, cell {e.cell_index + 1}: {_sentence(e)}") from e
        except DeadKernelError as e:
            raise RoverError(f"{source.name}: its kernel died", remedy="is there enough memory?") from e


def with_parameters(source: Path, given: Mapping[str, Any]) -> Any:
    """Read a notebook, and set the values in its `parameters` cell: those given, else those of params.yml."""
    values = {"run_dir": ".", **given}
    p = params()
    notebook, cell = _parameters_cell(source)
    lines = []
    for name, literal, comment in LINE.findall(cell.source):
        if name in values:
            literal = repr(str(values[name]) if isinstance(values[name], Path) else values[name])
        elif name in IN_PARAMS:
            section, key = IN_PARAMS[name]
            literal = repr(p[section][key])
        lines.append(f"{name} = {literal}" + (f"  # {comment}" if comment else ""))
    cell.source = "\n".join(lines)
    return notebook


def _sentence(error: Any) -> str:
    """Return a RoverError's own text; for any other error also its name, and how to see the traceback."""
    text = " ".join(str(error.evalue).split())
    if system := re.fullmatch(r"\[Errno (\d+)\] [^:]*(?:: '(.*)')?", text):
        return str(of_system(OSError(int(system[1]), "", system[2] or None)))
    ours = hasattr(errors, error.ename)  # papermill has only the name of its class
    return text if ours else f"{error.ename}: {text}; 'rover --debug run' shows the traceback"

"""Make a run of every combination of checkpoints, students, settings and seeds in a sheet, on Dask.

    jobs = read_sheet("sweep.yml")
    with open_cluster(workers=2) as client:
        failed = sweep(jobs, "runs/sweep", client)

A run is what `rover run` makes. One that is there is not made again, so an interrupted sweep continues where it was.
docs/sweep.md describes the sheet, clusters, and the cost of a thousand policies.
"""

import hashlib
import io
import itertools
import json
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import yaml

from rover_lib.onboard.columns import align, number
from rover_lib.onboard.errors import ParamsError, RoverError
from rover_lib.onboard.params import FOR_THIS_RUN, params, read_params
from rover_lib.onboard.stage import read_stage, write_stage
from rover_lib.workshop.hub import absolute
from rover_lib.workshop.judge.hosts import benchmark_of
from rover_lib.workshop.judge.recorded_range import worst
from rover_lib.workshop.progress import Progress, silent

if TYPE_CHECKING:
    from distributed import Client, Future

REPORT = "sweep.json"
KEYS = ("checkpoints", "episodes", "students", "notebooks", "params")
MODE = "static"  # the artifact that a run is judged by
PREPARED, TIMED = "compare.json", "run.json"  # what the two parts of a job leave last
A_SHEET = "docs/sweep.md has a sheet to begin with"


@dataclass(frozen=True)
class Job:
    """One run.

    student: options of `rover distill` for a student that is taught first and then judged; {} judges the checkpoint
    itself. notebooks: parameters of the notebooks. params: values of params.yml by their place, say "calibration.seed".
    """

    checkpoint: str
    episodes: str
    student: Mapping[str, Any]
    notebooks: Mapping[str, Any]
    params: Mapping[str, Any]

    @property
    def settings(self) -> dict[str, Any]:
        """Everything that may differ between two runs, for a table."""
        return {"checkpoint": self.checkpoint, **self.student, **self.notebooks, **self.params}

    @property
    def name(self) -> str:
        """The run's name: what it varies, and digits that change with its settings and with its checkpoint's file."""
        told = [f"{key.split('.')[-1]}{value}" for key, value in self.settings.items() if key != "checkpoint"]
        path = Path(self.checkpoint)
        made = [path.stat().st_size, path.stat().st_mtime_ns] if path.is_file() else []
        digits = hashlib.sha256(json.dumps([asdict(self), made], sort_keys=True).encode()).hexdigest()[:6]
        return re.sub(r"[^\w.-]+", "_", "-".join([path.stem, *told, digits])).lstrip(".-")

    def distill_command(self) -> list[str]:
        """Return the arguments of `rover distill`, without the folder, that teach this job's student."""
        words = [self.checkpoint, self.episodes, "--name", self.name]
        for key, value in {"device": "cpu", **self.student}.items():
            option = f"--{key.replace('_', '-')}"
            words += [option] if value is True else [] if value is False else [option, str(value)]
        return words


def read_sheet(path: Path | str) -> list[Job]:
    """Read a sheet and return every combination of its values as a job. Raises ParamsError."""
    from rover_lib.workshop.run.run import NAMES, NOTEBOOKS, parameters_of

    if not Path(path).exists():
        raise ParamsError(f"{path}: not found", remedy=A_SHEET)
    content = read_params(path)
    _refuse_unknown(f"{path}: a sheet", content, KEYS)
    checkpoints, episodes = _as_list(content.get("checkpoints")), content.get("episodes")
    if not checkpoints or not all(isinstance(each, str) for each in (*checkpoints, episodes)):
        raise ParamsError(f"{path}: it needs paths of checkpoints and one folder of episodes", remedy=A_SHEET)
    students = _as_list(content.get("students")) or [{}]
    varied = {key: content.get(key) or {} for key in ("notebooks", "params")}
    if not all(isinstance(each, dict) for each in (*students, *varied.values())):
        raise ParamsError(f"{path}: students, notebooks and params are mappings", remedy=A_SHEET)
    own = {name for each in NAMES for name in parameters_of(NOTEBOOKS / f"{each}.ipynb")}
    _refuse_unknown(f"{path}: a notebook", varied["notebooks"], own - {"run_dir", "checkpoint", "episodes"})
    _refuse_unknown(f"{path}: params.yml", varied["params"], _places(params()))
    jobs = [
        Job(absolute(checkpoint), absolute(str(episodes)), student, of_notebooks, of_params)
        for checkpoint in checkpoints
        for student in students
        for of_notebooks in _combinations(varied["notebooks"])
        for of_params in _combinations(varied["params"])
    ]
    names = [job.name for job in jobs]
    if twice := sorted(name for name in names if names.count(name) > 1):
        raise ParamsError(f"{path}: the same run twice", found=twice[0])
    for job in jobs:
        _check_student(job)
    return jobs


def _as_list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [] if value is None else [value]


def _refuse_unknown(what: str, given: Mapping[Any, Any], known: Any) -> None:
    """Raise ParamsError for a misspelt name: runs that differ only in its value would be the same run."""
    if unknown := sorted(map(str, set(given) - set(known))):
        raise ParamsError(f"{what} has no {unknown[0]!r}", remedy=f"known are {', '.join(sorted(known))}")


def _places(values: Any, before: str = "") -> set[str]:
    """Return the places of all values, say {"calibration.seed"}."""
    if not isinstance(values, dict):
        return {before}
    return {place for key, value in values.items() for place in _places(value, f"{before}.{key}".lstrip("."))}


def _combinations(values: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    for chosen in itertools.product(*(_as_list(value) for value in values.values())):
        yield dict(zip(values, chosen, strict=True))


def _distill() -> click.Command:
    """Return `rover distill`, by its entry point: its module imports this one."""
    (command,) = entry_points(group="rover.teach", name="distill")
    return command.load()


def _check_student(job: Job) -> None:
    """Raise ParamsError for an option that `rover distill` would refuse."""
    if job.student:
        try:
            _distill().make_context("distill", job.distill_command())
        except click.UsageError as error:
            raise ParamsError("a student of the sheet", found=error.format_message()) from None


# --- what a worker does -----------------------------------------------------------------------------------------------


def do(part: Callable[[Job, Path], None], job: Job, folder: Path, done: str) -> None:
    """Do a part of a job unless its file `done` is there: Dask repeats what a dead worker had finished."""
    if not (folder / job.name / done).is_file():
        part(job, folder)


def prepare(job: Job, folder: Path) -> None:
    """Teach the student, if the job has one, and make the run without its benchmark."""
    from rover_lib.workshop.checkpoint.files import find_written
    from rover_lib.workshop.run.run import run

    checkpoint: Path | str = job.checkpoint
    with _settings_of(job, folder):
        if job.student and not (folder / job.name / "distill.json").is_file():
            with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
                _distill().main([*job.distill_command(), "--runs-dir", str(folder)], standalone_mode=False)
        if job.student:
            checkpoint = find_written(folder / job.name)
        run(checkpoint, job.episodes, job.name, runs_dir=folder, timed=False, **job.notebooks)


def benchmark(job: Job, folder: Path) -> None:
    """Make the run's benchmark and its verdict."""
    from rover_lib.workshop.run.run import NAMES, NOTEBOOKS, execute, parameters_of
    from rover_lib.workshop.run.run_report import write

    known = parameters_of(NOTEBOOKS / f"{NAMES[-1]}.ipynb")
    with _settings_of(job, folder):
        execute(NAMES[-1], folder / job.name, **{k: v for k, v in job.notebooks.items() if k in known})
        write(folder / job.name)


@contextmanager
def _settings_of(job: Job, folder: Path) -> Iterator[None]:
    """Apply the job's own values of params.yml inside the block, for this process and the kernels that it starts."""
    from rover_lib.workshop.run.run import set_environment

    values: dict[str, Any] = {}
    for place, value in job.params.items():
        *sections, last = place.split(".")
        section = values
        for name in sections:
            section = section.setdefault(name, {})
        section[last] = value
    path = folder / f".{job.name}.yml"
    path.write_text(yaml.safe_dump(values))
    try:
        with set_environment({FOR_THIS_RUN: str(path)}):
            yield
    finally:
        path.unlink(missing_ok=True)


# --- the cluster ------------------------------------------------------------------------------------------------------


@contextmanager
def open_cluster(address: str | None = None, workers: int | None = None) -> Iterator["Client"]:
    """Connect to a Dask scheduler, or start `workers` processes here, by default one for every two cores.

    Raises RoverError if no scheduler answers at the address.
    """
    from distributed import Client, LocalCluster

    try:
        if address:
            client = Client(address, timeout=10)
        else:
            # A run's memory is its kernels', which Dask does not see, so a limit would only end the wrong processes.
            here = {"threads_per_worker": 1, "memory_limit": 0, "dashboard_address": None, "silence_logs": 40}
            client = Client(LocalCluster(workers or max(1, (os.cpu_count() or 1) // 2), **here))
    except (OSError, ValueError, TimeoutError) as error:
        remedy = "start one: dask scheduler; dask worker tcp://HOST:8786 --nthreads 1"
        raise RoverError(f"{address}: no Dask scheduler answers", found=type(error).__name__, remedy=remedy) from None
    with client:
        try:
            yield client
        finally:
            if client.cluster is not None:
                client.cluster.close()


def sweep(jobs: Sequence[Job], folder: Path | str, client: "Client", progress: Progress = silent) -> dict[str, str]:
    """Make the missing runs of these jobs, and return a sentence for each failed one, by its name.

    All are prepared first; then they are timed one after another, on one worker if it lives, when nothing disturbs
    them. If a worker dies, another repeats what it was doing, at most three times.
    """
    from distributed import as_completed

    folder, failed = Path(folder).resolve(), dict[str, str]()
    folder.mkdir(parents=True, exist_ok=True)
    missing = [job for job in jobs if not (folder / job.name / TIMED).is_file()]
    keys = [f"prepare-{job.name}" for job in missing]
    prepared = client.map(partial(do, prepare, folder=folder, done=PREPARED), missing, key=keys, pure=False)
    for future in progress(as_completed(prepared), desc="runs", total=len(prepared)):
        _note_failure(future, failed)
    ready = [job for job in missing if job.name not in failed]
    timing = sorted(client.scheduler_info(n_workers=-1)["workers"])[:1]
    for job in progress(ready, desc="benchmarks", total=len(ready)):
        options = {"key": f"benchmark-{job.name}", "pure": False, "workers": timing, "allow_other_workers": True}
        _note_failure(client.submit(do, benchmark, job, folder, TIMED, **options), failed)
    return failed


def _note_failure(future: "Future", failed: dict[str, str]) -> None:
    """Wait for a job, and keep a sentence if it failed."""
    if (error := future.exception()) is None:
        return
    name = str(future.key).partition("-")[2]
    failed[name] = str(error) if isinstance(error, RoverError) else f"{type(error).__name__}: {error}"
    if type(error).__name__ == "KilledWorker":
        failed[name] = "its worker died each time; is there enough memory?"


# --- what came out ----------------------------------------------------------------------------------------------------


def write_report(jobs: Sequence[Job], folder: Path | str, failed: Mapping[str, str]) -> dict[str, Any]:
    """Write sweep.json into the sweep's folder, and return its content: a row for each complete run.

    error_pct is the largest of the actions' errors of static INT8 against FP32, to_recorded_pct the largest against
    what the driver did.
    """
    rows = [_row(job, Path(folder) / job.name) for job in jobs if (Path(folder) / job.name / TIMED).is_file()]
    metrics = {"runs": rows, "failed": dict(failed), "missing": len(jobs) - len(rows) - len(failed)}
    return write_stage(Path(folder) / REPORT, "sweep", params={"mode": MODE}, metrics=metrics, inputs={})


def _row(job: Job, run: Path) -> dict[str, Any]:
    compared = read_stage(run / "compare.json", "compare")["metrics"]
    path = benchmark_of(run, read_stage(run / "quantize.json", "quantize")["metrics"]["modes"])
    if path is None:
        raise RoverError(f"{run}: no benchmark of its artifacts", remedy="remove that folder, and sweep again")
    timed, mode = read_stage(path, "benchmark"), compared["modes"][MODE]
    return {
        "name": job.name,
        "settings": job.settings,
        "error_pct": worst([mode[f"{action}_mae_pct"] for action in compared["action_range"]]),
        "to_recorded_pct": worst([mode.get(f"{action}_vs_recorded_pct") for action in compared["action_range"]]),
        **{key: mode[key] for key in ("hits", "trials", "size_mb")},
        "latency_p50_ms": timed["metrics"]["artifacts"][MODE]["latency_p50_ms"],
        "host": timed["env"]["host"],
    }


def table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the rows as text, the smallest error to the recordings first."""
    lines = [["run", "to recorded %", "to FP32 %", "p50 ms", "MB", "hits"]]
    for row in sorted(rows, key=lambda r: (r["to_recorded_pct"] is None, r["to_recorded_pct"])):
        errors = [number(row[key], ".2f") for key in ("to_recorded_pct", "error_pct")]
        hits = f"{row['hits']} of {row['trials']}" if row["trials"] else "-"
        lines.append([row["name"], *errors, number(row["latency_p50_ms"]), number(row["size_mb"]), hits])
    return align(lines)

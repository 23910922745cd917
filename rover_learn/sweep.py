"""Make a run of every combination of checkpoints, students, settings and seeds in a sheet, on Dask (docs/sweep.md)."""

import hashlib
import io
import itertools
import json
import os
import re
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from rover_lib.onboard.errors import ParamsError, RoverError
from rover_lib.onboard.params import FOR_THIS_RUN, params, read_params
from rover_lib.workshop.progress import Progress, silent

if TYPE_CHECKING:
    from distributed import Client

KEYS = ("checkpoints", "episodes", "students", "notebooks", "params")
MADE = "run.json"  # what a job leaves last


@dataclass(frozen=True)
class Job:
    """One run. student: options of `rover distill` for a student that is taught first; {} judges the checkpoint itself.

    notebooks: parameters of the notebooks. params: values of params.yml by their place, say "calibration.seed".
    """

    checkpoint: str
    episodes: str
    student: Mapping[str, Any]
    notebooks: Mapping[str, Any]
    params: Mapping[str, Any]

    @property
    def name(self) -> str:
        """The run's name: what it varies, and digits that change with its settings and with its checkpoint's file."""
        settings, path = {**self.student, **self.notebooks, **self.params}, Path(self.checkpoint)
        told = [f"{key.split('.')[-1]}{value}" for key, value in settings.items()]
        made = [path.stat().st_size, path.stat().st_mtime_ns] if path.is_file() else []
        digits = hashlib.sha256(json.dumps([asdict(self), made], sort_keys=True).encode()).hexdigest()[:6]
        return re.sub(r"[^\w.-]+", "_", "-".join([path.stem, *told, digits])).lstrip(".-")

    def distill_command(self) -> list[str]:
        """Return the arguments of `rover distill`, without the folder, that teach this job's student."""
        words = [self.checkpoint, self.episodes, "--name", self.name]
        for key, value in {"device": "cpu", **self.student}.items():
            words += [f"--{key.replace('_', '-')}", str(value)]
        return words


def read_sheet(path: Path | str) -> list[Job]:
    """Read a sheet and return every combination of its values as a job. Raises ParamsError."""
    content = read_params(path)
    checkpoints, episodes = _as_list(content.get("checkpoints")), content.get("episodes")
    students = _as_list(content.get("students")) or [{}]
    varied = [content.get(key) or {} for key in ("notebooks", "params")]
    texts, mappings = (*checkpoints, episodes), (*students, *varied)
    if not checkpoints or not all(isinstance(p, str) for p in texts) or not all(isinstance(m, dict) for m in mappings):
        raise ParamsError(f"{path}: not a sheet of a sweep", remedy="docs/sweep.md has one to begin with")
    # A misspelt name would not act: runs that differ only in its value would be the same run.
    places = {f"{section}.{name}" for section, values in params().items() for name in values}
    if unknown := [*sorted(set(content) - set(KEYS)), *sorted(set(varied[1]) - places)]:
        raise ParamsError(f"{path}: unknown name", found=unknown[0], remedy="params.yml has the places of its values")
    jobs = {}
    for checkpoint, *how in itertools.product(checkpoints, students, *map(_combinations, varied)):
        job = Job(str(Path(checkpoint).resolve()), str(Path(str(episodes)).resolve()), *how)
        jobs[job.name] = job  # the same run given twice is made once
    return list(jobs.values())


def _as_list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [] if value is None else [value]


def _combinations(values: Mapping[str, Any]) -> list[dict[str, Any]]:
    every = itertools.product(*(_as_list(value) for value in values.values()))
    return [dict(zip(values, chosen, strict=True)) for chosen in every]


def make(job: Job, folder: Path) -> None:
    """Teach the student, if the job has one, and make the run with its verdict."""
    from rover_lib.workshop.checkpoint.files import find_written
    from rover_lib.workshop.run.run import run
    from rover_lib.workshop.run.run_report import write

    own, checkpoint = folder / job.name, Path(job.checkpoint)
    if (own / MADE).is_file():
        return  # Dask repeats what a dead worker had finished
    with _settings_of(job):
        if job.student and not (own / "distill.json").is_file():
            (distill,) = entry_points(group="rover.teach", name="distill")  # its module imports this one
            with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
                distill.load().main([*job.distill_command(), "--runs-dir", str(folder)], standalone_mode=False)
        if job.student:
            checkpoint = find_written(own)
        run(checkpoint, job.episodes, job.name, runs_dir=folder, **job.notebooks)
        write(own)


@contextmanager
def _settings_of(job: Job) -> Iterator[None]:
    """Apply the job's own values of params.yml inside the block, for this process and the kernels that it starts."""
    from rover_lib.workshop.run.run import set_environment

    values: dict[str, Any] = {}
    for place, value in job.params.items():
        section, name = place.split(".")
        values.setdefault(section, {})[name] = value
    with tempfile.NamedTemporaryFile("w", suffix=".yml") as file:
        yaml.safe_dump(values, file)
        file.flush()
        with set_environment({FOR_THIS_RUN: file.name}):
            yield


def open_cluster(address: str | None = None, workers: int | None = None) -> "Client":
    """Connect to a Dask scheduler, or start `workers` processes here; None: one for two cores. Returns Dask's client.

    Raises RoverError if no scheduler answers at the address.
    """
    from distributed import Client

    # A run's memory is its kernels', which Dask does not see, so a limit would only end the wrong processes.
    here = {"threads_per_worker": 1, "memory_limit": 0, "dashboard_address": None, "silence_logs": 40}
    here |= {"n_workers": workers or max(1, (os.cpu_count() or 1) // 2)}
    try:
        return Client(address, timeout=10) if address else Client(**here)
    except (OSError, ValueError, TimeoutError) as error:
        remedy = "start one: dask scheduler; dask worker tcp://HOST:8786 --nthreads 1"
        raise RoverError(f"{address}: no Dask scheduler answers", found=type(error).__name__, remedy=remedy) from None


def sweep(jobs: Sequence[Job], folder: Path | str, client: "Client", progress: Progress = silent) -> dict[str, str]:
    """Make the missing runs of these jobs, and return a sentence for each failed one, by its name."""
    from distributed import as_completed

    folder, failed = Path(folder).resolve(), dict[str, str]()
    folder.mkdir(parents=True, exist_ok=True)
    running = client.map(partial(make, folder=folder), jobs, pure=False)
    names = {future.key: job.name for future, job in zip(running, jobs, strict=True)}
    for future in progress(as_completed(running), desc="runs", total=len(running)):
        if (error := future.exception()) is not None:
            sentence = str(error) if isinstance(error, RoverError) else f"{type(error).__name__}: {error}"
            failed[names[future.key]] = sentence
    return failed

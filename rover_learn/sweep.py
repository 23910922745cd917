"""Make many runs from one sheet of checkpoints, students, settings and seeds on Dask, each as `rover run` makes it.

    with on_this_machine(workers=2) as client:
        failed = sweep(Sheet.read("sweep.yml").jobs(), "runs/sweep", client)

Each run has an ordinary run's folder, with job.json beside its stages. Finished parts are not done again, so an
interrupted sweep continues where it was. docs/sweep.md describes the sheet, clusters, and the cost of a thousand
policies.
"""

import fcntl
import hashlib
import itertools
import json
import logging
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import yaml

from rover_lib.onboard.checked import is_number, is_whole
from rover_lib.onboard.columns import align, number
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.params import FOR_THIS_RUN, params, read_params
from rover_lib.onboard.stage import atomic_path, read_stage, write_stage
from rover_lib.workshop.hub import absolute
from rover_lib.workshop.judge import recorded_range as judge
from rover_lib.workshop.judge.hosts import benchmark_of
from rover_lib.workshop.progress import Progress, silent

if TYPE_CHECKING:
    from distributed import Client, Future

JOB, REPORT, FIGURE = "job.json", "sweep.json", "sweep.png"
TIMING = "timing"  # the Dask resource of a worker that has a machine to itself while it works
STUDENT_OPTIONS = (  # those of `rover distill`
    "size",
    "decoder_layers",
    "feedforward",
    "backbone_channels",
    "qat",
    "steps",
    "samples",
    "seed",
)
OF_A_RUN = ("run_dir", "checkpoint", "episodes")  # parameters that the sweep itself sets
MODE = "static"  # the artifact that a run is judged by
A_SHEET = "docs/sweep.md has a sheet to begin with"


class SweepError(RoverError):
    """A sheet that cannot be run, or a cluster that cannot run it."""


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
    def name(self) -> str:
        """The run's name: what it varies, and a few unique digits. It stays the same when the sheet grows."""
        settings = {**self.student, **self.notebooks, **self.params}
        parts = [Path(self.checkpoint).stem, *(f"{key.split('.')[-1]}{value}" for key, value in settings.items())]
        digits = hashlib.sha256(json.dumps(asdict(self), sort_keys=True).encode()).hexdigest()[:6]
        return re.sub(r"[^\w.-]+", "_", "-".join([*parts, digits])).lstrip(".-")

    @property
    def settings(self) -> dict[str, Any]:
        """Everything that may differ between two runs, for a table."""
        return {"checkpoint": self.checkpoint, **self.student, **self.notebooks, **self.params}


@dataclass(frozen=True)
class Sheet:
    """sweep.yml: every combination of its values is a run."""

    checkpoints: Sequence[str]
    episodes: str
    students: Sequence[Mapping[str, Any]]
    notebooks: Mapping[str, Sequence[Any]]
    params: Mapping[str, Sequence[Any]]

    @classmethod
    def read(cls, path: Path | str) -> "Sheet":
        """Read a sheet. Paths in it are relative to the working folder. Raises SweepError, ParamsError."""
        from rover_lib.workshop.run.run import NAMES, NOTEBOOKS, parameters_of

        if not Path(path).exists():
            raise SweepError(f"{path}: not found", remedy=A_SHEET)
        content = read_params(path)
        if unknown := sorted(map(str, set(content) - set(cls.__dataclass_fields__))):
            raise SweepError(f"{path}: a sheet has no key {unknown[0]!r}",
                             remedy=f"known are {', '.join(cls.__dataclass_fields__)}")  # fmt: skip
        for key in ("checkpoints", "episodes"):
            if not content.get(key):
                raise SweepError(f"{path}: no {key!r} in it", remedy=A_SHEET)
        checkpoints = content["checkpoints"] if isinstance(content["checkpoints"], list) else [content["checkpoints"]]
        if not all(isinstance(checkpoint, str) for checkpoint in checkpoints):
            raise SweepError(f"{path}: checkpoints must be paths", found=checkpoints)
        if not isinstance(content["episodes"], str):
            raise SweepError(f"{path}: episodes must be one folder", found=content["episodes"])
        of_notebooks = _lists(content.get("notebooks"), f"{path}: notebooks")
        known = set().union(*(parameters_of(NOTEBOOKS / f"{name}.ipynb") for name in NAMES)) - set(OF_A_RUN)
        if unknown := sorted(set(of_notebooks) - known):
            raise SweepError(f"{path}: no notebook has a parameter {unknown[0]!r}", remedy=f"known are {sorted(known)}")
        students = content.get("students") or [{}]
        if not isinstance(students, list) or not all(isinstance(s, dict) for s in students):
            raise SweepError(f"{path}: students must be a list of mappings", found=students)
        if unknown := sorted(map(str, set().union(*students) - set(STUDENT_OPTIONS))):
            raise SweepError(f"{path}: no student has {unknown[0]!r}", remedy=f"known are {', '.join(STUDENT_OPTIONS)}")
        for student in students:
            _check_student(student)
        of_params = _lists(content.get("params"), f"{path}: params")
        if wrong := [key for key in of_params if "." not in key]:
            raise SweepError(f"{path}: params are named by their place, say calibration.seed", found=wrong[0])
        here = params()
        if unknown := [place for place in of_params if not _has(here, place)]:
            # Runs that differ only in the value of a misspelt name would be the same run several times.
            raise SweepError(f"{path}: params.yml has no {unknown[0]!r}", remedy="look at params.yml for its name")
        return cls([absolute(c) for c in checkpoints], absolute(content["episodes"]), students, of_notebooks, of_params)

    def jobs(self) -> list[Job]:
        """Return every combination as a job. Raises SweepError if two are the same."""
        jobs = [
            Job(checkpoint, self.episodes, student, notebooks, params)
            for checkpoint in self.checkpoints
            for student in self.students
            for notebooks in _combinations(self.notebooks)
            for params in _combinations(self.params)
        ]
        names = [job.name for job in jobs]
        if twice := {name for name in names if names.count(name) > 1}:
            raise SweepError("the sheet has the same run twice", found=sorted(twice)[0])
        return jobs


def _check_student(student: Mapping[str, Any]) -> None:
    """Raise SweepError for a value that `rover distill` would refuse or read as something else."""
    for key, value in student.items():
        if key == "size":
            right, what = re.fullmatch(r"\d+x\d+", str(value)) is not None, "WIDTHxHEIGHT"
        elif key == "qat":
            right, what = isinstance(value, bool), "true or false"
        elif key == "backbone_channels":
            right, what = is_number(value), "a number"
        else:
            right, what = is_whole(value), "a whole number"
        if not right:
            raise SweepError(f"a student's {key} is {what}", found=value)


def _lists(values: Any, where: str) -> dict[str, list[Any]]:
    """Return each name with its values; a single value becomes a list of one. Raises SweepError."""
    if not isinstance(values, dict | None):
        raise SweepError(f"{where} must be a mapping of names to values", found=values)
    lists = {str(key): value if isinstance(value, list) else [value] for key, value in (values or {}).items()}
    if empty := [key for key, value in lists.items() if not value]:
        raise SweepError(f"{where}: {empty[0]} has no value")
    return lists


def _has(values: Any, place: str) -> bool:
    """Whether there is a value at this place, say "calibration.seed"."""
    for name in place.split("."):
        if not isinstance(values, Mapping) or name not in values:
            return False
        values = values[name]
    return True


def _combinations(values: Mapping[str, Sequence[Any]]) -> Iterator[dict[str, Any]]:
    for chosen in itertools.product(*values.values()):
        yield dict(zip(values, chosen, strict=True))


# --- what a worker does -----------------------------------------------------------------------------------------------


class Work(Protocol):
    """Does the two parts of a job. Both leave nothing incomplete in the sweep's folder, and may be repeated."""

    def prepare(self, job: Job, folder: Path) -> None: ...

    def benchmark(self, job: Job, folder: Path) -> None: ...


class Notebooks:
    """The work of `rover distill` and `rover run`."""

    def prepare(self, job: Job, folder: Path) -> None:
        """Teach the student, if the job has one, and make the run without its benchmark."""
        from rover_lib.workshop.run.run import run

        with _settings_of(job, folder):
            checkpoint = self._taught(job, folder) if job.student else job.checkpoint
            run(checkpoint, job.episodes, job.name, runs_dir=folder, timed=False, **job.notebooks)

    def benchmark(self, job: Job, folder: Path) -> None:
        """Make the run's benchmark and its verdict."""
        from rover_lib.workshop.run.run import NAMES, NOTEBOOKS, execute, parameters_of
        from rover_lib.workshop.run.run_report import write

        own = parameters_of(NOTEBOOKS / f"{NAMES[-1]}.ipynb")
        with _settings_of(job, folder):
            execute(NAMES[-1], folder / job.name, **{k: v for k, v in job.notebooks.items() if k in own})
            write(folder / job.name)

    def _taught(self, job: Job, folder: Path) -> Path:
        """Teach the student in the run's own folder, or continue; return its checkpoint."""
        from rover_learn.distill import DistillRecipe, distill, phases_of
        from rover_learn.student import StudentShape
        from rover_lib.workshop.checkpoint.files import find_written

        _check_student(job.student)
        options = dict(job.student)
        given = {key: options.pop(key, None) for key in ("steps", "samples", "seed")}
        width, _, height = options.pop("size", "x").partition("x")
        qat = options.pop("qat", False)
        shape = StudentShape(int(height) if height else None, int(width) if width else None, **options)
        recipe = DistillRecipe.of(params(), **given, phases=phases_of(shape, qat))
        made = distill(
            job.checkpoint, job.episodes, job.name, shape, runs_dir=folder, recipe=recipe, qat=qat, device="cpu"
        )
        return find_written(made)


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


def do(part: str, work: Work, job: Job, folder: Path, fingerprint: str) -> str:
    """Do one part of a job, "prepare" or "benchmark", unless it is done, and return the job's name.

    fingerprint: of the job's files when the sweep began. If files change meanwhile, the next sweep computes another
    fingerprint, and makes the run again.

    Only one process at a time works on a job. If a worker that was thought lost is still alive, its successor waits for
    it, and then finds the work done.
    """
    with (folder / f".{job.name}.lock").open("w") as lock:
        fcntl.lockf(lock, fcntl.LOCK_EX)  # unlike flock, it also works on network file systems
        if part not in parts_done(job, folder, fingerprint):
            getattr(work, part)(job, folder)
            done = ["prepare"] if part == "prepare" else ["prepare", "benchmark"]
            content = {"fingerprint": fingerprint, "done": done, **asdict(job)}
            with atomic_path(folder / job.name / JOB) as temporary:
                temporary.write_text(json.dumps(content, indent=2) + "\n")
    return job.name


def parts_done(job: Job, folder: Path, fingerprint: str) -> list[str]:
    """Return the parts of a job that were finished with exactly these files. Empty if job.json cannot be read."""
    try:
        content = json.loads((folder / job.name / JOB).read_text())
        return list(content["done"]) if content["fingerprint"] == fingerprint else []
    except (OSError, ValueError, KeyError, TypeError):
        return []


def fingerprints(jobs: Sequence[Job]) -> dict[str, str]:
    """Return a hash for each job, by its name, which changes with the files of its checkpoint and recordings.

    It covers their names, sizes and times, because hashing their content takes long. Files that many jobs share are
    looked up once.
    """
    places = {place for job in jobs for place in (job.checkpoint, job.episodes)}
    found = {place: _files_in(Path(place)) for place in places}
    return {job.name: hashlib.sha256(found[job.checkpoint] + found[job.episodes]).hexdigest() for job in jobs}


def _files_in(place: Path) -> bytes:
    """Return a line with the name, size and time of each file, in order."""
    lines = []
    for path in [place] if place.is_file() else sorted(p for p in place.rglob("*") if p.is_file()):
        at = path.stat()
        lines.append(f"{path} {at.st_size} {at.st_mtime_ns}\n")
    return "".join(lines).encode()


# --- the cluster ------------------------------------------------------------------------------------------------------


@contextmanager
def on_this_machine(workers: int | None = None) -> Iterator["Client"]:
    """Start a local Dask cluster of `workers` processes, by default one for every two cores.

    Only the first may run benchmarks.
    """
    from distributed import Client, Nanny, Scheduler, SpecCluster

    count = workers or max(1, (os.cpu_count() or 1) // 2)
    # Dask does not see the kernels, which use a run's memory; its own limit would only end workers that use little.
    options = {"nthreads": 1, "memory_limit": 0, "dashboard": False, "silence_logs": logging.ERROR}
    specs = {
        i: {"cls": Nanny, "options": {**options, "resources": {TIMING: 1} if i == 0 else {}}} for i in range(count)
    }
    quiet = {"host": "127.0.0.1", "dashboard": False}
    with (
        SpecCluster(specs, scheduler={"cls": Scheduler, "options": quiet}, silence_logs=logging.ERROR) as cluster,
        Client(cluster) as client,
    ):
        client.wait_for_workers(count, timeout=60)
        yield client


@contextmanager
def on_cluster(address: str) -> Iterator["Client"]:
    """Connect to a running Dask cluster. Raises SweepError if it does not answer, or no worker may run benchmarks."""
    from distributed import Client

    try:
        client = Client(address, timeout=10)
    except (OSError, ValueError, TimeoutError) as e:
        raise SweepError(
            f"{address}: no Dask scheduler answers",
            found=type(e).__name__,
            remedy="start one: dask scheduler; dask worker tcp://HOST:8786 --nthreads 1",
        ) from None
    with client:
        workers = client.scheduler_info(n_workers=-1)["workers"].values()
        if not any(w.get("resources", {}).get(TIMING) for w in workers):
            raise SweepError(f"{address}: no worker may time", found=f"{len(workers)} workers",
                             remedy=f"start one on a machine of its own: dask worker {address} --nthreads 1 "
                             f'--resources "{TIMING}=1"')  # fmt: skip
        yield client


def sweep(
    jobs: Sequence[Job],
    folder: Path | str,
    client: "Client",
    *,
    together: bool = False,
    work: Work | None = None,
    progress: Progress = silent,
) -> dict[str, str]:
    """Do the missing parts of these jobs, and return a sentence for each failed job, by its name.

    All other jobs are then complete.

    together: benchmark a run as soon as it is prepared, on a worker with a machine of its own, while others prepare.
    Otherwise all benchmarks come last, when nothing disturbs them. If a worker dies, another repeats what it was doing,
    at most three times. After an interruption, the same call continues.
    """
    from distributed import as_completed

    folder, work, failed = Path(folder).resolve(), work or Notebooks(), dict[str, str]()
    folder.mkdir(parents=True, exist_ok=True)
    by_name, marks = {job.name: job for job in jobs}, fingerprints(jobs)

    def submit(part: str, job: Job) -> "Future":
        needs = {"resources": {TIMING: 1}} if part == "benchmark" else {}
        return client.submit(
            do, part, work, job, folder, marks[job.name], key=f"{part}-{job.name}", pure=False, **needs
        )

    def follow(futures: Sequence["Future"], then: Callable[[str], "Future | None"], desc: str, total: int) -> None:
        completed = as_completed(futures)
        for future in progress(completed, desc=desc, total=total):
            name = str(future.key).partition("-")[2]
            if (error := future.exception()) is None:
                if (after := then(name)) is not None:
                    completed.add(after)
            else:
                failed[name] = _sentence(error)

    missing = {name: parts_done(job, folder, marks[name]) for name, job in by_name.items()}
    prepare = [name for name, done in missing.items() if "prepare" not in done]
    first = [submit("prepare", by_name[name]) for name in prepare]
    if together:
        rest = [n for n, done in missing.items() if "prepare" in done and "benchmark" not in done]
        first += [submit("benchmark", by_name[name]) for name in rest]
        prepared = set(rest)

        def then(name: str) -> "Future | None":
            if name in prepared:
                return None
            prepared.add(name)
            return submit("benchmark", by_name[name])

        follow(first, then, "runs", 2 * len(prepare) + len(rest))
    else:
        follow(first, lambda _: None, "runs", len(first))
        rest = [n for n, done in missing.items() if "benchmark" not in done and n not in failed]
        follow([submit("benchmark", by_name[n]) for n in rest], lambda _: None, "benchmarks", len(rest))
    return failed


def _sentence(error: BaseException) -> str:
    if type(error).__name__ == "KilledWorker":
        return "its worker died each time; is there enough memory?"
    return str(error) if isinstance(error, RoverError) else f"{type(error).__name__}: {error}"


# --- what came out ----------------------------------------------------------------------------------------------------


def rows(jobs: Sequence[Job], folder: Path | str, marks: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return a row for each complete run, from its JSON: its settings, and the figures of its static INT8 artifact.

    marks: the result of `fingerprints` for these jobs. In a row, error_pct is the largest of the actions' errors
    against FP32, and to_recorded_pct the largest against what the driver did. best is true unless another run is at
    least as good in error to the recordings, time and size, and better in one of them.
    """
    found = []
    for job in jobs:
        run = Path(folder) / job.name
        if "benchmark" not in parts_done(job, Path(folder), marks[job.name]):
            continue
        compared = read_stage(run / "compare.json", "compare")["metrics"]
        timed = _read_times(run)
        mode = compared["modes"][MODE]
        ours = [mode[f"{action}_mae_pct"] for action in compared["action_range"]]
        recorded = [mode.get(f"{action}_vs_recorded_pct") for action in compared["action_range"]]
        found.append(
            {
                "name": job.name,
                "settings": job.settings,
                "error_pct": judge.worst(ours),
                "to_recorded_pct": judge.worst(recorded),
                "hits": mode["hits"],
                "trials": mode["trials"],
                "size_mb": mode["size_mb"],
                "latency_p50_ms": timed["metrics"]["artifacts"][MODE]["latency_p50_ms"],
                "host": timed["env"]["host"],
            }
        )
    for row in found:
        row["best"] = not any(_beats(other, row) for other in found)
    return found


def _read_times(run: Path) -> dict[str, Any]:
    """Read the benchmark of the run's artifacts. Raises SweepError if there is none."""
    path = benchmark_of(run, read_stage(run / "quantize.json", "quantize")["metrics"]["modes"])
    if path is None:
        raise SweepError(f"{run}: no benchmark of its artifacts", remedy="remove that folder, and sweep again")
    return read_stage(path, "benchmark")


def _beats(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether one row is at least as good as the other in everything, and better in something.

    A figure that one of them lacks is not compared.
    """
    keys = ("to_recorded_pct", "latency_p50_ms", "size_mb")
    pairs = [(one[k], other[k]) for k in keys if one[k] is not None and other[k] is not None]
    return all(a <= b for a, b in pairs) and any(a < b for a, b in pairs)


def write_report(jobs: Sequence[Job], folder: Path | str, failed: Mapping[str, str]) -> dict[str, Any]:
    """Write sweep.json and sweep.png into the sweep's folder, and return the JSON's content."""
    from rover_learn.plots.sweep import pareto

    folder, marks = Path(folder), fingerprints(jobs)
    found = rows(jobs, folder, marks)
    metrics = {"runs": found, "failed": dict(failed), "missing": len(jobs) - len(found) - len(failed)}
    content = write_stage(folder / REPORT, "sweep", params={"mode": MODE}, metrics=metrics, inputs=marks)
    if found:
        with atomic_path(folder / FIGURE) as temporary:
            pareto(found).savefig(temporary, format="png", dpi=200)
    return content


def table(found: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the rows as text, the smallest error to the recordings first. A star marks a run that no other beats."""
    header = ["", "run", "to recorded %", "to FP32 %", "p50 ms", "MB", "hits"]
    lines = [header]
    for row in sorted(found, key=lambda r: (r["to_recorded_pct"] is None, r["to_recorded_pct"])):
        hits = "-" if not row["trials"] else f"{row['hits']} of {row['trials']}"
        figures = [number(row["to_recorded_pct"], ".2f"), number(row["error_pct"], ".2f")]
        times = [number(row["latency_p50_ms"]), number(row["size_mb"])]
        lines.append(["*" if row["best"] else "", row["name"], *figures, *times, hits])
    names = max(len(line[1]) for line in lines)
    return align([[line[0], line[1].ljust(names), *line[2:]] for line in lines])

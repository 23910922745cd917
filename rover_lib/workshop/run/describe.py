"""Describe a file or a folder of this project, or the runs in it, for `rover inspect`."""

import shlex
from contextlib import suppress
from pathlib import Path
from typing import Any

from rover_lib.onboard.artifact.manifest import ONNX_SUFFIX
from rover_lib.onboard.cli import describe_artifact
from rover_lib.onboard.drive.flight_log import read_log
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.kinds import check_kind, kinds_of
from rover_lib.onboard.stage import read_stage, sha256_of
from rover_lib.workshop.pictures.shown import with_faults
from rover_lib.workshop.pictures.turning import measure_sides, with_late
from rover_lib.workshop.progress import Progress, silent
from rover_lib.workshop.recordings.episodes import load_recordings
from rover_lib.workshop.recordings.source import Source

DRIVES = 40  # whose sides are measured, so that a folder of any size takes seconds
FIRST = "rover run makes the first; in a clone, make demo too"


def describe(source: Source, progress: Progress = silent) -> dict[str, Any]:
    """{kind: its content}, for every kind of file or folder that this project writes or reads.

    Raises the RoverError of that kind's loader if it is damaged, has another version, or is of no known kind.
    """
    path = source.path
    kinds = kinds_of(source.path)
    kind = kinds[0] if kinds else None
    if path == Path("runs") or (kind is None and path.is_dir()):
        if folders := runs(path):
            return {"runs": {run["name"]: run["verdict"] for run in folders}}
        if path == Path("runs"):
            raise RoverError(f"{path}: no run in it", remedy=FIRST)
    if kind == "artifact":
        return describe_artifact(path)
    if kind == "run":
        return {"run": _run(path)}
    if kind == "flight log":
        return {"flight log": {k: v for k, v in read_log(path).summary().items() if k != "events"}}
    if kind == "stage":
        content = read_stage(path, None)
        return {"report": {**content, "metrics": sorted(content["metrics"]), "inputs": len(content["inputs"])}}
    if not path.exists():
        check_kind(path, "recordings")  # says what to do
    if kind in ("recordings", "dataset", "tub") or (kind is None and path.is_dir()):
        recordings = with_faults(load_recordings(source, progress=progress), progress)
        sides = measure_sides(recordings, progress, DRIVES)
        content = with_late(recordings, sides).summary()
        if sides.turnings:
            content |= {"steering": sides.words(), "by_episode": [turning.words() for turning in sides.turnings]}
        return {"recordings": content}
    from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint  # it names other files, as for `rover run`

    checkpoint = load_checkpoint(path, said=source.facts)
    return {"checkpoint": {"sha256": checkpoint.sha256, **checkpoint.report}}


def _run(folder: Path) -> dict[str, Any]:
    files = sorted([*folder.glob("policy_*.pt"), *folder.glob(f"policy_*{ONNX_SUFFIX}")])
    artifacts = {p.name: f"{p.stat().st_size / 1e6:.1f} MB" for p in files}
    stages = sorted(p.stem for p in folder.glob("*.json") if p.name != "run.json")
    return {"verdict": verdict_of(folder), "stages": stages, "artifacts": artifacts}


def runs(folder: Path | str) -> list[dict[str, str]]:
    """{name, verdict} of each run in a folder such as runs/, by name. Raises RoverError if there is no such folder."""
    folder = Path(folder)
    if not folder.is_dir():
        raise RoverError(f"{folder}: no such folder", remedy=FIRST)
    paths = sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith("."))
    return [{"name": p.name, "verdict": verdict_of(p)} for p in paths if set(kinds_of(p)) & {"run", "pretrained"}]


def verdict_of(run_dir: Path) -> str:
    """A run's verdict in one line; if it has none of the files that are there, the command that makes one."""
    with suppress(RoverError, KeyError):  # there is none yet, or it cannot be used
        stage = read_stage(run_dir / "run.json", "run")
        there = {run_dir / name: sha256 for name, sha256 in stage["inputs"].items() if (run_dir / name).is_file()}
        if all(sha256_of(path) == sha256 for path, sha256 in there.items()):
            return str(stage["metrics"]["headline"])
    if (run_dir / "compare.json").is_file():
        return f"no verdict of its files: rover report {shlex.quote(str(run_dir))}"
    policy = next((p for p in (run_dir / "best_model.pth", run_dir / "pretrained_model") if p.exists()), "CHECKPOINT")
    return f"no run yet: rover run {shlex.quote(str(policy))} EPISODES --name {shlex.quote(run_dir.name)}"

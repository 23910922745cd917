"""What a file or a folder is, told by its looks alone: nothing is loaded, so that every command can ask first.

    kinds_of("runs/mine/policy_static.pt")                  # ("artifact",)
    check_kind(path, "checkpoint")                          # KindError: ... this is an artifact already; deploy it ...

A folder may be several at once: what `rover distill` leaves is a run and a LeRobot checkpoint. What cannot be told is
left to the command, whose own error says what is wrong with it.
"""

import json
import math
import os
import stat
import zipfile
from pathlib import Path
from typing import Any

import click

from rover_lib.onboard.archive import HEF, ONNX
from rover_lib.onboard.errors import RoverError

CALLED = {
    "artifact": "an artifact",
    "checkpoint": "a trainer's checkpoint",
    "pretrained": "a LeRobot checkpoint",
    "calibration": "the calibration of a run",
    "stage": "the report of a run's stage",
    "flight log": "a flight log",
    "recordings": "a folder of recordings",
    "dataset": "a LeRobotDataset",
    "run": "a run's folder",
}
WANTED = {  # by what a command wants: the kinds that it takes, and how to come by one
    "artifact": (("artifact",), "give a policy_<mode>.pt, which rover run makes of a checkpoint"),
    "checkpoint": (("checkpoint", "pretrained"), "give the trainer's best_model.pth, or LeRobot's pretrained_model"),
    "recordings": (("recordings", "dataset"), "give the folder that holds episode_*, or a LeRobotDataset's"),
    "run": (("run",), "give a folder that rover run has made, such as runs/mine"),
    "flight log": (("flight log",), "give the file that rover drive wrote, named by its --log"),
}
INSTEAD = {  # what to do with one, where something else was wanted
    ("artifact", "checkpoint"): "it is quantized already: deploy it, or give the checkpoint that it was made of",
    ("artifact", "run"): "give the folder in which it lies",
    ("checkpoint", "artifact"): "rover run CHECKPOINT EPISODES makes artifacts of it",
    ("pretrained", "artifact"): "rover run CHECKPOINT EPISODES makes artifacts of it",
    ("recordings", "checkpoint"): "recordings come second: rover run CHECKPOINT EPISODES",
    ("dataset", "checkpoint"): "recordings come second: rover run CHECKPOINT EPISODES",
    ("checkpoint", "recordings"): "the checkpoint comes first: rover run CHECKPOINT EPISODES",
    ("pretrained", "recordings"): "the checkpoint comes first: rover run CHECKPOINT EPISODES",
    ("recordings", "flight log"): "rover inspect says what is in recordings; a flight log is a file of its own",
    ("run", "artifact"): "give one of its policy_<mode>.pt; rover report says which",
    ("run", "checkpoint"): "give the checkpoint that it was made of, which its load.json names",
    ("run", "recordings"): "give the recordings that it was made of, which its load.json names",
}
EPISODE_FILES = ("episode_data.json", "control_data.csv", "frame_data.csv")
HEAD = 65536  # bytes of a file that are looked at
PICKLE_HEAD = 4096  # of a torch file's pickle, which names its keys early


class KindError(RoverError):
    """A file or a folder that is another thing than the command wants."""


def kinds_of(path: Path | str) -> tuple[str, ...]:
    """Keys of CALLED that the path is; none where nothing is there, or nothing that is known here."""
    path = Path(path)
    try:
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            return _of_folder(path)
        return _of_file(path) if stat.S_ISREG(mode) else ()  # a FIFO or a device is not read from
    except OSError:
        return ()


def check_kind(path: Path | str, wanted: str) -> None:
    """Raise KindError for a path that is something, and not what is wanted: a key of WANTED."""
    found = kinds_of(path)
    takes, remedy = WANTED[wanted]
    if not found or set(found) & set(takes):
        return
    kind = found[0]
    what = "an artifact already" if (kind, wanted) == ("artifact", "checkpoint") else CALLED[kind]
    raise KindError(f"{path}: this is {what}, not {CALLED[takes[0]]}", remedy=INSTEAD.get((kind, wanted), remedy))


def check_output(path: Path, kind: str | None, *, appended: bool = False) -> None:
    """Raise KindError for a file that a command shall not write: see `Output`."""
    if path.is_dir():
        raise KindError(f"{path}: this is a folder, and one file is to be written", remedy="name the file in it")
    there = path.exists()
    if found := set(kinds_of(path)) - {kind}:
        raise KindError(f"{path}: this is {CALLED[found.pop()]}, and would be lost", remedy="give another name")
    if there and not path.is_file() and not appended:
        raise KindError(f"{path}: this is no ordinary file, and would be replaced by one", remedy="give another name")
    folder = next((p for p in path.absolute().parents if p.exists()), Path("/"))
    if not (there and appended) and not (folder.is_dir() and os.access(folder, os.W_OK)):
        what = "cannot be written to" if folder.is_dir() else "this is a file, not a folder"
        raise KindError(f"{folder}: {what}", remedy="name a file elsewhere")


class Output(click.Path):
    """A command's option that names a file to write. Refused before any work is one that could not be written, and one
    that would cost what is there, as far as that is known here and of another kind than what is written.

    kind: a key of CALLED, or None for what is none of these. appended: to what is there, instead of replacing it.
    """

    def __init__(self, kind: str | None = None, *, appended: bool = False):
        super().__init__(path_type=Path)
        self.kind, self.appended = kind, appended

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        path = Path(str(super().convert(value, param, ctx)))
        if not (ctx and ctx.resilient_parsing):
            check_output(path, self.kind, appended=self.appended)
        return path


class Number(click.FloatRange):
    """A command's option that is a number within limits, which click lets "nan" pass, as that is below and above none;
    nor is infinity one."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number.", param, ctx)
        return number


class PathTo(click.Path):
    """A command's argument that names an existing thing of one kind, a key of WANTED. Raises KindError for another."""

    def __init__(self, wanted: str):
        super().__init__(path_type=Path)
        self.wanted = wanted

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        path = Path(str(super().convert(value, param, ctx)))
        if not (ctx and ctx.resilient_parsing):
            check_kind(path, self.wanted)
        return path


def _of_folder(folder: Path) -> tuple[str, ...]:
    names = {p.name for p in folder.iterdir()}
    kinds = []
    if names & {"load.json", "run.json", "quantize.json"} or any(n.startswith("policy_") for n in names):
        kinds.append("run")
    if (folder / "meta" / "info.json").is_file():
        kinds.append("dataset")
    if {"config.json", "adapter_config.json", "pretrained_model", "checkpoints", "last"} & names:
        kinds.append("pretrained")
    if names & set(EPISODE_FILES) or any(n.startswith("episode_") and (folder / n).is_dir() for n in names):
        kinds.append("recordings")
    return tuple(kinds)


def _of_file(file: Path) -> tuple[str, ...]:
    with file.open("rb") as f:
        head = f.read(HEAD)
    if head[:4] == b"PK\x03\x04":
        return _of_archive(file)
    if head[:1] == b"{":
        if b'"kind":"header"' in head.partition(b"\n")[0]:  # compact, as telemetry seals a line
            return ("flight log",)
        if (stage := _stage_of(head)) is not None:
            return ("stage",) if stage else ()
    if file.name in EPISODE_FILES:
        return ("recordings",)
    return ()


def _of_archive(file: Path) -> tuple[str, ...]:
    """Of a zip file as torch or `rover export` writes them; a damaged one is none of them."""
    try:
        with zipfile.ZipFile(file) as z:
            names = z.namelist()
            if ONNX in names or HEF in names or any("/code/" in name for name in names):
                return ("artifact",)
            pickled = next((name for name in names if name.endswith("/data.pkl")), None)
            if pickled is None:
                return ()
            with z.open(pickled) as f:
                keys = f.read(PICKLE_HEAD)
    except Exception:  # zipfile says in many types that a file is damaged
        return ()
    if b"model_state_dict" in keys:
        return ("checkpoint",)
    return ("calibration",) if b"image_sizes" in keys and b"smooth" in keys else ()


def _stage_of(head: bytes) -> str | None:
    """The stage that a report is of; its first keys say so, whatever its size."""
    text = head[:200].decode("utf-8", "replace")
    if '"schema"' not in text or '"stage"' not in text:
        return None
    try:
        return str(json.loads(text.partition('"stage":')[2].partition(",")[0]))
    except ValueError:
        return None

"""Recognise what kind of file or folder a path is, without loading it, so that every command can check its arguments.

    kinds_of("runs/mine/policy_static.pt")                  # ("artifact",)
    check_kind(path, "checkpoint")                          # RoverError: ... this is an artifact, not a checkpoint; ...

A folder may be of several kinds, such as a run and a LeRobot checkpoint. A path of an unknown kind is not refused here.
"""

import math
import os
import re
import shlex
import zipfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import click

from rover_lib.onboard.artifact.archive import DIRECTORY_BYTES, ONNX
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.params import params

CALLED = {
    "artifact": "an artifact",
    "checkpoint": "a trainer's checkpoint",
    "pretrained": "a LeRobot checkpoint",
    "recordings": "a folder of recordings",
    "dataset": "a LeRobotDataset",
    "tub": "a donkeycar tub",
    "run": "a run's folder",
    "flight log": "a flight log",
    "stage": "the report of a run's stage",
    "benchmark": "a benchmark",
}
WANTED = {  # what a command takes: the kinds, and how to get one
    "artifact": (("artifact",), "rover run CHECKPOINT EPISODES makes policy_<mode>.pt"),
    "checkpoint": (("checkpoint", "pretrained"), "the checkpoint comes first: best_model.pth, or LeRobot's folder"),
    "recordings": (
        ("recordings", "dataset", "tub"),
        "give the folder that holds episode_*, a LeRobotDataset's, or a donkeycar tub",
    ),
    "run": (("run",), "give a folder that rover run has made, such as runs/mine"),
    "flight log": (("flight log",), "give the file that rover drive wrote, named by its --log"),
}
ON_HUB = {"checkpoint": (), "recordings": ("--repo-type", "dataset")}  # what LeRobot's Hub has, with hf's option for it
POINTER = b"version https://git-lfs"  # how a Git LFS pointer begins
EPISODE_FILES = ("episode_data.json", "control_data.csv", "frame_data.csv")
POLICY_FILES = ("config.json", "adapter_config.json", "pretrained_model", "checkpoints", "last", "model.safetensors")
HEAD = 4096  # bytes that are read of a file, and of a torch file's pickle, which names its keys early


def kinds_of(path: Path | str) -> tuple[str, ...]:
    """Return the kinds of a path, as keys of CALLED; empty if the path does not exist or is of no known kind."""
    path = Path(path)
    try:
        if path.is_dir():
            return _of_folder(path)
        return _of_file(path) if path.is_file() else ()  # never read from a FIFO or a device
    except OSError:
        return ()


def check_kind(path: Path | str, wanted: str) -> None:
    """Raise RoverError for no path, and for one of a known kind that is not the wanted one, a key of WANTED."""
    kinds = kinds_of(path)
    takes, remedy = WANTED[wanted]
    if not Path(path).exists():
        raise RoverError(f"{path}: not found", remedy=_download(str(path), wanted) or remedy)
    if not kinds or set(kinds) & set(takes):
        return
    raise RoverError(f"{path}: this is {CALLED[kinds[0]]}, not {CALLED[takes[0]]}", remedy=remedy)


def _download(name: str, wanted: str) -> str:
    """How to get what looks like a name on the Hub; "" for any other path."""
    if wanted not in ON_HUB or not re.fullmatch(r"[\w.-]+/[\w.-]+", name) or Path(name).parent.exists():
        return ""
    folder = name.partition("/")[2]
    command = shlex.join(["hf", "download", *ON_HUB[wanted], name, "--local-dir", folder])
    return f"of the Hub? `{command}`, then give {folder}"


def refuse_pointer(path: Path, error: type[RoverError]) -> None:
    """Raise `error` if Git LFS left a pointer in place of a file, as a clone without it does."""
    if path.is_file() and read_head(path, len(POINTER)) == POINTER:
        raise error(f"{path}: a Git LFS pointer, not the file that it stands for", remedy="git lfs pull")


def read_head(file: Path, size: int = HEAD) -> bytes:
    """Return the first bytes of a file."""
    with file.open("rb") as f:
        return f.read(size)


def check_output(path: Path, kind: str | None, *, appended: bool = False) -> None:
    """Raise RoverError for a file that a command must not write, see `Output`."""
    if path.is_dir():
        raise RoverError(f"{path}: this is a folder, and one file is to be written", remedy="name the file in it")
    if (kinds := kinds_of(path)) and kind not in kinds:
        raise RoverError(f"{path}: this is {CALLED[kinds[0]]}, and would be lost", remedy="give another name")
    folder = next(p for p in path.absolute().parents if p.exists())
    if not (path.exists() and appended) and not (folder.is_dir() and os.access(folder, os.W_OK)):
        raise RoverError(f"{folder}: cannot be written to", remedy="name a file elsewhere")


class Output(click.Path):
    """A command's option that names a file to write. What would be lost or cannot be written is refused at once.

    kind: of the file that is written, a key of CALLED, or None. appended: the file is not replaced.
    """

    def __init__(self, kind: str | None = None, *, appended: bool = False):
        super().__init__(path_type=Path)
        self.kind = kind
        self.appended = appended

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        path = Path(str(super().convert(value, param, ctx)))
        check_output(path, self.kind, appended=self.appended)
        return path


class Number(click.FloatRange):
    """A command's option that is a finite number within limits: click alone accepts "nan"."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number.", param, ctx)
        return number


class Preset(click.Option):
    """A command's option that params.yml presets: "params.yml" in its help becomes the value that holds now.

    preset: finds it in params(). It is given the command's name too, whose section may be meant.
    """

    def __init__(self, *names: Any, preset: Callable[[dict[str, Any], str], object], **options: Any):
        super().__init__(*names, **options)
        self._preset = preset

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        record = super().get_help_record(ctx)
        with suppress(RoverError, KeyError):  # of a bad params.yml; the command itself says that
            value = self._preset(params(), ctx.command.name or "")
            return record and (record[0], record[1].replace("params.yml]", f"{value}, by params.yml]"))
        return record


class PathTo(click.Path):
    """A command's argument: an existing path of one kind, a key of WANTED. Raises RoverError for another kind."""

    def __init__(self, wanted: str):
        super().__init__(path_type=Path)
        self.wanted = wanted

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        path = Path(str(super().convert(value, param, ctx)))
        check_kind(path, self.wanted)
        return path


def _of_folder(folder: Path) -> tuple[str, ...]:
    names = {p.name for p in folder.iterdir()}
    kinds = []
    artifacts = [n for n in names if n.startswith("policy_") and n.endswith((".pt", ".zip"))]  # not policy_...json
    if names & {"load.json", "run.json", "quantize.json"} or artifacts:
        kinds.append("run")
    if (folder / "meta" / "info.json").is_file():
        kinds.append("dataset")
    steps = any(n.endswith(".distcp") or (folder / n / "pretrained_model").is_dir() for n in names)
    if names & set(POLICY_FILES) or steps:
        kinds.append("pretrained")
    if names & set(EPISODE_FILES) or any(n.startswith("episode_") and (folder / n).is_dir() for n in names):
        kinds.append("recordings")
    catalogs = "manifest.json" in names and any(n.endswith(".catalog") for n in names)
    if not kinds and (catalogs or names & {"catalog_0.catalog", "record_0.json"}):
        kinds.append("tub")
    return tuple(kinds)


def _of_file(file: Path) -> tuple[str, ...]:
    head = read_head(file)
    if head[:4] == b"PK\x03\x04":
        return _of_archive(file)
    if head.startswith(b"{") and b'"kind":"header"' in head.partition(b"\n")[0]:  # without spaces, as FlightLog writes
        return ("flight log",)
    if stage := re.match(rb'\{\s*"schema": *\d+,\s*"stage": *"(benchmark)?', head):  # enough for a report of any size
        return ("stage", "benchmark") if stage[1] else ("stage",)
    return ("recordings",) if file.name in EPISODE_FILES else ()


def _of_archive(file: Path) -> tuple[str, ...]:
    """Return the kinds of a zip file that torch or `rover export` wrote; none for a damaged one."""
    with suppress(Exception), file.open("rb") as f:  # zipfile raises errors of many types for a damaged file
        # An artifact's directory, which names its records, is not opened as a zip for that.
        f.seek(max(0, file.stat().st_size - DIRECTORY_BYTES))
        directory = f.read()
        if any(name.encode() in directory for name in (ONNX, "/code/")):
            return ("artifact",)
        with zipfile.ZipFile(file) as z, z.open(next(n for n in z.namelist() if n.endswith("/data.pkl"))) as content:
            keys = content.read(HEAD)
        return ("checkpoint",) if b"model_state_dict" in keys else ()
    return ()

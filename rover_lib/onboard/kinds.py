"""Recognise what kind of file or folder a path is, without loading it, so that every command can check its arguments.

    kinds_of("runs/mine/policy_static.pt")                  # ("artifact",)
    check_kind(path, "checkpoint")                          # KindError: ... this is an artifact already; deploy it ...

A folder may be of several kinds: `rover distill` makes one that is both a run and a LeRobot checkpoint. A path of an
unknown kind is not refused here; the command itself then reports what is wrong with it.
"""

import json
import math
import os
import stat
import zipfile
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

import click

from rover_lib.onboard.artifact.archive import DIRECTORY_BYTES, HEF, ONNX
from rover_lib.onboard.errors import RoverError, printable

CALLED = {
    "artifact": "an artifact",
    "checkpoint": "a trainer's checkpoint",
    "pretrained": "a LeRobot checkpoint",
    "calibration": "the calibration of a run",
    "stage": "the report of a run's stage",
    "flight log": "a flight log",
    "recordings": "a folder of recordings",
    "dataset": "a LeRobotDataset",
    "tub": "a donkeycar tub",
    "run": "a run's folder",
    "checkpoint part": "a part of a LeRobot checkpoint",
    "dataset part": "a part of a LeRobotDataset",
    "document": "a document",
    "pointer": "a Git LFS pointer, not the file that it stands for",
    "packed": "an archive",
}
WANTED = {  # what a command wants: the kinds that it accepts, and how to get one
    "artifact": (("artifact",), "give a policy_<mode>.pt, which rover run makes of a checkpoint"),
    "checkpoint": (("checkpoint", "pretrained"), "give the trainer's best_model.pth, or LeRobot's pretrained_model"),
    "recordings": (("recordings", "dataset"), "give the folder that holds episode_*, or a LeRobotDataset's"),
    "run": (("run",), "give a folder that rover run has made, such as runs/mine"),
    "tub": (("tub",), "give the folder with manifest.json and the catalogs, or with record_<number>.json"),
    "flight log": (("flight log",), "give the file that rover drive wrote, named by its --log"),
}
INSTEAD = {  # (what was given, what was wanted): what to do instead
    ("artifact", "checkpoint"): "it is quantized already: deploy it, or give the checkpoint that it was made of",
    ("artifact", "run"): "give the folder in which it lies",
    ("checkpoint", "artifact"): "rover run CHECKPOINT EPISODES makes artifacts of it",
    ("pretrained", "artifact"): "rover run CHECKPOINT EPISODES makes artifacts of it",
    ("recordings", "checkpoint"): "recordings come second: rover run CHECKPOINT EPISODES",
    ("dataset", "checkpoint"): "recordings come second: rover run CHECKPOINT EPISODES",
    ("checkpoint", "recordings"): "the checkpoint comes first: rover run CHECKPOINT EPISODES",
    ("pretrained", "recordings"): "the checkpoint comes first: rover run CHECKPOINT EPISODES",
    ("tub", "recordings"): "rover import TUB OUT makes a LeRobotDataset of it",
    ("recordings", "flight log"): "rover inspect says what is in recordings; a flight log is a file of its own",
    ("run", "artifact"): "give one of its policy_<mode>.pt; rover report says which",
    ("run", "checkpoint"): "give the checkpoint that it was made of, which its load.json names",
    ("run", "recordings"): "give the recordings that it was made of, which its load.json names",
}
PARTS = ("checkpoint part", "dataset part")
NOTHING = {*PARTS, "document", "pointer", "stage"}  # what cannot be given for the folder that holds it
MOST_INSIDE = 500  # paths that are looked at, of a level
REFUSED = {
    "document": "give a file or folder that it describes",
    "pointer": "git lfs pull, where it was cloned, or download the file itself",
    "packed": "unpack it, and give the folder or the file in it",
}
POINTER = b"version https://git-lfs"  # how a Git LFS pointer begins
PACKED = (
    (0, b"\x1f\x8b"),
    (0, b"7z\xbc\xaf"),
    (0, b"Rar!"),
    (0, b"\xfd7zXZ"),
    (0, b"\x28\xb5\x2f\xfd"),
    (257, b"ustar"),
)
EPISODE_FILES = ("episode_data.json", "control_data.csv", "frame_data.csv")
PACKED_NAMES = (*EPISODE_FILES, "config.json", "info.json", "model.safetensors", "best_model.pth", "manifest.json")
HEAD = 65536  # bytes that are read of a file
PICKLE_HEAD = 4096  # bytes that are read of a torch file's pickle, which names its keys early


class KindError(RoverError):
    """A file or a folder that is not of the kind that the command needs."""


def kinds_of(path: Path | str) -> tuple[str, ...]:
    """Return the kinds of a path, as keys of CALLED; empty if the path does not exist or is of no known kind."""
    path = Path(path)
    try:
        mode = path.stat().st_mode
        if stat.S_ISDIR(mode):
            return _of_folder(path)
        return _of_file(path) if stat.S_ISREG(mode) else ()  # never read from a FIFO or a device
    except OSError:
        return ()


def check_kind(path: Path | str, wanted: str) -> None:
    """Raise KindError for a path of a known kind that is not the wanted one. wanted: a key of WANTED."""
    found = kinds_of(path)
    takes, remedy = WANTED[wanted]
    if not found or set(found) & set(takes):
        return
    refuse_part(path)
    kind = found[0]
    what = "an artifact already" if (kind, wanted) == ("artifact", "checkpoint") else CALLED[kind]
    raise KindError(f"{path}: this is {what}, not {CALLED[takes[0]]}", remedy=INSTEAD.get((kind, wanted), remedy))


def refuse_part(path: Path | str) -> None:
    """Raise KindError for a part of a LeRobot checkpoint or LeRobotDataset, and for what nothing here reads.

    That is a document, an archive, or a Git LFS pointer.
    """
    kind = next(iter(kinds_of(path)), "")
    if kind in PARTS:
        folder = Path(path).absolute().parent
        if folder.name == "training_state":  # the optimizer's, beside pretrained_model
            folder = folder.parent
        if kind == "dataset part":
            folder = next((p for p in (folder, *folder.parents[:4]) if (p / "meta" / "info.json").is_file()), folder)
        raise KindError(f"{path}: this is {CALLED[kind]}", remedy=f"give its folder, {os.path.relpath(folder)}")
    if kind in REFUSED:
        raise KindError(f"{path}: this is {CALLED[kind]}", remedy=REFUSED[kind])


def refuse_holder(folder: Path | str) -> None:
    """Raise KindError for a folder that is nothing itself, but holds what is: checkpoints, or a cache of the Hub."""
    for level in ("*", "*/*", "*/*/*"):
        found = sorted(islice(Path(folder).glob(level), MOST_INSIDE))
        inside = [p for p in found if not set(kinds_of(p)) <= NOTHING]
        if inside:
            names = ", ".join(os.path.relpath(p, folder) for p in inside[:4]) + (" ..." if len(inside) > 4 else "")
            raise KindError(
                f"{folder}: holds {CALLED[kinds_of(inside[0])[0]]}, and is none itself",
                found=printable(names),
                remedy=f"give {'that' if len(inside) == 1 else 'one of them'}, as in {inside[0]}",
            )


def refuse_pointer(path: Path, error: type[RoverError]) -> None:
    """Raise `error` if Git LFS left a pointer in place of a file, as a clone without it does."""
    with suppress(OSError):
        if not path.is_file():  # opening a pipe would wait for ever
            return
        with path.open("rb") as f:
            head = f.read(len(POINTER))
        if head == POINTER:
            raise error(f"{path}: {CALLED['pointer']}", remedy=REFUSED["pointer"])


def check_output(path: Path, kind: str | None, *, appended: bool = False) -> None:
    """Raise KindError for a file that a command must not write, see `Output`."""
    if path.is_dir():
        raise KindError(f"{path}: this is a folder, and one file is to be written", remedy="name the file in it")
    there = path.exists()
    if found := set(kinds_of(path)) - {kind, "dataset part", "document"}:  # a film may take the place of a film
        raise KindError(f"{path}: this is {CALLED[found.pop()]}, and would be lost", remedy="give another name")
    if there and not path.is_file() and not appended:
        raise KindError(f"{path}: this is no ordinary file, and would be replaced by one", remedy="give another name")
    folder = next((p for p in path.absolute().parents if p.exists()), Path("/"))
    if not (there and appended) and not (folder.is_dir() and os.access(folder, os.W_OK)):
        what = "cannot be written to" if folder.is_dir() else "this is a file, not a folder"
        raise KindError(f"{folder}: {what}", remedy="name a file elsewhere")


class Output(click.Path):
    """A command's option that names a file to write.

    It is refused before any work is done if it could not be written, or if it exists and is of another known kind, and
    so would be lost.

    kind: of the file that is written, a key of CALLED; None if it has none of these kinds. appended: the file is
    appended to and not replaced.
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
    """A command's option that is a finite number within limits.

    click alone accepts "nan", which is neither below nor above any limit.
    """

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number.", param, ctx)
        return number


class PathTo(click.Path):
    """A command's argument: an existing path of one kind, a key of WANTED. Raises KindError for another kind."""

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
    if folder.name in ("meta", "data", "videos", "images") and (folder.parent / "meta" / "info.json").is_file():
        return ("dataset part",)
    if "training_step.json" in names:
        return ("checkpoint part",)
    kinds = []
    artifacts = [n for n in names if n.startswith("policy_") and n.endswith((".pt", ".zip"))]  # not policy_...json
    if names & {"load.json", "run.json", "quantize.json"} or artifacts:
        kinds.append("run")
    if (folder / "meta" / "info.json").is_file():
        kinds.append("dataset")
    of_policy = {"config.json", "adapter_config.json", "pretrained_model", "checkpoints", "last", "model.safetensors"}
    if of_policy & names or any(n.endswith(".distcp") or (folder / n / "pretrained_model").is_dir() for n in names):
        kinds.append("pretrained")
    if names & set(EPISODE_FILES) or any(n.startswith("episode_") and (folder / n).is_dir() for n in names):
        kinds.append("recordings")
    if not kinds and (
        {"catalog_0.catalog", "record_0.json"} & names
        or ("manifest.json" in names and any(n.endswith(".catalog") for n in names))
    ):
        kinds.append("tub")
    return tuple(kinds)


def _of_file(file: Path) -> tuple[str, ...]:
    with file.open("rb") as f:
        head = f.read(HEAD)
    if head.startswith(POINTER):
        return ("pointer",)
    if any(head[at:].startswith(magic) for at, magic in PACKED):
        return ("packed",)
    if head[:4] == b"PK\x03\x04":
        return _of_archive(file)
    if head[:1] == b"{":
        if b'"kind":"header"' in head.partition(b"\n")[0]:  # without spaces, as telemetry.py writes it
            return ("flight log",)
        if (stage := _stage_of(head)) is not None:
            return ("stage",) if stage else ()
    if file.name in EPISODE_FILES:
        return ("recordings",)
    of_policy = file.name in ("config.json", "train_config.json") or file.name.startswith(("policy_pre", "policy_post"))
    if file.suffix == ".safetensors" or (file.suffix == ".json" and of_policy):
        return ("checkpoint part",)
    if file.suffix in (".parquet", ".mp4") or (file.parent.name == "meta" and file.suffix in (".json", ".jsonl")):
        return ("dataset part",)
    if file.suffix.lower() in (".md", ".txt", ".html", ".ipynb", ".yml", ".yaml", ".py", ".pdf", ".csv"):
        return ("document",)
    return ()


def _of_archive(file: Path) -> tuple[str, ...]:
    """Return the kinds of a zip file that torch or `rover export` wrote; none for a damaged one."""
    try:
        with file.open("rb") as f:  # an artifact's directory, which names its records, is not opened as a zip for that
            f.seek(max(0, file.stat().st_size - DIRECTORY_BYTES))
            directory = f.read()
        if any(name.encode() in directory for name in (ONNX, HEF, "/code/")):
            return ("artifact",)
        with zipfile.ZipFile(file) as z:
            names = z.namelist()
            pickled = next((name for name in names if name.endswith("/data.pkl")), None)
            if pickled is None:
                return ("packed",) if any(Path(name).name in PACKED_NAMES for name in names) else ()
            with z.open(pickled) as f:
                keys = f.read(PICKLE_HEAD)
    except Exception:  # zipfile raises errors of many types for a damaged file
        return ()
    if b"model_state_dict" in keys:
        return ("checkpoint",)
    return ("calibration",) if b"image_sizes" in keys and b"smooth" in keys else ()


def _stage_of(head: bytes) -> str | None:
    """Return the stage of a report; None if it is no report.

    The stage is among the first keys, so that the head is enough for a file of any size.
    """
    text = head[:200].decode("utf-8", "replace")
    if '"schema"' not in text or '"stage"' not in text:
        return None
    try:
        return str(json.loads(text.partition('"stage":')[2].partition(",")[0]))
    except ValueError:
        return None

"""The contract between the stages: each stage writes one JSON file into the run's folder.

{"schema": 1, "stage": ..., "params": {...}, "metrics": {...}, "inputs": {file: sha256}, "env": {...}}
Metric keys end in their unit (_ms _mb _us _pct _hz _c _g). Papermill, pytest, Ansible and the plots read these.
"""

import contextlib
import errno
import fcntl
import glob
import hashlib
import json
import math
import os
import platform
import secrets
import socket
import stat
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, version
from io import BufferedReader, BufferedWriter
from pathlib import Path
from typing import Any

from filelock import FileLock

from rover_lib.onboard.durable import sync
from rover_lib.onboard.errors import RoverError

SCHEMA = 1
PARTS = ("params", "metrics", "inputs", "env")
FILE_BYTES = 50_000_000  # largest report, list or file of settings that is read


@contextmanager
def atomic_path(path: Path | str) -> Iterator[Path]:
    """Yield a temporary path beside `path`. It is renamed to `path` if the block succeeds, and removed if it fails.

    What a killed process left beside it is removed too. A lock tells it from what another process is writing.

    Raises RoverError if torch.save cannot write the whole file, OSError that names `path` for all else.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_leftovers(path)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}{path.suffix}")
    try:
        with _create_locked(temporary):
            yield temporary
            sync(temporary)  # a power cut after the rename must not leave an empty file
            temporary.replace(path)
            sync(path.parent)
    except OSError as error:
        if error.filename in (None, str(temporary)):  # of a full disk it says no name, else a name that nobody knows
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise
    except RuntimeError as error:
        if "inline_container" not in str(error):  # torch's file writer, which hides the system's error
            raise
        raise RoverError(f"{path}: cannot be written whole", remedy="is the disk full?") from error
    finally:
        temporary.unlink(missing_ok=True)


def _create_locked(path: Path) -> BufferedWriter:
    """Create a file, with a lock that tells it from what a killed process left."""
    while True:
        # Not mkstemp, whose mode of 0600 would hide the file from the service's user.
        file = os.fdopen(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666), "wb")
        with contextlib.suppress(OSError):  # a network's file system may have no such locks
            fcntl.flock(file, fcntl.LOCK_EX)
        if os.fstat(file.fileno()).st_nlink:
            return file
        file.close()  # another process removed it before it was locked


def _remove_leftovers(path: Path) -> None:
    for leftover in path.parent.glob(f".{glob.escape(path.name)}.{'[0-9a-f]' * 8}{glob.escape(path.suffix)}"):
        with contextlib.suppress(OSError), leftover.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            leftover.unlink()


def open_plain(path: Path | str, refusal: RoverError | OSError) -> BufferedReader:
    """Open a plain file for reading. Raises OSError, and `refusal` if it is no plain file.

    Path.open() would wait for a writer of a FIFO, and reading a device might never end.
    """
    file = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    if not stat.S_ISREG(os.fstat(file).st_mode):
        os.close(file)
        raise refusal
    return os.fdopen(file, "rb")


def read_plain(path: Path | str, most_bytes: int = FILE_BYTES) -> bytes:
    """Return a plain file's bytes. Raises OSError, also for what is no plain file or has more than most_bytes."""
    with open_plain(path, OSError(errno.EINVAL, "not a file", str(path))) as file:
        if (size := os.fstat(file.fileno()).st_size) > most_bytes:
            raise OSError(errno.EFBIG, f"{size / 1e6:.0f} MB, at most {most_bytes / 1e6:g} are read", str(path))
        return file.read(most_bytes)


def private_lock(path: Path | str) -> FileLock:
    """Return a lock that no other user can open, and so hold. Older versions left some that anybody could.

    It is never removed: on exFAT and mounted Windows folders each file shows rights for others, and it may be held.
    """
    with contextlib.suppress(OSError):
        Path(path).chmod(0o600)
    return FileLock(path, timeout=0, mode=0o600, thread_local=False)


def sha256_of(path: Path | str) -> str:
    """Return the hex SHA-256 of a file's bytes. Raises RoverError for what is no plain file."""
    with open_plain(path, RoverError(f"{path}: not a plain file")) as f:
        return hashlib.file_digest(f, "sha256").hexdigest()


def version_of(package: str) -> str | None:
    """Return the version of an installed package, None if it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def environment() -> dict[str, Any]:
    """Describe where a figure comes from: host, processor, cores, versions of Python and the engines, and commit.

    A value is None if it is unknown or not installed. `engine` is also None if this process has not loaded torch.
    """
    commit = None
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        command = ["git", "rev-parse", "--short", "HEAD"]
        git = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, timeout=5)
        commit = git.stdout.strip() or None
    torch = sys.modules.get("torch")  # not imported for this
    return {
        "host": socket.gethostname(),
        "machine": platform.machine(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "torch": torch.__version__ if torch else version_of("torch"),
        "onnxruntime": version_of("onnxruntime"),
        "engine": torch.backends.quantized.engine if torch else None,
        "commit": commit,
    }


def plain(value: Any) -> Any:
    """Convert values of numpy, torch and pathlib to JSON's types; NaN and infinities become None."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return [plain(v) for v in value]
    if hasattr(value, "tolist"):  # numpy's arrays and scalars, torch's tensors
        return plain(value.tolist())
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def write_stage(
    path: Path | str,
    stage: str,
    *,
    params: dict[str, Any],
    metrics: dict[str, Any],
    inputs: dict[str, str] | None = None,
) -> dict[str, Any]:
    """Write one stage's result atomically.

    Args:
        path: the JSON file.
        stage: its name, which `read_stage` asks for.
        params: what the result was made with.
        metrics: the result; paths, arrays and dataclasses become plain values.
        inputs: SHA-256 by the name of each file that it was made of.

    Returns:
        The content as it was written.
    """
    parts = {"params": params, "metrics": metrics, "inputs": inputs or {}, "env": environment()}
    content = plain({"schema": SCHEMA, "stage": stage, **parts})
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n")
    return content


def read_stage(path: Path | str, stage: str | None) -> dict[str, Any]:
    """Read what `write_stage` wrote. stage: the expected stage, or None for any.

    Raises RoverError if the file is missing, damaged, incomplete or of another stage.
    """
    path = Path(path)
    made_by = f"the notebook or command '{stage or path.stem}' makes it"
    try:
        content = json.loads(read_plain(path))
    except FileNotFoundError:
        raise RoverError(f"{path}: not found", remedy=f"is this the run's folder? {made_by}") from None
    except (ValueError, OSError, RecursionError) as e:  # RecursionError: too many nested brackets
        raise RoverError(f"{path}: not readable as JSON ({e})", remedy=made_by) from None
    parts = content if isinstance(content, dict) else {}
    whole = all(isinstance(parts.get(part), dict) for part in PARTS)
    if not whole or (parts.get("schema"), parts.get("stage")) != (SCHEMA, stage or parts.get("stage")):
        problem = f"{path}: not schema {SCHEMA} of stage '{stage or 'any'}' with {', '.join(PARTS)}"
        raise RoverError(problem, found=f"'{parts.get('stage')}' with {', '.join(sorted(parts))}", remedy=made_by)
    return parts

"""What both formats of checkpoints share: their limits, errors, and the files beside them."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rover_lib.onboard.errors import CheckpointError, printable
from rover_lib.onboard.kinds import refuse_pointer
from rover_lib.onboard.stage import atomic_path, read_plain
from rover_lib.workshop.act_config import ActConfig
from rover_lib.workshop.checkpoint.facts import DRIVES, Facts, meaning_of
from rover_lib.workshop.recordings.samples import ACTION_NAMES

# Config, weights by LeRobot's names without the leading `model.`, and more for the report.
Contents = tuple[ActConfig, dict[str, Tensor], dict[str, Any]]
MOST = 8192  # pixels a side, or numbers of a state or an action, before `check_limits` has seen them all
COPY_AGAIN = "copy it again, the whole folder if it is one"
CORRECT_IT = "correct the config to what the policy was trained with"
RATE_HZ = 30.0  # steps of a plan in a second if nothing says it: the rate of the trainer's recordings
JSON_BYTES = 1_000_000  # settings take some kB
# Files beside a checkpoint that may say how it was trained: those that are read.
BESIDE = re.compile(r"([^.].*_)?(config|cfg|hparams|args|hyperparameters|settings|metadata)\.(json|ya?ml)", re.I)
NUMBERS = re.compile(
    r"\.(safetensors|pth?|ckpt|bin|json|ya?ml|pkl|joblib|np[yz]|csv|txt)", re.I
)  # files that hold some


def name_numbers(count: int, stem: str) -> tuple[str, ...]:
    """Return names for `count` numbers of which nothing but their count is known: two are a car's."""
    return ACTION_NAMES if count == 2 else tuple(f"{stem}_{i}" for i in range(count))


@contextmanager
def as_checkpoint_error(path: Path, remedy: str = COPY_AGAIN) -> Iterator[None]:
    """Turn whatever LeRobot, or a reader below it, raises into a CheckpointError of one sentence."""
    try:
        yield
    except CheckpointError:
        raise
    except Exception as e:  # each library raises types of its own
        refuse_pointer(path, CheckpointError)
        cause = e.__cause__ or e  # draccus wraps what a config's own check says
        reason = printable(" ".join(f"{type(cause).__name__}: {cause}".split())[:200])
        raise CheckpointError(f"{path}: LeRobot cannot use it ({reason})", remedy=remedy) from None


def check_beside(folder: Path, facts: Facts) -> list[Path]:
    """Return a folder's files. Raises CheckpointError for one whose name says statistics or averaged weights."""
    files = sorted(folder.iterdir())
    named = b"".join(read_plain(path, JSON_BYTES) for path in folder.glob("policy_p*processor.json"))  # LeRobot's own
    for file in (*files, *sorted(folder.glob("assets/*/*"))):  # where openpi has them
        meaning = meaning_of(file.stem)
        holds = NUMBERS.fullmatch(file.suffix) or (file.is_dir() and meaning == DRIVES)
        own = file == facts.path or file.name.encode() in named or file.name in facts.ignored
        if meaning and holds and not own and not file.name.startswith((".", "policy_pre", "policy_post")):
            raise facts.refusal(file.name, "beside it", meaning)
    return files


def save_torch(path: Path, content: Any) -> None:
    """Write what torch.load reads, the same bytes for the same content: torch would name it by the file.

    Atomically; raises as `atomic_path`.
    """
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        torch.save(content, file)

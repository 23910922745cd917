"""Fetch checkpoints and datasets from the Hugging Face Hub, as user/name@revision: a branch, a tag or a commit.

    folder = fetch("user/name@v1", "model", CheckpointError)

The revision must be given, so that a mistyped path is never taken for an id. Fetched files stay in the Hub's cache.
"""

import re
from collections.abc import Sequence
from pathlib import Path

from rover_lib.onboard.errors import RoverError

ID = re.compile(r"\w[\w.-]*/\w[\w.-]*@[\w.-]+(/[\w.-]+)*")
FILES = {"model": ("*.json", "*.safetensors"), "dataset": ("meta/*", "data/*", "videos/*")}

REMEDY = "is its name right, and is it public?"
REMEDIES = {  # by the error of the Hub's client
    "LocalEntryNotFoundError": "the Hub cannot be reached: fetch it where there is a network, or give a folder",
    "GatedRepoError": "request access on its page, and log in with 'huggingface-cli login'",
    "RevisionNotFoundError": "give a branch, a tag or a commit that is there",
}


def is_hub_id(path: Path | str) -> bool:
    """Whether `path` has the form user/name@revision, and is not a file or folder on this machine."""
    return bool(ID.fullmatch(str(path))) and not Path(path).exists()


def absolute(path: Path | str) -> str:
    """Return a path that stays valid in another working folder. An id of the Hub is returned as it is."""
    return str(path) if is_hub_id(path) else str(Path(path).resolve())


def fetch(hub_id: Path | str, kind: str, error: type[RoverError], files: Sequence[str] | None = None) -> Path:
    """Fetch files of the Hub unless they are in the cache, and return the folder that holds them.

    kind: "model" or "dataset". files: patterns; None takes all that we read of such a repository. Raises `error`, in
    one sentence, if there is no network, if the Hub does not have it, or if its owner restricts access.
    """
    from huggingface_hub import snapshot_download  # here, because it takes a second

    repo, _, revision = str(hub_id).partition("@")
    wanted = list(files or FILES[kind])
    try:
        return Path(snapshot_download(repo, repo_type=kind, revision=revision, allow_patterns=wanted))
    except Exception as e:  # requests, the Hub's client and the disk each raise their own types
        name = type(e).__name__
        reason = (str(e).strip().splitlines() or [""])[0][:160]
        raise error(f"{hub_id}: no {kind} fetched ({name}: {reason})", remedy=REMEDIES.get(name, REMEDY)) from None

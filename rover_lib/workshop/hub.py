"""Fetch checkpoints and datasets from the Hugging Face Hub, as user/name@revision: a branch, a tag or a commit.

    folder = fetch("user/name@v1", "model", CheckpointError)

The revision must be given. So a mistyped path is never taken for an id, and nobody trains on an outdated version
without noticing. Fetched files stay in the Hub's own cache, where later runs find them without a network.
"""

import re
from collections.abc import Sequence
from pathlib import Path

from rover_lib.onboard.errors import RoverError

ID = re.compile(r"(?P<repo>\w[\w.-]*/\w[\w.-]*)@(?P<revision>[\w.-]+(/[\w.-]+)*)")
FILES = {"model": ("*.json", "*.safetensors"), "dataset": ("meta/*", "data/*", "videos/*")}


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
    # Imported here, because it takes a second, and a local path does not need it.
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import GatedRepoError, LocalEntryNotFoundError

    found = ID.fullmatch(str(hub_id))
    assert found, hub_id
    repo, revision = found["repo"], found["revision"]
    try:
        return Path(
            snapshot_download(repo, repo_type=kind, revision=revision, allow_patterns=list(files or FILES[kind]))
        )
    except LocalEntryNotFoundError:
        raise error(
            f"{hub_id}: is not in the Hub's cache on this machine, and the Hub cannot be reached",
            remedy="fetch it where there is a network, or give a folder",
        ) from None
    except GatedRepoError:
        raise error(
            f"{hub_id}: a gated repository",
            remedy="request access on its page, and log in with 'huggingface-cli login'",
        ) from None
    except Exception as e:  # requests, the Hub's client and the disk each raise their own types
        reason = (str(e).strip().splitlines() or [""])[0][:160]
        raise error(
            f"{hub_id}: cannot be fetched as a {kind} ({type(e).__name__}{': ' if reason else ''}{reason})",
            remedy="are its name and revision right, and is it public?",
        ) from None

"""Checkpoints and datasets of the Hugging Face Hub, by id and revision: user/name@main, or a tag, or a commit.

    folder = fetched("user/name@v1", "model", CheckpointError)

The revision must be said. So an id is never taken for a path that somebody mistyped, and nobody trains on what a name
meant yesterday. What was fetched stays in the Hub's own cache, where later runs find it without network.
"""

import re
from collections.abc import Sequence
from pathlib import Path

from rover_lib.onboard.errors import RoverError

ID = re.compile(r"(?P<repo>\w[\w.-]*/\w[\w.-]*)@(?P<revision>[\w.-]+(/[\w.-]+)*)")
FILES = {"model": ("*.json", "*.safetensors"), "dataset": ("meta/*", "data/*", "videos/*")}


def is_hub_id(path: Path | str) -> bool:
    """Whether it is user/name@revision, and nothing on this machine."""
    return bool(ID.fullmatch(str(path))) and not Path(path).exists()


def absolute(path: Path | str) -> str:
    """A path that means the same in another folder; an id of the Hub is one already."""
    return str(path) if is_hub_id(path) else str(Path(path).resolve())


def fetched(hub_id: Path | str, kind: str, error: type[RoverError], files: Sequence[str] | None = None) -> Path:
    """The folder of these files, fetched if they are not there yet.

    kind: "model" or "dataset". files: patterns, all that we read of such a repository if None. Raises `error`, in one
    sentence, without network, for what the Hub does not have, and for what it does not give to everybody.
    """
    # here, because it takes a second that paths need not wait for
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import GatedRepoError, LocalEntryNotFoundError, RevisionNotFoundError

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
            f"{hub_id}: its owner gives it only to whom he has granted access",
            remedy="ask for it on its page, and log in with 'huggingface-cli login'",
        ) from None
    except RevisionNotFoundError:
        raise error(f"{hub_id}: has no revision '{revision}'", remedy="give a branch, a tag or a commit") from None
    except Exception as e:  # of requests, of the Hub's client and of the disk, each with types of its own
        reason = (str(e).strip().splitlines() or [""])[0][:160]
        raise error(
            f"{hub_id}: cannot be fetched as a {kind} ({type(e).__name__}{': ' if reason else ''}{reason})",
            remedy="is its name right, and is it public?",
        ) from None

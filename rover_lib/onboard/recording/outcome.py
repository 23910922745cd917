"""Label recorded drives: whether a drive succeeded is noted afterwards, as `metadata.outcome`, and may be changed."""

import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path

from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.recording.episode import DATA, DATA_BYTES, HIT, MISSED
from rover_lib.onboard.stage import atomic_path, read_plain

NONE = "none"
CHOICES = (HIT, MISSED, NONE)


def label(episodes: Sequence[Path], outcome: str) -> None:
    """Note an outcome, one of CHOICES, in each of these episode folders; all are read before the first is written.

    Owner and mode of a file stay the same, so that a rover's service can still read it. Raises EpisodeError for one
    without a complete episode_data.json, or that cannot be written.
    """
    for path, text in [_relabelled(episode / DATA, outcome) for episode in episodes]:
        try:
            before = path.stat()
            with atomic_path(path) as temporary:
                temporary.write_text(text)
                shutil.copymode(path, temporary)
                if (before.st_uid, before.st_gid) != (os.geteuid(), os.getegid()):
                    os.chown(temporary, before.st_uid, before.st_gid)
        except OSError as error:
            raise EpisodeError(f"{path}: cannot be written ({error.strerror})", remedy="use sudo on a rover") from None


def _relabelled(path: Path, outcome: str) -> tuple[Path, str]:
    """Return an episode's file and its new text."""
    try:
        content = json.loads(read_plain(path, DATA_BYTES))
        metadata = content.setdefault("metadata", {})
        metadata.pop("outcome", None)
    except (OSError, ValueError, RecursionError, AttributeError, TypeError) as error:
        what = f"{path}: not an episode's JSON ({str(error)[:120]})"
        raise EpisodeError(what, remedy="give each episode's folder") from None
    if outcome != NONE:
        metadata["outcome"] = outcome
    return path, json.dumps(content, indent=2)

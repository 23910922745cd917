"""Label recorded drives: whether a drive succeeded is noted afterwards in its episode, and may be changed any time.

    label([Path("episodes/episode_20261007_144013")], "hit")     # or "missed"; "none" takes it back

The outcome is `metadata.outcome` in episode_data.json. Every other byte of that file stays the same, and the file is
replaced atomically. An outcome is one of a few values and not free text, because outcomes are counted, and LeRobot's
`next.success` is yes or no. What the drive was meant to do is the episode's action_label.
"""

import json
import os
import re
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.recording.episode import DATA_BYTES, HIT, MISSED
from rover_lib.onboard.stage import atomic_path, read_plain

NONE = "none"
CHOICES = (HIT, MISSED, NONE)
DATA = "episode_data.json"
_SPACE = re.compile(r"[ \t\n\r]*")
_WHOLE = "copy the episode again, or label the one that it was copied from"


def label(episodes: Sequence[Path], outcome: str) -> None:
    """Note an outcome, one of CHOICES, in each of these episode folders. Raises EpisodeError as relabel() does.

    All episodes are read before the first is written.
    """
    for path, text in [relabel(episode, outcome) for episode in episodes]:
        _replace(path, text)


def relabel(episode: Path, outcome: str) -> tuple[Path, bytes]:
    """Return an episode's file and its new content. Raises EpisodeError if it has no complete episode_data.json."""
    if outcome not in CHOICES:
        raise EpisodeError(f"an outcome is one of {', '.join(CHOICES)}", found=outcome)
    path = episode / DATA
    try:
        if path.is_symlink() or not path.is_file():
            found = sorted(p.name for p in episode.iterdir())[:3] if episode.is_dir() else "no folder"
            raise EpisodeError(
                f"{episode}: no episode with an {DATA} of its own", found=found, remedy="give each episode's folder"
            )
        data = read_plain(path, DATA_BYTES)
    except OSError as error:
        raise EpisodeError(f"{path}: cannot be read ({error.strerror})", remedy="use sudo on a rover") from None
    try:
        encoding = json.detect_encoding(data)
        text = data.decode(encoding, "surrogatepass")
        before = _parse(text)
        if not isinstance(before, dict) or not isinstance(before.get("metadata", {}), dict):
            raise ValueError("no object with an object of metadata in it")
        text = _with_outcome(text, None if outcome == NONE else json.dumps(outcome))
        after = _parse(text)
    except (ValueError, RecursionError) as error:
        raise EpisodeError(f"{path}: not readable as JSON ({str(error)[:120]})", remedy=_WHOLE) from None
    wanted = before | {"metadata": {k: v for k, v in before.get("metadata", {}).items() if k != "outcome"}}
    if outcome != NONE:
        wanted["metadata"]["outcome"] = outcome
    if after != wanted and not (outcome == NONE and after == before):
        raise EpisodeError(f"{path}: has a name twice", remedy="take one of them out by hand")
    return path, text.encode(encoding, "surrogatepass")


def _parse(text: str) -> Any:
    """Parse JSON, with numbers kept as text, so that two files can be compared even if they contain NaN."""
    return json.loads(text, parse_float=str, parse_int=str, parse_constant=str)


def _with_outcome(text: str, outcome: str | None) -> str:
    """Return an episode file's text with metadata.outcome set to that JSON, or without it if `outcome` is None."""
    start = _skip(text, 0)
    for name, _, value, end in _members(text, start):
        if name == "metadata":
            return text[:value] + _change_metadata(text[value:end], outcome) + text[end:]
    return text if outcome is None else _add_member(text, start, f'"metadata": {{"outcome": {outcome}}}')


def _change_metadata(text: str, outcome: str | None) -> str:
    """Do the same for the text of the metadata object alone."""
    members = list(_members(text, 0))
    found = [i for i, (name, *_) in enumerate(members) if name == "outcome"]
    if not found:
        return text if outcome is None else _add_member(text, 0, f'"outcome": {outcome}')
    _, begin, value, end = members[found[0]]
    if outcome is not None:
        return text[:value] + outcome + text[end:]
    if found[0]:
        return text[: members[found[0] - 1][3]] + text[end:]  # from the end of the member before it
    if len(members) > 1:
        return text[:begin] + text[members[1][1] :]
    return "{" + text[end:].lstrip()


def _add_member(text: str, start: int, member: str) -> str:
    """Add a member at the end of the object that begins at `start`, spaced like its first member; return the text."""
    members = list(_members(text, start))
    if not members:
        return f"{text[: start + 1]}{member}{text[start + 1 :]}"
    space, end = text[start + 1 : members[0][1]], members[-1][3]
    return f"{text[:end]},{space}{member}{text[end:]}"


def _members(text: str, start: int) -> Iterator[tuple[str, int, int, int]]:
    """Yield the members of the object at `start`: (name, start of the name, start of the value, end of the value).

    Raises ValueError if there is no object.
    """
    decoder = json.JSONDecoder()
    at = _skip(text, start + 1)
    while text[at : at + 1] != "}":
        begin = at
        name, at = decoder.raw_decode(text, at)
        value = _skip(text, _skip(text, at) + 1)  # after the colon
        _, end = decoder.raw_decode(text, value)
        yield name, begin, value, end
        at = _skip(text, end)
        if text[at : at + 1] == ",":
            at = _skip(text, at + 1)


def _skip(text: str, at: int) -> int:
    found = _SPACE.match(text, at)
    return found.end() if found else at


def _replace(path: Path, data: bytes) -> None:
    """Replace a file atomically. Owner and mode stay the same, so that a rover's service can still read it."""
    try:
        before = path.stat()
        if data == path.read_bytes():
            return
        with atomic_path(path) as temporary:
            temporary.write_bytes(data)
            shutil.copymode(path, temporary)
            if (before.st_uid, before.st_gid) != (os.geteuid(), os.getegid()):
                os.chown(temporary, before.st_uid, before.st_gid)
    except OSError as error:
        raise EpisodeError(f"{path}: cannot be written ({error.strerror})", remedy="use sudo on a rover") from None

"""Parameters, in rising priority: the rover's defaults, the user's params.yml on this machine, one run's own file."""

import os
from pathlib import Path
from typing import Any

import yaml

from rover_lib.onboard.errors import ParamsError
from rover_lib.onboard.stage import read_plain

MOST_BYTES = 1_000_000  # ours have some kB, and PyYAML reads a megabyte in seconds
DEFAULTS = Path(__file__).with_name("params.yml")  # all that a rover reads
PLACES = (  # where the user's params.yml may be; the first one that exists is used
    Path(__file__).parents[2] / "params.yml",  # a checkout's
    Path("/etc/rover/params.yml"),  # an installed rover's
    Path(__file__).parents[1] / "params.yml",  # an installed workstation's
)
FOR_THIS_RUN = "ROVER_PARAMS"  # environment variable: a file over all others


def params() -> dict[str, Any]:
    """All parameters: the rover's defaults, replaced by the user's values where those exist, and other sections added.

    Raises ParamsError for a file that is not a YAML mapping.
    """
    values = read_params(DEFAULTS)
    for place in PLACES:
        if place.is_file():
            _set(values, read_params(place), str(place))
            break
    if for_this_run := os.environ.get(FOR_THIS_RUN):
        _set(values, read_params(for_this_run), for_this_run)
    return values


class _EachKeyOnce(yaml.SafeLoader):
    """Refuses a key that appears twice. YAML forbids that, but PyYAML silently takes the last value."""

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        node = super().compose_mapping_node(anchor)
        keys = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value != "<<":
                if key.value in keys:
                    raise yaml.composer.ComposerError(None, None, f"{key.value!r} is there twice", key.start_mark)
                keys.add(key.value)
        return node


def read_params(path: Path | str) -> dict[str, Any]:
    """The content of one file. Raises ParamsError if it is missing, unreadable, or not a YAML mapping."""
    try:
        content = yaml.load(read_plain(path, MOST_BYTES).decode(), _EachKeyOnce)
    except Exception as e:  # PyYAML passes on Python's own errors, of a bad date or number, or too deep nesting
        raise ParamsError(f"{path}: not readable as YAML ({' '.join(str(e).split())})") from None
    if not isinstance(content or {}, dict):
        raise ParamsError(f"{path}: expected a mapping", found=type(content).__name__)
    return content or {}  # None: nothing but comments


def _set(values: dict[str, Any], changes: dict[str, Any], where: str) -> None:
    """Merge `changes` into `values`, key by key, recursively where both are mappings. where: the file, for errors."""
    for key, change in changes.items():
        if not isinstance(values.get(key), dict):
            values[key] = change
        elif isinstance(change, dict):
            _set(values[key], change, f"{where}: {key}")
        else:
            raise ParamsError(f"{where}: {key} must be a mapping", found=change)

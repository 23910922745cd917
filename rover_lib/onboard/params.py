"""Parameters: the rover's own defaults, over them what a user has set on this machine, over both what one run sets."""

import os
from pathlib import Path
from typing import Any

import yaml

from rover_lib.onboard.errors import ParamsError

DEFAULTS = Path(__file__).with_name("params.yml")  # all that a rover reads
PLACES = (  # of the user's params.yml; the first that exists counts
    Path(__file__).parents[2] / "params.yml",  # a checkout's
    Path("/etc/rover/params.yml"),  # an installed rover's
    Path(__file__).parents[1] / "params.yml",  # an installed workstation's
)
FOR_THIS_RUN = "ROVER_PARAMS"  # in the environment: a file put over the others, as `rover sweep` does for each run


def params() -> dict[str, Any]:
    """The rover's defaults, the user's values in their place where there are some, and the user's other sections.

    Raises ParamsError for a file that is no YAML mapping.
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
    """YAML forbids a key that is there twice; PyYAML takes the last one, and nobody is told which value counts."""

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        node = super().compose_mapping_node(anchor)
        seen = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode) and key.value != "<<":
                if key.value in seen:
                    raise yaml.composer.ComposerError(None, None, f"{key.value!r} is there twice", key.start_mark)
                seen.add(key.value)
        return node


def read_params(path: Path | str) -> dict[str, Any]:
    """The content of one file alone. Raises ParamsError if it is missing or unreadable, or no YAML mapping."""
    try:
        content = yaml.load(Path(path).read_text(), _EachKeyOnce)
    except FileNotFoundError:
        raise ParamsError(f"{path}: not found", remedy="it came with this package: install that again") from None
    except OSError as e:
        raise ParamsError(f"{path}: cannot be read ({e.strerror})") from None
    except Exception as e:  # PyYAML lets pass what Python says of a date, a number, a byte or a depth that is none
        raise ParamsError(f"{path}: not readable as YAML ({' '.join(str(e).split())})") from None
    if content is None:  # nothing but comments
        return {}
    if not isinstance(content, dict):
        raise ParamsError(f"{path}: expected a mapping", found=type(content).__name__)
    return content


def _set(values: dict[str, Any], changes: dict[str, Any], where: str) -> None:
    """Put `changes` in `values`, key by key, as deep as both are mappings. where: what an error names."""
    for key, change in changes.items():
        if not isinstance(values.get(key), dict):
            values[key] = change
        elif isinstance(change, dict):
            _set(values[key], change, f"{where}: {key}")
        else:
            raise ParamsError(f"{where}: {key} must be a mapping", found=change)

"""params.yml: every gate and default that notebooks, tests, playbooks and the car share."""

from pathlib import Path
from typing import Any

import yaml

from rover_lib.onboard.errors import ParamsError

PLACES = (
    Path(__file__).parents[2] / "params.yml",  # a checkout's
    Path("/etc/rover/params.yml"),  # an installed rover's
    Path(__file__).parents[1] / "params.yml",  # an installed workstation's
)


def params(path: Path | str | None = None) -> dict[str, Any]:
    """The content of params.yml, of the first of PLACES if no path is given.

    Raises ParamsError if it is missing or not YAML.
    """
    path = path or next((p for p in PLACES if p.is_file()), PLACES[0])
    try:
        content = yaml.safe_load(Path(path).read_text())
    except FileNotFoundError:
        raise ParamsError(f"{path}: not found; run from a checkout of the project (pip install -e .)") from None
    except yaml.YAMLError as e:
        raise ParamsError(f"{path}: not readable as YAML ({' '.join(str(e).split())})") from None
    if not isinstance(content, dict):
        raise ParamsError(f"{path}: expected a mapping, found {type(content).__name__}")
    return content

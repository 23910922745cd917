"""params.yml: every gate and default that notebooks, tests and playbooks share."""

from pathlib import Path
from typing import Any

import yaml

from rover_lib.onboard.errors import ParamsError

PATH = Path(__file__).parents[2] / "params.yml"


def params(path: Path | str = PATH) -> dict[str, Any]:
    """The content of params.yml. Raises ParamsError if it is missing or not YAML."""
    try:
        content = yaml.safe_load(Path(path).read_text())
    except FileNotFoundError:
        raise ParamsError(f"{path}: not found; run from a checkout of the project (pip install -e .)") from None
    except yaml.YAMLError as e:
        raise ParamsError(f"{path}: not readable as YAML ({' '.join(str(e).split())})") from None
    if not isinstance(content, dict):
        raise ParamsError(f"{path}: expected a mapping, found {type(content).__name__}")
    return content

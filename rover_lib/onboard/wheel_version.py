"""The version of the project, and of the rover's wheel: with a hash of what is in it.

Another content is another version, so that pip on the rover sees that there is something to install.
"""

import hashlib
from pathlib import Path

ONBOARD = Path(__file__).parent
PACKAGE = ONBOARD.parent / "__init__.py"
VERSION = "0.1.0"  # pyproject.toml reads it here too


def wheel_version() -> str:
    """Such as "0.1.0+0123456789ab". hatchling calls it when it builds the wheel, without importing rover_lib."""
    files = [p for p in ONBOARD.rglob("*") if p.is_file() and "__pycache__" not in p.parts]
    digest = hashlib.sha256()
    for path in sorted([PACKAGE, *files]):
        digest.update(f"{path.relative_to(PACKAGE.parent)}\0".encode() + path.read_bytes() + b"\0")
    return f"{VERSION}+{digest.hexdigest()[:12]}"

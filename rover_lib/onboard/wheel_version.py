"""The version of the rover's wheel: rover_lib's, and a hash of what is in the wheel.

Another content is another version, so that pip on the rover sees that there is something to install.
"""

import hashlib
import re
from pathlib import Path

ONBOARD = Path(__file__).parent
PACKAGE = ONBOARD.parent / "__init__.py"


def wheel_version() -> str:
    """Such as "0.1.0+0123456789ab". hatchling calls it when it builds the wheel, without importing rover_lib."""
    files = [p for p in ONBOARD.rglob("*") if p.is_file() and "__pycache__" not in p.parts]
    digest = hashlib.sha256()
    for path in sorted([PACKAGE, *files]):
        digest.update(f"{path.relative_to(PACKAGE.parent)}\0".encode() + path.read_bytes() + b"\0")
    version = re.search(r'^__version__ = "(.+)"$', PACKAGE.read_text(), re.MULTILINE)
    assert version, f"{PACKAGE} has no __version__"
    return f"{version[1]}+{digest.hexdigest()[:12]}"

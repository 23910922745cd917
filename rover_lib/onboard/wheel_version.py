"""The version of the rover's wheel: the release that this is, and a hash of what is in the wheel.

Another content is another version, so that pip on the rover sees that there is something to install.
"""

import hashlib
import re
import subprocess
from pathlib import Path

ONBOARD = Path(__file__).parent
PACKAGE = ONBOARD.parent / "__init__.py"
REPOSITORY = ONBOARD.parents[1]
UNTAGGED = "0.1.0"  # of a checkout without tags; pyproject.toml has the same for one without git


def release() -> str:
    """Such as "0.1.0": git's newest tag v0.1.0 before this commit, or UNTAGGED."""
    if not (REPOSITORY / ".git").exists():  # installed: a repository above it would be another project's
        return UNTAGGED
    command = ["git", "describe", "--tags", "--abbrev=0", "--match", "v[0-9]*"]
    try:
        found = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, timeout=5).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return UNTAGGED
    return found[1:] if re.fullmatch(r"v\d+\.\d+\.\d+", found) else UNTAGGED


def wheel_version() -> str:
    """Such as "0.1.0+0123456789ab". hatchling calls it when it builds the wheel, without importing rover_lib."""
    files = [p for p in ONBOARD.rglob("*") if p.is_file() and "__pycache__" not in p.parts]
    digest = hashlib.sha256()
    for path in sorted([PACKAGE, *files]):
        digest.update(f"{path.relative_to(PACKAGE.parent)}\0".encode() + path.read_bytes() + b"\0")
    return f"{release()}+{digest.hexdigest()[:12]}"

"""The site that `make docs` builds. A dead link ends the build, and no page loads anything from another site."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[1]
NOT_COPIED = (".*", "runs", "shared", "tests")
ELSEWHERE = re.compile(r"""<(?:script|img|iframe|link)\b[^>]*\b(?:src|href)=["'](?:https?:)?//[^>]*>""")


def test_nothing_is_fetched_from_elsewhere_and_no_machine_is_named(tmp_path):
    folder = tmp_path / "checkout"
    shutil.copytree(ROOT, folder, ignore=shutil.ignore_patterns(*NOT_COPIED))
    command = ["make", f"VENV={sys.prefix}", f"--old-file={sys.prefix}/.ready", "docs"]  # which is set up already
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    for page in (folder / "runs" / "site").rglob("*.html"):
        text = page.read_text()
        assert not ELSEWHERE.findall(text), page.name
        assert not re.search(r"/(?:home|root|tmp|Users|work|var|opt|mnt)/[^ ]*runs/", text), page.name

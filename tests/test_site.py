"""The site that `make docs` builds. A dead link ends the build, and no page loads anything from another site."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[1]
GATHERED = (
    "Makefile", "mkdocs.yml", "*.md", "docs", "pictures", "notebooks", "results", "params.yml", "lab/params.yml",
    "ansible/roles/rover/meta/argument_specs.yml",
)  # fmt: skip
PACKAGES = ("rover_lib", "balloon_world")  # docs/api.md is made of their docstrings
READMES = ("ansible/README.md", "firmware/README.md", "lab/README.md")
ELSEWHERE = re.compile(r"""<(?:script|img|iframe|link)\b[^>]*\b(?:src|href)=["'](?:https?:)?//[^>]*>""")


def gather(folder: Path) -> None:
    """Copy what `make docs` reads into a folder."""
    for path in (path for pattern in (*GATHERED, *READMES) for path in ROOT.glob(pattern)):
        target = folder / path.relative_to(ROOT)
        target.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            shutil.copytree(path, target, dirs_exist_ok=True)
        else:
            shutil.copy(path, target)
    for package in PACKAGES:
        (folder / package).symlink_to(ROOT / package)


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("checkout")
    gather(folder)
    command = ["make", f"VENV={sys.prefix}", f"--old-file={sys.prefix}/.ready", "docs"]  # which is set up already
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return folder / "runs" / "site"


def test_nothing_is_fetched_from_elsewhere_and_no_machine_is_named(site):
    for page in site.rglob("*.html"):
        text = page.read_text()
        assert not ELSEWHERE.findall(text), page.name
        assert not re.search(r"/(?:home|root|tmp|Users|work|var|opt|mnt)/[^ ]*runs/", text), page.name

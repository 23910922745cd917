"""The site that `make docs` builds. A dead link ends the build, and no page loads anything from another site."""

import asyncio
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from browser import Browser, chromium

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


def test_each_page_and_notebook_is_there(site):
    sources = [p for pattern in ("*.md", "docs/*.md", *READMES, "notebooks/*.ipynb") for p in ROOT.glob(pattern)]
    assert len(sources) > 15
    for source in sources:
        name = str(source.relative_to(ROOT).with_suffix(".html")).replace("README", "index")
        assert (site / name).is_file(), name


def test_nothing_is_fetched_from_elsewhere_and_no_machine_is_named(site):
    for page in site.rglob("*.html"):
        text = page.read_text()
        assert not ELSEWHERE.findall(text), page.name
        assert not re.search(r"/(?:home|root|tmp|Users|work|var|opt|mnt)/[^ ]*runs/", text), page.name


@chromium
def test_pages_fit_a_phone_and_search_works_from_the_disk(site, demo_run, tmp_path):
    """Nothing is cut off; and where one begins, in the report's verdict too, nothing needs to be pushed sideways."""
    whole = [site / f"{name}.html" for name in ("index", "docs/first_hour", "docs/tonight", "docs/build")]
    others = [site / f"{name}.html" for name in ("docs/api", "docs/safety", "notebooks/08_distill")]

    async def scene():
        async with Browser(tmp_path / "profile") as browser:
            tab = await browser.open("about:blank")
            await tab.be_a_phone()
            for page in [demo_run / "report.html", *others, *whole]:
                await tab.ask("Page.navigate", url=page.as_uri())
                await tab.until(f"location.pathname.endsWith('{page.name}') && document.readyState === 'complete'")
                found = await tab.sideways("body" if page.name == "report.html" else "article")
                assert not found["cut"], (page.name, found)
                assert page in others or not found["scrolls"], (page.name, found)
            await tab.value("document.querySelector('#__search').click()")
            ask = """(() => { const field = document.querySelector('.md-search__input'); field.value = 'balloon';
                field.dispatchEvent(new KeyboardEvent('keyup', {bubbles: true, key: 'n'}));
                return document.querySelectorAll('.md-search-result__item').length > 5; })()"""
            await tab.until(ask)

    asyncio.run(scene())

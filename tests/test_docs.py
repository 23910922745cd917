"""The pages: each is one click from README, no link is dead, and the doctor's names in them are the doctor's."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
OTHERS = [ROOT / "ansible" / "README.md", ROOT / "firmware" / "README.md"]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *OTHERS])
LINK = re.compile(r"\]\(([^)\s]+)\)")


def anchors(page):
    """Of its headings, as GitHub makes them."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(), re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", PAGES, ids=[str(p.relative_to(ROOT)) for p in PAGES])
def test_no_link_is_dead(page):
    for link in LINK.findall(page.read_text()):
        if link.startswith("http"):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        assert target.exists(), link
        assert not anchor or anchor in anchors(target), link


def test_every_page_is_one_click_from_readme():
    linked = {(ROOT / link).resolve() for link in LINK.findall((ROOT / "README.md").read_text()) if "://" not in link}
    assert {p.resolve() for p in (ROOT / "docs").glob("*.md")} <= linked


def test_troubleshooting_names_lines_that_the_doctor_has():
    symptoms = (ROOT / "docs" / "troubleshooting.md").read_text().partition("\n## ")[0]
    rows = re.findall(r"^\| .+? \| (.*?) \|", symptoms, re.M)
    named = {name for row in rows for name in re.findall(r"`([^`]+)`", row) if not name.startswith("rover ")}
    source = (ROOT / "rover_lib" / "onboard" / "doctor.py").read_text()
    assert len(named) > 10 and not [name for name in named if f'"{name}"' not in source]


def test_the_first_hour_is_eight_commands_at_most_that_there_are():
    from lab.__main__ import main as lab
    from rover_lib.cli import main as rover

    lines = re.findall(r"^    (\S.*?) +# (\d)\b", (ROOT / "docs" / "first_hour.md").read_text(), re.M)
    assert [int(number) for _, number in lines] == list(range(1, len(lines) + 1)) and 5 < len(lines) <= 8
    makefile = (ROOT / "Makefile").read_text()
    for line, _ in lines:
        program, *words = line.rpartition("&& ")[2].removeprefix("python -m ").split()
        if program in ("rover", "lab"):
            group = rover if program == "rover" else lab
            known = {option for p in group.commands[words[0]].params for option in p.opts}
            assert {word for word in words if word.startswith("--")} <= known, line
        elif program == "make":
            assert f"\n{words[0]}:" in makefile, line


def test_commands_in_the_pages_are_commands():
    from rover_lib.cli import main

    for page in PAGES:
        for command in re.findall(r"(?:`|^    |sudo )rover ([a-z][a-z-]*)", page.read_text(), re.M):
            assert command in main.commands, f"{page.name}: rover {command}"

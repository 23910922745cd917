"""The pages: each is one click from README, no link is dead, and the commands and options that they show exist."""

import re
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

ROOT = Path(__file__).parents[1]
OTHERS = [ROOT / folder / "README.md" for folder in ("ansible", "firmware", "lab")]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *OTHERS])
LINK = re.compile(r"\]\(([^)\s]+)\)")


def anchors(page):
    """Return the anchors of a page's headings, as GitHub makes them."""
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
    source = (ROOT / "rover_lib" / "onboard" / "care" / "doctor.py").read_text()
    assert len(named) > 10 and not [name for name in named if f'"{name}"' not in source]


def typed(page: Path) -> Iterator[list[str]]:
    """Yield the words of each command in a page's indented lines and between backticks, without `sudo` and comments."""
    text = page.read_text().replace("\\\n", " ")
    for code in re.findall(r"^    (\S.*)$", text, re.M) + re.findall(r"`([^`\n]+)`", text):
        for command in re.split(r"&&|[;|]", code.partition(" #")[0]):
            words = command.replace("python -m lab", "lab").split()
            yield words[1:] if words[:1] == ["sudo"] else words


def unknown_in(group: click.Command, words: list[str]) -> list[str]:
    """Return the command among these words, or else the options, that `group` does not have."""
    while isinstance(group, click.Group) and words and not words[0].startswith("-"):
        if words[0] not in group.commands:
            return words[:1]
        group, words = group.commands[words[0]], words[1:]
    known = {"--help", *(option for p in group.params for option in (*p.opts, *p.secondary_opts))}
    return [word for word in words if word.startswith("-") and word != "-" and word.partition("=")[0] not in known]


def test_commands_and_options_in_the_pages_are_there():
    from lab.__main__ import main as lab
    from rover_lib.cli import main as rover

    targets = set(" ".join(re.findall(r"^([a-z][a-z -]*):", (ROOT / "Makefile").read_text(), re.M)).split())
    seen = 0
    for page in PAGES:
        for program, *words in filter(None, typed(page)):
            program = program.rpartition("/")[2]
            if program in ("rover", "lab"):
                unknown = unknown_in(rover if program == "rover" else lab, words)
            elif program == "make":
                unknown = [word for word in words if re.fullmatch(r"[a-z][a-z-]*", word) and word not in targets]
            else:
                continue
            seen += 1
            assert not unknown, f"{page.name}: {program} {' '.join(words)}: {unknown}"
    assert seen > 200


def test_readme_says_how_to_begin_in_few_words():
    text = (ROOT / "README.md").read_text()
    first = [line.split("#")[0].split() for line in re.findall(r"^    (\S.*)$", text, re.M)[:3]]
    assert first == [["make", "demo"], ["make", "test"], ["make", "notebooks-open", "NAME=demo"]]
    assert len(text.split()) <= 700 and re.search(r"\[!\[.*\]\(pictures/\w+\.png\)\]\(notebooks/\w+\.ipynb\)", text)


def test_the_first_hour_is_eight_commands_at_most():
    lines = re.findall(r"^    \S.*? +# (\d)\b", (ROOT / "docs" / "first_hour.md").read_text(), re.M)
    assert [int(number) for number in lines] == list(range(1, len(lines) + 1)) and 5 < len(lines) <= 8

"""The pages: each is one click from README, no link is dead, and the commands and options that they show exist."""

import ast
import re
import shlex
from collections import Counter
from collections.abc import Iterator
from importlib.util import find_spec
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


SOURCES = [*ROOT.glob("rover_*/**/*.py"), *ROOT.glob("balloon_world/**/*.py"), *ROOT.glob("lerobot_robot_rover/*.py")]
PLAYS = [*ROOT.glob("ansible/**/*.yml"), *ROOT.glob("ansible/**/*.j2")]
# An option alone: code of a page, or behind a word of a remedy.
ALONE = re.compile(r"^`(--[a-z][a-z-]+)(?=[ `=])|(?:: |or |and |by |with |\()(--[a-z][a-z-]+)(?=[ ,;)]|$)")
OF_OTHERS = {"--ask-become-pass", "--check", "--limit", "--resume"}  # Ansible's, and lerobot-train's
PROGRAM = r"rover|lab|make|ansible-playbook|lerobot-[a-z-]+|python -m [\w.]+"


def texts(path: Path) -> Iterator[str]:
    """Yield what a file shows people: a page's lines of code, a program's texts, each with X for what is filled in."""
    if path.suffix != ".py":
        text = path.read_text().partition("## What left")[0].replace("\\\n", " ")
        yield from re.findall(r"^    (\S.*)$", text, re.M) if path in PAGES else ()
        yield from (f"`{code}`" for code in re.findall(r"[`']([^`'\n]+)[`'](?! there)", text))
        return
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.JoinedStr):
            yield "".join(str(part.value) if isinstance(part, ast.Constant) else "X" for part in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def commands(path: Path) -> Iterator[tuple[str, list[str], bool]]:
    """Yield (program, its words, whether it is a whole command) for each command that a file shows.

    One in the middle of a sentence ends anywhere: only its first word and its options can be checked.
    """
    for text in texts(path):
        for match in re.finditer(rf"(?:^|(?<=[`'\s(/]))({PROGRAM}) +(--?\w|[a-zX][\w./X-]*)?([^`'\n;|&]*)", text):
            start = text[: match.start()].rstrip()
            whole = start.endswith(("`", "'", ".venv/bin/", "&&", "sudo")) or (path in PAGES and not start)
            rest = (match[2] or "") + match[3].partition(" #")[0]
            yield match[1], rest.split() if '"' in rest or "{" in rest else shlex.split(rest, posix=True), whole


def refusal_of(group: click.Command, words: list[str], whole: bool) -> str:
    """Say why click would refuse the words; "" if it would not. Behind a command that is not whole, words are prose."""
    while isinstance(group, click.Group):
        if not words or words[0].startswith("-") or words[0] == "X":
            words = [w for w in words if w.startswith("--")]
            break
        if words[0] not in group.commands:
            return f"no command {words[0]}" if whole and not words[0].endswith(":") else ""
        group, words = group.commands[words[0]], words[1:]
    words = [word.rstrip(".,:)") for word in words]
    known = {"--help": 0, **{o: int(not getattr(p, "is_flag", False)) for p in group.params for o in p.opts}}
    known |= {option: 0 for p in group.params for option in p.secondary_opts}
    for i, word in enumerate(words):
        name, _, value = word.partition("=")
        if not re.fullmatch(r"--?[a-z][a-z-]*", name):
            continue
        if name not in known:
            return f"no option {name}"
        param = next((p for p in group.params if name in p.opts), None)
        value = value or (words[i + 1] if i + 1 < len(words) else "")
        if whole and known[name] and isinstance(param.type, click.Choice | click.IntRange | click.FloatRange):
            if not value or value.isupper():
                continue
            try:
                param.type.convert(value, param, None)
            except click.UsageError as error:
                return str(error)
    return ""


def options_of(group: click.Command) -> set[str]:
    own = {option for p in group.params for option in (*p.opts, *p.secondary_opts)}
    return own.union(*map(options_of, group.commands.values())) if isinstance(group, click.Group) else own


def refusal_of_make(words: list[str]) -> str:
    """Say which target our Makefile lacks; another Makefile's (make -C) are not looked at."""
    if "-C" in words:
        return ""
    targets = set(" ".join(re.findall(r"^([a-z][a-z -]*):", (ROOT / "Makefile").read_text(), re.M)).split())
    return ", ".join(word for word in words if re.fullmatch(r"[a-z][a-z-]+", word) and word not in targets)


def refusal_of_playbook(words: list[str]) -> str:
    specs = (ROOT / "ansible/roles/rover/meta/argument_specs.yml").read_text()
    variables = {*re.findall(r"^ +(\w+):", specs, re.M), "ansible_user", "ansible_host", "X"}
    variables.add("ansible_ssh_private_key_file")
    plays = [word for word in words if word.endswith(".yml") and "X" not in word]
    wrong = [play for play in plays if not (ROOT / play).is_file()]
    return ", ".join(wrong + sorted(set(re.findall(r"-e [\"']?(?:{\\?\")?(\w+)", " ".join(words))) - variables))


@pytest.mark.slow
def test_every_command_that_we_print_is_one():
    """All that the pages, the program and its playbooks show, by the parser of the program that is named."""
    from lab.__main__ import main as lab
    from rover_lib.cli import main as rover

    groups = {"rover": rover, "lab": lab, "python -m lab": lab}
    options = options_of(rover) | options_of(lab) | OF_OTHERS
    seen: Counter[str] = Counter()
    refused = []
    pages = [page for page in PAGES if page.name != "CHANGELOG.md"]
    for path in [*pages, *SOURCES, *PLAYS, *ROOT.glob("notebooks/*.ipynb")]:
        for match in (match for text in texts(path) if path not in PLAYS for match in ALONE.finditer(text)):
            seen["option"] += 1
            if (option := match[1] or match[2]) not in options:
                refused.append(f"{path.relative_to(ROOT)}: no command has {option}")
        for program, words, whole in commands(path):
            wrong = ""
            if program in groups:
                wrong = refusal_of(groups[program], words, whole)
            elif program == "make" and whole:
                wrong = refusal_of_make(words)
            elif program == "ansible-playbook":
                wrong = refusal_of_playbook(words)
            elif program.startswith("python -m"):
                wrong = "" if find_spec(program.split()[2]) else "no such module"
            seen[program.partition("-")[0].partition(" ")[0]] += 1
            if wrong:
                refused.append(f"{path.relative_to(ROOT)}: {program} {' '.join(words)}: {wrong}")
    assert not refused, "\n".join(refused)
    assert all(seen[name] > 8 for name in ("rover", "make", "ansible", "option")), seen


def test_the_pages_are_short():
    """A page that grows must take something out of another."""
    pages = [*(ROOT / "docs").glob("*.md"), ROOT / "ansible" / "README.md"]
    assert sum(len(page.read_text().split()) for page in pages) <= 11_000

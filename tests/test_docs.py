"""The pages: each is one click from README, no link is dead, and the commands and options that they show exist."""

import ast
import re
import shlex
from collections import Counter
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import click
import pytest
import yaml

ROOT = Path(__file__).parents[1]
OTHERS = [ROOT / folder / "README.md" for folder in ("ansible", "firmware", "lab")]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *OTHERS])
LINK = re.compile(r"\]\(([^)\s]+)\)")


def anchors(page):
    """Return the anchors of a page's headings, as GitHub makes them."""
    titles = re.findall(r"^#+ (.+)$", page.read_text(), re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def test_no_link_is_dead_and_every_page_is_one_click_from_readme():
    dead = []
    for page in PAGES:
        for link in (link for link in LINK.findall(page.read_text()) if not link.startswith("http")):
            path, _, anchor = link.partition("#")
            target = (page.parent / path).resolve() if path else page
            if not target.exists() or (anchor and anchor not in anchors(target)):
                dead.append(f"{page.relative_to(ROOT)}: {link}")
    assert not dead
    linked = {(ROOT / link).resolve() for link in LINK.findall((ROOT / "README.md").read_text()) if "://" not in link}
    assert {p.resolve() for p in (ROOT / "docs").glob("*.md")} <= linked


SOURCES = [*ROOT.glob("rover_*/**/*.py"), *ROOT.glob("balloon_world/**/*.py"), *ROOT.glob("lerobot_robot_rover/*.py")]
PLAYS = [*ROOT.glob("ansible/**/*.yml"), *ROOT.glob("ansible/**/*.j2")]
# An option alone: code of a page, or behind a word of a remedy.
ALONE = re.compile(r"^`(--[a-z][a-z-]+)(?=[ `=])|(?:: |or |and |by |with |\()(--[a-z][a-z-]+)(?=[ ,;)]|$)")
OF_OTHERS = {"--ask-become-pass", "--check", "--limit", "--resume"}  # Ansible's, and lerobot-train's
PROGRAM = r"rover|lab|make|ansible-playbook|lerobot-[a-z-]+|python3? -m [\w.]+"
PARSED_ELSEWHERE = r"lerobot-[a-z-]+|python3 compile\.py hailo8|look/bin/pip|rover/bin/pip|python3 -m venv"
OF_SYSTEM = r"ssh|scp|sudo|cp|hf|dask|pip|\.|\$EDITOR"
NO_COMMAND = r"\S+[:/](?: |$)|\S+\.\w+ |\w+ = |from "  # a line of YAML, a file in a tree, Python


def texts(path: Path) -> Iterator[str]:
    """Yield what a file shows people: a page's lines of code, a program's texts, each with X for what is filled in."""
    if path.suffix != ".py":
        text = path.read_text().partition("## What left")[0].replace("\\\n", " ")
        yield from re.findall(r"^    +(\S.*)$", text, re.M) if path in PAGES else ()
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
        for match in re.finditer(rf"(?:^|(?<=[`'\s(/]))({PROGRAM})(?: +|$)(--?\w|[a-zX][\w./X-]*)?([^`'\n;|&]*)", text):
            start = text[: match.start()].rstrip()
            whole = start.endswith(("`", "'", "bin/", "&&", "sudo")) or (path in PAGES and not start)
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
    options = {name: p for p in group.params for name in (*p.opts, *p.secondary_opts) if name.startswith("-")}
    for i, word in enumerate(words):
        name, _, value = word.partition("=")
        if not re.fullmatch(r"--?[a-z][a-z-]*", name) or name == "--help":
            continue
        if name not in options:
            return f"no option {name}"
        value = value or (words[i + 1] if i + 1 < len(words) else "")
        if not whole or getattr(options[name], "is_flag", False) or not value or value.isupper():
            continue
        if isinstance(options[name].type, click.Choice | click.IntRange | click.FloatRange):
            try:
                options[name].type.convert(value, options[name], None)
            except click.UsageError as error:
                return str(error)
    return ""


def options_of(group: click.Command) -> set[str]:
    own = {option for p in group.params for option in (*p.opts, *p.secondary_opts)}
    return own.union(*map(options_of, group.commands.values())) if isinstance(group, click.Group) else own


def refusal_of_make(words: list[str]) -> str:
    """Say which target the Makefile lacks, or that of a folder (make -C)."""
    folder, words = (words[1], words[2:]) if words[:1] == ["-C"] else (".", words)
    targets = re.findall(r"^([a-z][a-z -]*):", (ROOT / folder / "Makefile").read_text(), re.M)
    known = {word for target in targets for word in target.split()}
    return ", ".join(word for word in words if re.fullmatch(r"[a-z][a-z-]+", word) and word not in known)


def refusal_of_playbook(words: list[str]) -> str:
    specs = (ROOT / "ansible/roles/rover/meta/argument_specs.yml").read_text()
    ansibles = {"ansible_user", "ansible_host", "ansible_ssh_private_key_file"}
    variables = {*re.findall(r"^ +(\w+):", specs, re.M), *ansibles, "X"}
    plays = [word for word in words if word.endswith(".yml") and "X" not in word]
    wrong = [play for play in plays if not (ROOT / play).is_file()]
    return ", ".join(wrong + sorted(set(re.findall(r"-e [\"']?(?:{\\?\")?(\w+)", " ".join(words))) - variables))


def test_every_block_of_code_is_parsed():
    """A line is a command that the test below parses, or another knows; a block in a fence is Python or YAML."""
    known = re.compile(rf"(?:\S*bin/)?(?:{PROGRAM}|{PARSED_ELSEWHERE}|{OF_SYSTEM})(?: |$)|{NO_COMMAND}")
    for page in PAGES:
        text = page.read_text().replace("\\\n", " ")
        for language, block in re.findall(r"^```(\w+)\n(.*?)^```", text, re.M | re.S):
            if language == "yaml":
                assert yaml.safe_load(block), page
            for node in ast.walk(ast.parse(block)) if language == "python" else ():
                for name in node.names if isinstance(node, ast.ImportFrom) else ():
                    assert hasattr(import_module(node.module), name.name) or find_spec(f"{node.module}.{name.name}")
        for line in re.findall(r"^    +(\S.*)$", re.sub(r"^```.*?^```", "", text, flags=re.M | re.S), re.M):
            assert known.match(line), (page, line)


@pytest.mark.slow
def test_every_command_that_we_print_is_one():
    """All that the pages, the program and its playbooks show, by the parser of the program that is named."""
    from lab.__main__ import main as lab
    from lerobot_robot_rover.__main__ import main as pack
    from rover_lib.cli import main as rover

    groups = {"rover": rover, "rover_lib.cli": rover, "lab": lab, "lerobot_robot_rover": pack}
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
            wrong, name = "", program.partition("-m ")[2] or program
            if name in groups:
                wrong = refusal_of(groups[name], words, whole)
            elif program == "make" and whole:
                wrong = refusal_of_make(words)
            elif program == "ansible-playbook":
                wrong = refusal_of_playbook(words)
            elif name != program:
                wrong = "" if find_spec(name) else "no such module"
            seen[program.partition("-")[0].partition(" ")[0]] += 1
            if wrong:
                refused.append(f"{path.relative_to(ROOT)}: {program} {' '.join(words)}: {wrong}")
    assert not refused, "\n".join(refused)
    assert all(seen[name] > 8 for name in ("rover", "make", "ansible", "option", "python")), seen


def test_the_pages_are_short():
    """A page that grows must take something out of another."""
    pages = [*(ROOT / "docs").glob("*.md"), ROOT / "ansible" / "README.md"]
    assert sum(len(page.read_text().split()) for page in pages) <= 11_000

"""The pages: each is one click from README, and the commands and options that they show exist."""

import ast
import re
import shlex
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import click
import pytest
import yaml

from rover_lib.workshop.run import run

ROOT = Path(__file__).parents[1]
OTHERS = [ROOT / folder / "README.md" for folder in ("ansible", "firmware", "lab")]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md"), *OTHERS])
LINK = re.compile(r"\]\(([^)\s]+)\)")


def test_every_page_is_one_click_from_readme():
    """Dead links end the build of the site."""
    linked = {(ROOT / link).resolve() for link in LINK.findall((ROOT / "README.md").read_text()) if "://" not in link}
    assert {p.resolve() for p in (ROOT / "docs").glob("*.md")} <= linked


SOURCES = [*ROOT.glob("rover_*/**/*.py"), *ROOT.glob("balloon_world/**/*.py"), *ROOT.glob("lerobot_robot_rover/*.py")]
PLAYS = [*ROOT.glob("ansible/**/*.yml"), *ROOT.glob("ansible/**/*.j2")]
FORMS = [*ROOT.glob(".github/*"), *ROOT.glob(".github/*/*.yml")]
FORMS = [path for path in FORMS if path.is_file()]
PROGRAM = r"rover|lab|make|ansible-playbook|lerobot-[a-z-]+|python3? -m [\w.]+"


def texts(path: Path) -> Iterator[str]:
    """Yield what a file shows people: a page's lines of code, a program's texts, each with X for what is filled in."""
    if path.suffix != ".py":
        text = path.read_text().replace("\\\n", " ")
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
    """Say which command or option there is not; "" if all are. Behind a command that is not whole, words are prose."""
    while isinstance(group, click.Group) and words and not words[0].startswith("-") and words[0] != "X":
        if words[0] not in group.commands:
            return f"no command {words[0]}" if whole and not words[0].endswith(":") else ""
        group, words = group.commands[words[0]], words[1:]
    known = {option for p in group.params for option in (*p.opts, *p.secondary_opts)} | {"--help"}
    options = (word.partition("=")[0].rstrip(".,:)") for word in words)
    return ", ".join(o for o in options if re.fullmatch(r"--?[a-z][a-z-]*", o) and o not in known)


def refusal_of_make(words: list[str]) -> str:
    """Say which target the Makefile lacks, or that of a folder (make -C)."""
    folder, words = (words[1], words[2:]) if words[:1] == ["-C"] else (".", words)
    targets = re.findall(r"^([a-z][a-z -]*):", (ROOT / folder / "Makefile").read_text(), re.M)
    known = {word for target in targets for word in target.split()}
    return ", ".join(word for word in words if re.fullmatch(r"[a-z][a-z-]+", word) and word not in known)


def refusal_of_playbook(words: list[str]) -> str:
    specs = (ROOT / "ansible/roles/rover/meta/argument_specs.yml").read_text()
    ansibles = {"ansible_user", "ansible_host", "ansible_ssh_private_key_file", "minutes"}
    variables = {*re.findall(r"^ +(\w+):", specs, re.M), *ansibles, "X"}
    plays = [word for word in words if word.endswith(".yml") and "X" not in word]
    wrong = [play for play in plays if not (ROOT / play).is_file()]
    return ", ".join(wrong + sorted(set(re.findall(r"-e [\"']?(?:{\\?\")?(\w+)", " ".join(words))) - variables))


def test_every_block_of_code_is_parsed():
    """A block in a fence is Python, whose imports exist, or YAML."""
    for page in PAGES:
        for language, block in re.findall(r"^```(\w+)\n(.*?)^```", page.read_text(), re.M | re.S):
            if language == "yaml":
                assert yaml.safe_load(block), page
            for node in ast.walk(ast.parse(block)) if language == "python" else ():
                for name in node.names if isinstance(node, ast.ImportFrom) else ():
                    assert hasattr(import_module(node.module), name.name) or find_spec(f"{node.module}.{name.name}")


@pytest.mark.slow
def test_the_examples_of_the_api_run(demo_run, tmp_path, monkeypatch):
    """All but the notebooks: tests/notebooks has these."""
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "demo").symlink_to(demo_run)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(run, "_execute", lambda source, folder, *how: shutil.copy(source, folder))
    exec("".join(re.findall(r"^```python\n(.*?)^```", (ROOT / "docs" / "api.md").read_text(), re.M | re.S)), {})


@pytest.mark.slow
def test_every_command_that_we_print_is_one():
    """All that the pages, the program and its playbooks show, by the parser of the program that is named."""
    from lab.__main__ import main as lab
    from lerobot_robot_rover.__main__ import main as pack
    from rover_lib.cli import main as rover

    groups = {"rover": rover, "rover_lib.cli": rover, "lab": lab, "lerobot_robot_rover": pack}
    seen: Counter[str] = Counter()
    refused = []
    pages = [page for page in PAGES if page.name != "CHANGELOG.md"]
    for path in [*pages, *SOURCES, *PLAYS, *FORMS, *ROOT.glob("notebooks/*.ipynb")]:
        for program, words, whole in commands(path):
            wrong, name = "", program.partition("-m ")[2] or program
            if name == "rover" and words[:1] == ["playbook"]:
                wrong = refusal_of_playbook([f"ansible/{words[1]}.yml", *words[2:]] if words[1:] else [])
            elif name in groups:
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
    assert all(seen[name] > 8 for name in ("rover", "make", "python")), seen


QUOTED = re.compile(r"quote\(|command_line\(|typed\(|lerobot_(train|video)\(")


def test_a_name_in_a_printed_command_is_quoted():
    """A folder with a space in its name would be two words, wherever a program puts names into a command."""
    from rover_lib.cli import main

    begins = rf"(?:rover (?:{'|'.join(main.commands)})|make -C|make [a-z]+|lerobot-[a-z-]+|hf download) "
    bare = []
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.JoinedStr):
                continue
            text = ""
            for part in node.values:
                text += part.value if isinstance(part, ast.Constant) else "{" + ast.unparse(part.value) + "}"
            for command in re.findall(rf"(?:^|[`(:' ])({begins}[^`\n;]*)", text):
                names = re.findall(r"\{(.*?)\}(?= |$|/)", command)
                bare += [f"{path.name}: {command}" for name in names if not QUOTED.search(name)]
    assert bare == []


def test_workflows_name_files_that_exist():
    workflows = "".join(path.read_text() for path in FORMS if path.parent.name == "workflows")
    files = re.findall(r"tests/[\w/]+\.py|rover_lib/[\w/]+\.py|\.ci/run", workflows)
    assert files and all((ROOT / file).is_file() for file in files)


def test_the_pages_are_short():
    """A page that grows must take something out of another."""
    pages = [*(ROOT / "docs").glob("*.md"), ROOT / "ansible" / "README.md"]
    assert sum(len(page.read_text().split()) for page in pages) <= 11_000


NOT_COPIED = (".*", "runs", "shared", "tests")
ELSEWHERE = re.compile(r"""<(?:script|img|iframe|link)\b[^>]*\b(?:src|href)=["'](?:https?:)?//[^>]*>""")


@pytest.mark.slow
def test_the_site_fetches_nothing_from_elsewhere_and_names_no_machine(tmp_path):
    """The site that `make docs` builds; a dead link ends the build."""
    folder = tmp_path / "checkout"
    shutil.copytree(ROOT, folder, ignore=shutil.ignore_patterns(*NOT_COPIED))
    command = ["make", f"VENV={sys.prefix}", f"--old-file={sys.prefix}/.ready", "docs"]  # which is set up already
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    for page in (folder / "runs" / "site").rglob("*.html"):
        text = page.read_text()
        assert not ELSEWHERE.findall(text), page.name
        assert not re.search(r"/(?:home|root|tmp|Users|work|var|opt|mnt)/[^ ]*runs/", text), page.name

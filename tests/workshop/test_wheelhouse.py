"""The Pi's wheels: the rover's own with what drives and nothing else, the others as they are pinned."""

import re
import shutil
import tomllib
import zipfile
from pathlib import Path

import pytest

from rover_lib.onboard import wheel_version as v
from rover_lib.workshop import wheelhouse as w

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def own(tmp_path_factory) -> w.Wheelhouse:
    return w.make(tmp_path_factory.mktemp("wheels"), only_rover=True)


WHEELS = r"rover_lib/(__init__\.py|LICENSE|(onboard/)?py\.typed|onboard/(\w+/)?\w+\.(py|yml|json|toml|html))"


def test_the_own_wheel_has_what_drives_and_nothing_else(own):
    with zipfile.ZipFile(own.wheel) as wheel:
        files = {n for n in wheel.namelist() if not n.startswith("rover_policy-")}
        (scripts,) = (n for n in wheel.namelist() if n.endswith("entry_points.txt"))
        assert "rover = rover_lib.onboard.cli:main" in wheel.read(scripts).decode()
    assert {"rover_lib/__init__.py", "rover_lib/onboard/cli.py", "rover_lib/onboard/params.yml"} <= files
    assert [n for n in files if not re.fullmatch(WHEELS, n)] == []


def test_a_second_time_changes_nothing_and_the_same_files_make_the_same_bytes(own, tmp_path):
    assert own.changed
    assert w.make(own.wheel.parent, only_rover=True) == w.Wheelhouse(own.wheel, own.version, False)
    (tmp_path / "rover_policy-0.0.1-py3-none-any.whl").touch()
    again = w.make(tmp_path, only_rover=True)
    assert again.changed and [p.name for p in tmp_path.iterdir()] == [own.wheel.name]
    assert again.wheel.read_bytes() == own.wheel.read_bytes()


def test_another_content_is_another_version(own, monkeypatch, tmp_path):
    shutil.copytree(v.ONBOARD, tmp_path / "onboard", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(v.PACKAGE, tmp_path)
    monkeypatch.setattr(v, "ONBOARD", tmp_path / "onboard")
    monkeypatch.setattr(v, "PACKAGE", tmp_path / "__init__.py")
    assert v.wheel_version() == own.version and re.fullmatch(r"\d+\.\d+\.\d+\+[0-9a-f]{12}", own.version)
    for name in ("__init__.py", "onboard/drive/drive.py", "onboard/params.yml", "onboard/pyproject.toml"):
        before = v.wheel_version()
        with (tmp_path / name).open("a") as f:
            f.write("# another\n")
        assert v.wheel_version() != before, name


def test_the_rover_needs_the_same_on_both_sides():
    whole, onboard = (tomllib.loads((p / "pyproject.toml").read_text())["project"] for p in (ROOT, v.ONBOARD))
    assert whole["dependencies"] == onboard["dependencies"]
    ours, theirs = whole["optional-dependencies"], onboard["optional-dependencies"]
    assert theirs["view"] == ours["view"] and re.search(r"^aiohttp==", w.VIEW.read_text(), re.MULTILINE)
    assert ours["torch"] == theirs["torch"] and set(ours["torch"]) < set(ours["workshop"])
    pinned = set(re.findall(r"^([\w-]+)==", w.REQUIREMENTS["torch"].read_text(), re.MULTILINE))
    assert {re.split(r"[=<>]", line)[0] for line in onboard["dependencies"] + theirs["torch"]} <= pinned


def test_the_others_come_by_hash_for_each_python_and_aarch64(tmp_path, monkeypatch):
    asked = []

    def run(*command, **options):
        asked.append((list(map(str, command)), Path(str(command[-1])).read_text()))

    monkeypatch.setattr(w, "_build", lambda folder: (folder / "own.whl", "1"))
    monkeypatch.setattr(w, "run", run)
    w.make(tmp_path)
    assert [a[a.index("--python-version") + 1] for a, _ in asked] == ["3.11", "3.11", "3.13", "3.13"]
    assert all("aiohttp==" in listed and "--hash=sha256:" in listed for _, listed in asked[1::2])
    for arguments, listed in asked[::2]:
        assert {"--require-hashes", "--only-binary", "manylinux_2_28_aarch64"} <= set(arguments)
        assert "python_full_version" not in listed and "setuptools==" in listed and "torch==2.8.0" in listed
        assert listed.count("--hash=sha256:") == w.REQUIREMENTS["torch"].read_text().count("--hash=sha256:")

"""The Pi's wheels: rover_lib's own with what drives and nothing else, the others as they are pinned."""

import re
import zipfile
from pathlib import Path

import pytest

from rover_lib.workshop import wheelhouse as w


@pytest.fixture(scope="module")
def own(tmp_path_factory) -> w.Wheelhouse:
    return w.make(tmp_path_factory.mktemp("wheels"), only_rover=True)


def test_the_own_wheel_has_what_drives_and_nothing_else(own):
    names = zipfile.ZipFile(own.wheel).namelist()
    code = {n for n in names if not n.startswith("rover_policy-")}
    assert {"rover_lib/cli.py", "rover_lib/__init__.py", "rover_lib/onboard/drive.py"} <= code
    assert all(re.fullmatch(r"rover_lib/(__init__|cli|onboard/\w+)\.py", n) for n in code), code
    scripts = next(n for n in names if n.endswith("entry_points.txt"))
    assert "rover = rover_lib.cli:main" in zipfile.ZipFile(own.wheel).read(scripts).decode()


def test_a_second_time_changes_nothing_and_other_sources_are_another_version(own, monkeypatch, tmp_path):
    assert own.changed
    again = w.make(own.wheel.parent, only_rover=True)
    assert again == w.Wheelhouse(own.wheel, own.version, False)
    changed = tmp_path / "rover_lib" / "cli.py"
    changed.parent.mkdir()
    changed.write_text("x = 1\n")
    monkeypatch.setattr(w, "sources", lambda: [changed])
    (tmp_path / "pyproject.toml").write_text((w.REPOSITORY / "pyproject.toml").read_text())
    monkeypatch.setattr(w, "REPOSITORY", tmp_path)
    assert w.own_version() != own.version and re.fullmatch(r"\d+\.\d+\.\d+\+[0-9a-f]{12}", w.own_version())


def test_the_others_come_by_hash_for_each_python_and_aarch64(tmp_path, monkeypatch):
    asked = []

    def pip(arguments, what, **environment):
        listed = Path(str(arguments[-1])).read_text() if "download" in arguments else ""
        asked.append((list(map(str, arguments)), listed))

    monkeypatch.setattr(w, "_own", lambda folder: (folder / "own.whl", "1"))
    monkeypatch.setattr(w, "_pip", pip)
    w.make(tmp_path, pythons=("3.11", "3.13"))
    assert [a[a.index("--python-version") + 1] for a, _ in asked] == ["3.11", "3.13"]
    for arguments, listed in asked:
        assert {"--require-hashes", "--only-binary", "manylinux2014_aarch64", "manylinux_2_28_aarch64"} <= set(
            arguments
        )
        assert "python_full_version" not in listed and "setuptools==" in listed and "torch==2.8.0" in listed
        pinned = (w.REPOSITORY / w.REQUIREMENTS).read_text()
        assert listed.count("--hash=sha256:") == pinned.count("--hash=sha256:")


def test_no_internet_ends_in_a_sentence(tmp_path, monkeypatch):
    monkeypatch.setenv("PIP_INDEX_URL", "http://127.0.0.1:9/")
    monkeypatch.setenv("PIP_RETRIES", "0")
    monkeypatch.setattr(w, "_own", lambda folder: (folder / "own.whl", "1"))
    monkeypatch.setattr(w, "REQUIREMENTS", "requirements_pi.txt")
    for name in ("PIP_EXTRA_INDEX_URL", "PIP_FIND_LINKS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PIP_CONFIG_FILE", "/dev/null")
    with pytest.raises(w.WheelhouseError, match=r"pip cannot make or fetch the wheels of .* is there internet here\?"):
        w.make(tmp_path, pythons=("3.13",))

"""Two commands that make the same thing at once do not disturb each other."""

import contextlib
import subprocess
import sys
from pathlib import Path

import pytest

from rover_lib.onboard.errors import RoverError
from rover_lib.workshop import swap_folder as alone
from rover_lib.workshop.run.run_folder import run_folder
from rover_lib.workshop.swap_folder import build_beside, lock_folder


def test_while_one_is_in_it_another_is_refused(tmp_path):
    with lock_folder(tmp_path / ".mine.new") as folder:
        (folder / "made").write_text("half")
        with pytest.raises(RoverError, match="another process is at work in it; wait for it"), lock_folder(folder):
            pass
        assert (folder / "made").read_text() == "half"
    assert not list(tmp_path.iterdir())
    with lock_folder(tmp_path / ".mine.new") as folder:
        assert not list(folder.iterdir())


@pytest.mark.parametrize(
    ("asked", "then", "kept"),
    [
        ("", "", set()),
        ("", "this", set()),
        ("this", "other", set()),
        ("this", "", set()),
        ("this", "this", {"sub", "link"}),
    ],
)
def test_what_a_killed_process_left_goes_first_unless_the_same_is_asked(tmp_path, asked, then, kept):
    lines = (
        "import os, sys, pathlib", "from rover_lib.workshop.swap_folder import lock_folder",
        "with lock_folder(pathlib.Path(sys.argv[1]), sys.argv[2]) as folder:", "    (folder / 'sub').mkdir()",
        "    (folder / 'link').symlink_to('/nowhere')", "    (folder / '.half').touch()",
        "    os.kill(os.getpid(), 9)",
    )  # fmt: skip
    new = tmp_path / ".mine.new"
    assert subprocess.run([sys.executable, "-c", "\n".join(lines), new, asked]).returncode == -9
    assert {p.name for p in new.iterdir()} >= {"sub", "link", ".half"}
    with lock_folder(new, then) as folder:
        assert {p.name for p in folder.iterdir()} - {alone.ASKED} == kept
        (folder / alone.ASKED).unlink(missing_ok=True)
    assert not new.exists()


def test_a_folder_that_vanishes_while_it_is_taken_is_made_again(tmp_path, monkeypatch):
    """This happens when the other command ends: the folder that we locked is no longer the one at that path."""
    real, left = alone.fcntl.flock, [1]

    def locked(*args):
        if left:
            left.pop()
            (tmp_path / ".mine.new").rmdir()
        real(*args)

    monkeypatch.setattr(alone.fcntl, "flock", locked)
    with lock_folder(tmp_path / ".mine.new") as folder:
        assert folder.is_dir()
        with pytest.raises(RoverError), lock_folder(folder):
            pass


def test_a_file_in_the_runs_place_is_refused_before_any_work(tmp_path):
    (tmp_path / "mine").write_text("a user's")
    with pytest.raises(RoverError, match="is a file, and not a run's folder"):
        run_folder(tmp_path, "mine", RoverError)
    assert [p.name for p in tmp_path.iterdir()] == ["mine"]


def test_a_run_that_is_a_link_is_made_where_the_link_leads(tmp_path):
    """The link may lie on another disk than the run, and nothing can be renamed from one disk to another."""
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "mine").symlink_to("../disk/large")
    for _ in ("not there yet", "there"):
        with build_beside(run_folder(tmp_path / "runs", "mine", RoverError)) as new:
            assert new.parent == tmp_path / "disk"
            (new / "last.json").touch()
    assert [p.name for p in (tmp_path / "runs" / "mine").iterdir()] == ["last.json"]


# ---- taking the place of what was there ------------------------------------------------------------------------------


def whole(folder):
    return {str(p.relative_to(folder)): p.read_text() for p in folder.rglob("*") if p.is_file()}


def write(folder, *names, text):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def make(folder):
    """Make a run that replaces a file by a folder and a folder by a file, adds one, and leaves no report.html."""
    with build_beside(folder, lambda folder: [folder / "report.html", folder / "figures"]) as new:
        write(new, "figures/one", "pretrained_model/config.json", "policy_mixed.pt", "fast.json", text="new")


NEW = dict.fromkeys(("figures/one", "pretrained_model/config.json", "policy_mixed.pt", "fast.json"), "new")
NEW |= {"users/frame.jpg": "old"}


@pytest.fixture
def before(tmp_path):
    write(
        tmp_path / "mine",
        *("figures/one", "figures/two", "pretrained_model", "report.html", "fast.json/one", "users/frame.jpg"),
        text="old",
    )
    return whole(tmp_path / "mine")


def test_what_is_made_beside_takes_its_place(tmp_path, before):
    make(tmp_path / "mine")
    assert whole(tmp_path / "mine") == NEW and [p.name for p in tmp_path.iterdir()] == ["mine"]


@pytest.mark.parametrize("count", range(10))
def test_an_interrupt_or_a_kill_while_it_takes_its_place_costs_nothing(tmp_path, before, monkeypatch, count):
    """A student's files were once mixed with its predecessor's, and nobody could tell which were whose."""
    rename, moved = Path.rename, []

    def ends(path, target):
        moved.append(path)
        if len(moved) == count + 1:
            raise KeyboardInterrupt
        return rename(path, target)

    as_it_was = {f"mine/{name}": text for name, text in before.items()}
    for killed in (False, True):
        moved.clear()
        with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
            patch.setattr(Path, "rename", ends)
            if killed:  # a killed process puts nothing back
                patch.setattr(alone, "_put_back", lambda *_: None)
            make(tmp_path / "mine")
        if killed:
            with contextlib.suppress(RuntimeError), build_beside(tmp_path / "mine"):
                raise RuntimeError  # the next process puts it back, even if it fails itself
        assert whole(tmp_path) == as_it_was
    make(tmp_path / "mine")
    assert whole(tmp_path / "mine") == NEW


def test_where_nothing_was_it_appears_at_once(tmp_path, monkeypatch):
    """When it was interrupted between two files, it once left a half that the next command took for the whole."""
    rename, seen = Path.rename, []

    def observed(path, target):
        seen.append((tmp_path / "mine").exists())
        rename(path, target)
        seen.append(len(whole(tmp_path / "mine")))

    monkeypatch.setattr(Path, "rename", observed)
    make(tmp_path / "mine")
    assert seen == [False, 4]

"""Two commands that make the same thing at once do not take it from each other."""

import subprocess
import sys

import pytest

from rover_lib.onboard.errors import RoverError
from rover_lib.workshop import alone
from rover_lib.workshop.alone import alone_in
from rover_lib.workshop.checkpoint_files import made_beside, take_place
from rover_lib.workshop.run_folder import run_folder


def test_while_one_is_in_it_another_is_refused(tmp_path):
    with alone_in(tmp_path / ".mine.new") as folder:
        (folder / "made").write_text("half")
        with pytest.raises(RoverError, match="another process is at work in it; wait for it"), alone_in(folder):
            pass
        assert (folder / "made").read_text() == "half"
    assert not list(tmp_path.iterdir())
    with alone_in(tmp_path / ".mine.new") as folder:
        assert not list(folder.iterdir())


def test_what_a_killed_process_left_goes_first(tmp_path):
    lines = (
        "import os, sys, pathlib",
        "from rover_lib.workshop.alone import alone_in",
        "with alone_in(pathlib.Path(sys.argv[1])) as folder:",
        "    (folder / 'sub').mkdir()",
        "    (folder / 'link').symlink_to('/nowhere')",
        "    os.kill(os.getpid(), 9)",
    )
    assert subprocess.run([sys.executable, "-c", "\n".join(lines), tmp_path / ".mine.new"]).returncode == -9
    assert {p.name for p in (tmp_path / ".mine.new").iterdir()} == {"sub", "link"}
    with alone_in(tmp_path / ".mine.new") as folder:
        assert not list(folder.iterdir())


def test_a_folder_that_vanishes_while_it_is_taken_is_made_again(tmp_path, monkeypatch):
    """As the other one ends: what was locked is no longer what the path names."""
    real, left = alone.fcntl.flock, [1]

    def locked(*args):
        if left:
            left.pop()
            (tmp_path / ".mine.new").rmdir()
        real(*args)

    monkeypatch.setattr(alone.fcntl, "flock", locked)
    with alone_in(tmp_path / ".mine.new") as folder:
        assert folder.is_dir()
        with pytest.raises(RoverError), alone_in(folder):
            pass


def test_a_file_in_the_runs_place_is_refused_before_any_work(tmp_path):
    (tmp_path / "mine").write_text("a user's")
    with pytest.raises(RoverError, match="is a file, and not a run's folder"):
        run_folder(tmp_path, "mine", RoverError)
    assert [p.name for p in tmp_path.iterdir()] == ["mine"]


def test_a_run_that_is_a_link_is_made_where_the_link_leads(tmp_path):
    """Beside the link is another disk, from which nothing can be renamed."""
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "mine").symlink_to("../disk/large")
    for _ in ("not there yet", "there"):
        folder = run_folder(tmp_path / "runs", "mine", RoverError)
        with made_beside(folder) as new:
            assert new.parent == tmp_path / "disk"
            (new / "last.json").touch()
            take_place(new, folder, last="last.json")
    assert [p.name for p in (tmp_path / "runs" / "mine").iterdir()] == ["last.json"]


def test_what_is_moved_into_a_runs_folder_costs_nothing_where_it_ends_in_the_middle(tmp_path, monkeypatch):
    """A file where a folder belongs is replaced; what was there is put back if its successor cannot come."""
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "pretrained_model").write_text("old")
    (tmp_path / "mine" / "figures").mkdir()
    (tmp_path / "mine" / "figures" / "one").write_text("old")

    def make():
        with made_beside(tmp_path / "mine") as new:
            for name in ("pretrained_model", "figures"):
                (new / name).mkdir()
                (new / name / "one").write_text("new")
            (new / "last.json").write_text("new")
            take_place(new, tmp_path / "mine", last="last.json")

    rename = type(tmp_path).rename

    def interrupted(path, target):
        if path.name == "figures" and path.parent.name == ".mine.made":
            raise KeyboardInterrupt
        return rename(path, target)

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(type(tmp_path), "rename", interrupted)
        make()
    assert (tmp_path / "mine" / "figures" / "one").read_text() == "old"
    make()
    assert {p.name for p in (tmp_path / "mine").iterdir()} == {"pretrained_model", "figures", "last.json"}
    assert (tmp_path / "mine" / "pretrained_model" / "one").read_text() == "new"
    assert (tmp_path / "mine" / "figures" / "one").read_text() == "new"

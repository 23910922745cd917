"""Two commands that make the same thing at once do not disturb each other, and a kill costs nothing."""

import subprocess
import sys
from pathlib import Path

import pytest

from rover_lib.onboard.errors import RoverError
from rover_lib.workshop.run.run_folder import run_folder
from rover_lib.workshop.swap_folder import ASKED, build_beside, lock_folder


def test_while_one_is_in_it_another_is_refused(tmp_path):
    with lock_folder(tmp_path / ".mine.new") as folder:
        (folder / "made").write_text("half")
        with pytest.raises(RoverError), lock_folder(folder):
            pass
        assert (folder / "made").read_text() == "half"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("asked", "then", "kept"), [("this", "other", set()), ("this", "this", {"sub", "link"})])
def test_what_a_killed_process_left_goes_first_unless_the_same_is_asked(tmp_path, asked, then, kept):
    lines = (
        "import os, sys, pathlib", "from rover_lib.workshop.swap_folder import lock_folder",
        "with lock_folder(pathlib.Path(sys.argv[1]), sys.argv[2]) as folder:", "    (folder / 'sub').mkdir()",
        "    (folder / 'link').symlink_to('/nowhere')", "    (folder / '.half').touch()",
        "    os.kill(os.getpid(), 9)",
    )  # fmt: skip
    new = tmp_path / ".mine.new"
    assert subprocess.run([sys.executable, "-c", "\n".join(lines), new, asked]).returncode == -9
    with lock_folder(new, then) as folder:
        assert {p.name for p in folder.iterdir()} - {ASKED} == kept
        (folder / ASKED).unlink(missing_ok=True)
    assert not new.exists()


def test_a_run_that_is_a_link_is_made_where_the_link_leads(tmp_path):
    """The link may lie on another disk than the run, and nothing can be renamed from one disk to another."""
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "mine").symlink_to("../disk/large")
    for _ in ("not there yet", "there"):
        with build_beside(run_folder(tmp_path / "runs", "mine", RoverError)) as new:
            assert new.parent == tmp_path / "disk"
            (new / "last.json").touch()
    assert [p.name for p in (tmp_path / "runs" / "mine").iterdir()] == ["last.json"]


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
OLD = ("figures/one", "figures/two", "pretrained_model", "report.html", "fast.json/one", "users/frame.jpg")


@pytest.mark.parametrize("count", [*range(1, 7), 99])
def test_a_kill_while_it_takes_its_place_costs_nothing(tmp_path, monkeypatch, count):
    """A student's files were once mixed with its predecessor's, and nobody could tell which were whose."""
    rename, moved = Path.rename, []
    write(tmp_path / "mine", *OLD, text="old")

    def ends(path, target):
        moved.append(path)
        if len(moved) == count:
            raise KeyboardInterrupt
        return rename(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", ends)
        if count > 5:
            make(tmp_path / "mine")
        else:
            with pytest.raises(KeyboardInterrupt):
                make(tmp_path / "mine")
    if count == 1:  # before it was known to be complete: nothing of the old one is lost
        assert whole(tmp_path) == {f"mine/{name}": "old" for name in OLD}
        return
    if count <= 5:
        with pytest.raises(ZeroDivisionError), build_beside(tmp_path / "mine"):
            1 / 0  # noqa: B018 the next process moves the rest, even if it fails itself
    assert whole(tmp_path / "mine") == NEW | {"users/frame.jpg": "old"}
    assert [p.name for p in tmp_path.iterdir()] == ["mine"]

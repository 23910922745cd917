"""Two processes that make the same thing at once do not disturb each other, and a kill or a power cut costs nothing."""

import os
import signal
import threading
from contextlib import suppress
from pathlib import Path

import pytest

from rover_lib.onboard import durable
from rover_lib.onboard.durable import ASKED, build_folder
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.stage import atomic_path
from rover_lib.workshop.run import run_folder
from tests.helpers.recorded import names_in


def whole(folder):
    return {str(p.relative_to(folder)): p.read_text() for p in folder.rglob("*") if p.is_file()}


def write(folder, *names, text):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def test_while_one_is_in_it_another_is_refused_or_waits(tmp_path):
    def second():
        with build_folder(tmp_path / "mine", wait=True) as new:
            write(new, "second", text="")

    waiting = threading.Thread(target=second)
    with build_folder(tmp_path / "mine") as folder:
        assert folder.stat().st_mode & 0o777 == 0o700  # or another user could hold the lock
        write(folder, "first", text="")
        with pytest.raises(RoverError), build_folder(tmp_path / "mine"):
            pass
        waiting.start()
        waiting.join(0.1)
        assert waiting.is_alive() and names_in(folder) == ["first"]
    waiting.join(10)
    (tmp_path / "usual").mkdir()
    assert (tmp_path / "mine").stat().st_mode == (tmp_path / "usual").stat().st_mode
    assert names_in(tmp_path / "mine") == ["first", "second"] and names_in(tmp_path) == ["mine", "usual"]


def in_fork(work):
    """Do it in a process of its own, in which it kills itself."""
    if not (child := os.fork()):
        try:
            work()
        finally:
            os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL


@pytest.mark.parametrize(("then", "kept"), [("other", []), ("this", ["link", "sub"]), ("", [])])
def test_what_a_killed_process_left_goes_first_unless_the_same_is_asked(tmp_path, then, kept):
    def fill():
        with build_folder(tmp_path / "mine", asked="this") as folder:
            (folder / "sub").mkdir()
            (folder / ".half").touch()
            (folder / "link").symlink_to("/nowhere")
            os.kill(os.getpid(), signal.SIGKILL)

    in_fork(fill)
    with build_folder(tmp_path / "mine", asked=then) as folder:
        assert [name for name in names_in(folder) if name != ASKED] == kept
    assert names_in(tmp_path) == ["mine"] and names_in(tmp_path / "mine") == kept


def test_a_file_that_a_killed_process_left_is_removed_by_the_next(tmp_path):
    def write_half():
        with atomic_path(tmp_path / "a.json"):
            os.kill(os.getpid(), signal.SIGKILL)

    in_fork(write_half)
    (tmp_path / ".a.json.mine.json").touch()
    with atomic_path(tmp_path / "a.json") as first:
        first.write_text("first")
        with atomic_path(tmp_path / "a.json") as second:
            second.write_text("second")
    assert (tmp_path / "a.json").read_text() == "first" and names_in(tmp_path) == [".a.json.mine.json", "a.json"]


def test_content_is_synced_before_its_name_and_the_name_after_it(tmp_path, monkeypatch):
    """By the calls, where no loop device shows it: tests/test_power_cuts.py."""
    calls, rename, replace, fsync = [], Path.rename, Path.replace, os.fsync

    def note(name, call):
        def noted(*args):
            calls.append(name)
            return call(*args)

        return noted

    monkeypatch.setattr(os, "fsync", note("sync", fsync))
    monkeypatch.setattr(Path, "rename", note("rename", rename))
    monkeypatch.setattr(Path, "replace", note("rename", replace))
    monkeypatch.setattr(durable, "sync_disk", note("sync", durable.sync_disk))
    with atomic_path(tmp_path / "file") as path:
        path.write_text("x")
    with build_folder(tmp_path / "folder") as folder:
        write(folder, "file", text="x")
    assert calls == ["sync", "rename", "sync"] * 2
    with build_folder(tmp_path / "folder") as folder:
        write(folder, "other", text="x")
    assert calls[6:] == ["sync", "rename", "sync", "rename", "sync"]


def test_a_run_that_is_a_link_is_made_where_the_link_leads(tmp_path):
    """The link may lie on another disk than the run, and nothing can be renamed from one disk to another."""
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "mine").symlink_to("../disk/large")
    for _ in ("not there yet", "there"):
        with build_folder(run_folder(tmp_path / "runs", "mine", RoverError)) as new:
            assert new.parent == tmp_path / "disk"
            (new / "last.json").touch()
    assert names_in(tmp_path / "runs" / "mine") == ["last.json"]


NEW = dict.fromkeys(("figures/one", "pretrained_model/config.json", "policy_mixed.pt", "fast.json"), "new")
OLD = ("figures/one", "figures/two", "pretrained_model", "report.html", "fast.json/one", "users/frame.jpg")


@pytest.mark.parametrize("count", [1, 2, 4, 99])
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
        filled = build_folder(tmp_path / "mine", lambda folder: [folder / "report.html", folder / "figures"])
        with suppress(KeyboardInterrupt), filled as new:
            write(new, *NEW, text="new")
    if count == 1:  # before it was known to be complete: nothing of the old one is lost
        assert whole(tmp_path) == {f"mine/{name}": "old" for name in OLD}
        return
    with pytest.raises(ZeroDivisionError), build_folder(tmp_path / "mine"):
        1 / 0  # noqa: B018 the next process moves the rest, even if it fails itself
    assert whole(tmp_path / "mine") == NEW | {"users/frame.jpg": "old"} and names_in(tmp_path) == ["mine"]

"""Deployments on the rover: every power cut, every broken artifact; after each there is a model that computes."""

import errno
import fcntl
import json
import os
import resource
import shutil
import signal
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner

from lab.pi.deployment_bench import write_changed_artifact
from rover_lib.cli import main
from rover_lib.onboard.artifact.manifest import content_hash
from rover_lib.onboard.care.release import Expected, ReleaseError, Releases, inspect_artifact, pack, sign
from rover_lib.onboard.errors import ArtifactError, RoverError
from rover_lib.onboard.policy.load import load_policy
from rover_lib.onboard.stage import sha256_of


@pytest.fixture(autouse=True)
def _our_laptop(keys, monkeypatch):
    monkeypatch.setattr("rover_lib.onboard.care.release.SIGNERS", keys / "signers")
    monkeypatch.setattr("rover_lib.onboard.care.release.COPIED_BYTES", 1 << 20)  # power is cut within a copy too


@pytest.fixture(scope="session")
def signed(artifacts, keys) -> dict[str, Path]:
    """The artifacts, with the signature of a laptop that the rover knows beside them."""
    for artifact in artifacts.values():
        Path(f"{artifact}.sig").write_bytes(sign(artifact, keys / "ours"))
    return artifacts


@pytest.fixture(scope="session")
def third(signed, keys, tmp_path_factory) -> Path:
    """Another artifact that is fit to deploy, as small as the two: each command hashes what a rover has."""
    path = write_changed_artifact(signed["static"], tmp_path_factory.mktemp("third") / "policy.pt", answers=1e-6)
    Path(f"{path}.sig").write_bytes(sign(path, keys / "ours"))
    return path


@pytest.fixture(scope="session")
def two(signed) -> tuple[Path, Path]:
    """Two artifacts that differ and are fit to deploy, their parity vectors run."""
    found = signed["static"], signed["mixed"]
    for artifact in found:
        load_policy(artifact)
    return found


def quick(models: Path) -> Releases:
    """Releases that look at bytes only when they switch, for the tests' speed."""

    def check(name: str) -> None:
        if not r.path_of(name).exists() or r.wrong_with(r.path_of(name).parent.resolve().name):
            raise ReleaseError(f"{name}: not whole")

    r = Releases(models, check=check)
    return r


@pytest.fixture(scope="session")
def first_models(two, keys, tmp_path_factory) -> Path:
    """The models of a rover that drives by the first of the two."""
    models = tmp_path_factory.mktemp("rover") / "models"
    r = Releases(models, check=quick(models).check, signers=keys / "signers")
    r.switch(r.stage(two[0]).name)
    return models


@pytest.fixture
def releases(tmp_path, first_models) -> Releases:
    """A rover that drives by the first of the two, to do anything with."""
    return quick(Path(shutil.copytree(first_models, tmp_path / "models", symlinks=True)))


@pytest.fixture(scope="session")
def full_models(first_models, third, keys, tmp_path_factory) -> Path:
    """They, with a release that the next deployment will remove."""
    models = shutil.copytree(first_models, tmp_path_factory.mktemp("full") / "models", symlinks=True)
    Releases(models, signers=keys / "signers").stage(third)
    return models


@pytest.fixture
def full(tmp_path, full_models) -> Releases:
    return quick(Path(shutil.copytree(full_models, tmp_path / "full", symlinks=True)))


def deploy(r: Releases, source: Path) -> str:
    """What deploy.yml does on a rover."""
    name = r.stage(source).name
    r.switch(name)
    r.prune(2)
    return name


def assert_drives(r: Releases, names: set[str]) -> None:
    """What the service would load is one of these, to the byte, and status says so.

    What acts in an artifact is what its content hash is of, so that bytes which have one of `two`'s, whose parity
    vectors hold here, compute what they should.
    """
    status = r.status()
    assert status["healthy"] and status["trouble"] == "" and status["current"] in names, status
    assert content_hash(r.policy) == status["current"][:64]


# Power cuts


def hooked(name: str, call: Callable, hook: Callable[[str, Callable, tuple], None]) -> Callable:
    return lambda *args, **kwargs: hook(name, lambda: call(*args, **kwargs), args)


def in_child(task: Callable[[], None], hook: Callable[[str, Callable, tuple], None]) -> int:
    """Runs a task in a child process in which each call that changes the disk goes through hook; its wait status."""
    pid = os.fork()
    if pid == 0:
        try:
            for call in ("write", "fsync", "mkdir", "symlink", "rename", "replace", "unlink", "rmdir"):
                setattr(os, call, hooked(call, getattr(os, call), hook))
            task()
        except BaseException as error:
            print(repr(error), file=sys.stderr)
            os._exit(1)
        os._exit(0)
    return os.waitpid(pid, 0)[1]


def die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def steps_of(task: Callable[[], None]) -> list[str]:
    """The calls that a task makes, by name."""
    read, write = os.pipe()
    put = os.write

    def hook(name, call, args):
        put(write, f"{name}\n".encode())
        return call()

    assert in_child(task, hook) == 0
    os.close(write)
    with os.fdopen(read) as f:
        return f.read().split()


def cut_after(task: Callable[[], None], n: int) -> set[int]:
    """Runs a task whose power is cut after its n-th call; the inodes of files that were written and not synced."""
    read, write = os.pipe()
    put, count = os.write, 0

    def hook(name, call, args):
        nonlocal count
        count += 1
        try:
            result = call()
            if name in ("write", "fsync") and stat.S_ISREG(os.fstat(args[0]).st_mode):
                put(write, f"{name} {os.fstat(args[0]).st_ino}\n".encode())
            return result
        finally:
            if count == n:
                die()

    status = in_child(task, hook)
    assert os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL, f"it has fewer than {n} steps"
    os.close(write)
    dirty = set()
    with os.fdopen(read) as f:
        for line in f:
            name, inode = line.split()
            (dirty.add if name == "write" else dirty.discard)(int(inode))
    return dirty


def lose(folder: Path, inodes: set[int]) -> None:
    """What was not synced is empty after a power cut."""
    for path in folder.rglob("*"):
        if path.is_file() and not path.is_symlink() and path.stat().st_ino in inodes:
            path.write_bytes(b"")


STEPS = 34  # of a deployment; test_cuts_are_all_of_a_deployment holds it to what is


@pytest.mark.slow
def test_cuts_are_all_of_a_deployment(full, two):
    steps = steps_of(lambda: deploy(full, two[1]))
    assert len(steps) == STEPS, steps
    assert {"write", "fsync", "mkdir", "symlink", "replace", "rename", "unlink", "rmdir"} <= set(steps)


@pytest.mark.slow
@pytest.mark.parametrize("n", range(1, STEPS + 1))
def test_power_cut_at_each_step_of_a_deployment(full, two, n):
    old = full.current
    lose(full.models, cut_after(lambda: deploy(full, two[1]), n))
    assert_drives(full, {old, content_hash(two[1])})
    new = deploy(full, two[1])  # running it again heals it
    assert new == content_hash(two[1]) == full.current
    assert_drives(full, {new})
    assert not [p for p in full.models.rglob(".*") if p.name != ".lock"]
    assert full.rollback() == old
    assert_drives(full, {old})


@pytest.mark.slow
@pytest.mark.parametrize("n", range(1, 9))
def test_power_cut_at_each_step_of_a_rollback(full, two, n):
    old, new = full.current, deploy(full, two[1])
    try:
        lost = cut_after(lambda: full.rollback(), n)
    except AssertionError as error:
        assert n > 6, error  # it has at least so many steps, all of which are here
        return
    lose(full.models, lost)
    assert_drives(full, {old, new})
    deploy(full, two[1])
    assert_drives(full, {new})


def test_power_cut_in_the_health_check(releases, two):
    old, new = releases.current, releases.stage(two[1]).name

    def check(name: str) -> None:
        if name == "current":
            die()

    status = in_child(lambda: Releases(releases.models, check=check).switch(new), lambda name, call, args: call())
    assert os.WIFSIGNALED(status)
    assert releases.current == new  # it was proven before the switch
    assert_drives(releases, {new})
    assert not releases.switch(new)
    assert releases.rollback() == old


def test_nothing_unsynced_when_current_is_switched(releases, two):
    """What a kill cannot show: a power cut loses what was not synced, and that must not be what current points to."""
    put, (read, write) = os.write, os.pipe()
    dirty: set[tuple[int, int]] = set()

    def key(file: int) -> tuple[int, int]:
        s = os.fstat(file)
        return s.st_dev, s.st_ino

    def of(path) -> tuple[int, int]:
        s = Path(path).parent.stat()
        return s.st_dev, s.st_ino

    def hook(name, call, args):
        if name == "replace" and Path(args[1]).name == "current":
            put(write, f"{len(dirty - {of(args[0])})} {len(dirty)}\n".encode())  # models/ has just got the new link
        if name == "write":
            dirty.add(key(args[0]))
        elif name == "fsync":
            dirty.discard(key(args[0]))
        elif name in ("mkdir", "rename", "replace", "symlink"):
            dirty.add(of(args[0] if name == "mkdir" else args[1]))
        return call()

    assert in_child(lambda: deploy(releases, two[1]), hook) == 0
    os.close(write)
    with os.fdopen(read) as f:
        assert f.read() == "0 1\n"


# Transfers


@pytest.fixture
def packed(two, keys, tmp_path) -> Path:
    """The second of the two, packed to travel."""
    pack(two[1], tmp_path / "packed", key=keys / "ours")
    return tmp_path / "packed"


@pytest.mark.slow
def test_what_was_packed_becomes_the_artifact_again(releases, packed, two):
    staged = releases.stage(packed)
    assert staged.changed and staged.name == content_hash(two[1])
    assert releases.path_of(staged.name).read_bytes() == two[1].read_bytes()
    assert not releases.stage(packed).changed
    origin = next(r for r in releases.all() if r.name == staged.name).origin
    assert str(two[1].absolute()) in origin


def test_an_artifact_in_a_folder_of_any_name_is_taken(releases, two, tmp_path):
    folder = tmp_path / "my\N{NO-BREAK SPACE}policies, \udcff"
    folder.mkdir()
    shutil.copy(two[1], folder / "policy.pt")
    pack(folder / "policy.pt", tmp_path / "packed")
    name = releases.stage(tmp_path / "packed", unsigned=True).name
    (origin,) = (r.origin for r in releases.all() if r.name == name)
    assert origin.endswith(r"my\xa0policies, \udcff/policy.pt")


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_packing_again_replaces_what_was_packed(packed, two, keys):
    before = contents(packed)
    pack(two[1], packed, key=keys / "ours")
    assert contents(packed) == before
    pack(two[0], packed)
    assert set(contents(packed)) == {"policy.pt", "release.json"}  # no signature of the one before


def test_a_disk_that_fills_while_packing_is_left_without_halves(two, tmp_path, monkeypatch):
    def full(source, target):
        Path(target).write_bytes(b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(shutil, "copyfile", full)
    with pytest.raises(OSError, match="No space left"):
        pack(two[1], tmp_path / "packed")
    assert not list((tmp_path / "packed").iterdir())


@pytest.mark.parametrize("foreign", ["notes.txt", "policy.pt/inside", ".hidden"])
def test_a_folder_that_holds_anything_else_is_refused_and_left_as_it_is(packed, two, foreign):
    (packed / "policy.pt").unlink()
    (packed / foreign).parent.mkdir(exist_ok=True)
    (packed / foreign).write_text("not ours")
    before = contents(packed)
    with pytest.raises(
        ReleaseError, match=r"holds files that .* did not write, found .*; pack into a folder of its own"
    ):
        pack(two[1], packed)
    assert contents(packed) == before


@pytest.mark.parametrize("name", ["policy_static.pt", "policy.pt", "release.json"])
def test_the_artifact_in_the_folder_is_not_removed(two, tmp_path, name):
    folder = tmp_path / "runs"
    folder.mkdir()
    artifact = Path(shutil.copy(two[0], folder / name))
    with pytest.raises(ReleaseError, match=f"did not write, found {name}; pack into"):
        pack(artifact, folder)
    assert contents(folder) == {name: two[0].read_bytes()}


def test_a_file_in_place_of_the_folder_is_refused(two, tmp_path):
    (tmp_path / "packed").write_text("not ours")
    with pytest.raises(ReleaseError, match="packed: not a folder; pack into a folder of its own"):
        pack(two[0], tmp_path / "packed")


def test_what_arrives_damaged_or_not_at_all_is_refused_and_the_same_transfer_repeated_heals(releases, packed):
    old, policy = releases.current, packed / "policy.pt"
    good = policy.read_bytes()
    flipped = bytes([good[0] ^ 1]) + good[1:]
    for bad, says in (
        (flipped, r"arrived damaged .* send it again"),
        (good[:-9], "arrived damaged"),
        (good + b"x", "larger than it can be; send it again"),
        (None, "not arrived; send it again"),
    ):
        policy.unlink() if bad is None else policy.write_bytes(bad)
        with pytest.raises(ReleaseError, match=says):
            releases.stage(packed)
        assert_drives(releases, {old})
    policy.write_bytes(good)
    assert_drives(releases, {deploy(releases, packed)} - {old})


@pytest.mark.parametrize("content", [None, "", "[]", "{}", '{"name": "../../etc", "sha256": "0", "origin": 1}'])
def test_a_description_that_is_none(releases, packed, content):
    (packed / "release.json").unlink()
    if content is not None:
        (packed / "release.json").write_text(content)
    with pytest.raises(ReleaseError, match="send it again"):
        releases.stage(packed)


def test_a_description_of_another_artifact(releases, packed):
    about = json.loads((packed / "release.json").read_text())
    (packed / "release.json").write_text(json.dumps({**about, "name": "0" * 64}))
    with pytest.raises(ReleaseError, match=r"contains .* not 000000000000; pack it again"):
        releases.stage(packed)


def test_a_wrong_hash(releases, two):
    old = releases.current
    with pytest.raises(ReleaseError, match=r"arrived damaged \(sha256 "):
        releases.stage(two[1], sha256="0" * 64)
    assert_drives(releases, {old})
    assert releases.stage(two[1], sha256=sha256_of(two[1])).changed


# Artifacts that must not drive


@pytest.mark.slow
@pytest.mark.parametrize(
    "changes, sentence",
    [
        ({"versions": {"torch": "2.9.1"}}, "made with torch 2.9.1, rovers have 2.8.0.*; deploy another$"),
        ({"engine": "x86"}, "needs the engine 'x86', rovers have qnnpack or onnxruntime or hailo; deploy another$"),
        ({"chunk": 16}, "plans 16 actions, this rover takes 32; deploy another, or allow it: chunk"),
        ({"mode": "dynamic"}, "its manifest says dynamic, its code is not"),
        ({"mode": "fp32"}, "parity tolerance of steering must be from 0 to 0.001"),
        (
            {"state_names": ["speed", "yaw_rate"]},
            "is told speed, yaw_rate, this car has steering and throttle; deploy ",
        ),
        ({"schema": 2}, "manifest schema 2"),
        (
            {"cameras": [{"name": "cam_rear", "width": 128, "height": 72}]},
            "looks through cam_rear 128x72, this rover has cam_front; deploy another, or allow it: camera",
        ),
        (
            {"cameras": [{"name": "cam_front", "width": 96, "height": 96}]},
            "cam_front 96x96, this rover's pictures are 1.78 to 1; .*allow it: aspect",
        ),
    ],
)
def test_refused_by_its_manifest_before_it_travels_and_on_arrival(releases, two, tmp_path, changes, sentence):
    old, bad = releases.current, write_changed_artifact(two[1], tmp_path / "bad.pt", **changes)
    with pytest.raises(RoverError, match=sentence):
        pack(bad, tmp_path / "packed")
    assert not (tmp_path / "packed").exists()
    with pytest.raises(RoverError, match=sentence) as refused:
        releases.stage(bad, unsigned=True)
    assert ".new" not in str(refused.value)
    assert_drives(releases, {old})
    assert len(releases.all()) == 1


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["fp32", "dynamic"])
def test_a_slow_artifact_only_if_it_is_allowed(releases, signed, mode):
    with pytest.raises(ReleaseError, match=f"its mode is {mode}.*; deploy another, or allow it: mode"):
        releases.stage(signed[mode])
    name = releases.stage(signed[mode], allow=["mode"]).name
    assert releases.switch(name)
    assert_drives(releases, {name})


def test_what_cannot_drive_cannot_be_allowed(two):
    with pytest.raises(ReleaseError, match="only mode, chunk, camera, aspect can be allowed, found torch"):
        inspect_artifact(two[0], allow=["torch"])


def test_a_rover_with_another_chunk_or_camera(two):
    with pytest.raises(ReleaseError, match=r"plans 32 actions, this rover takes 50"):
        inspect_artifact(two[0], Expected(chunk=50))
    with pytest.raises(ReleaseError, match=r"this rover's pictures are 1\.33 to 1"):
        inspect_artifact(two[0], Expected(aspect=4 / 3))


def test_fp32_that_says_it_is_static(releases, signed, tmp_path):
    lie = write_changed_artifact(signed["fp32"], tmp_path / "lie.pt", mode="static")
    with pytest.raises(ArtifactError, match="its manifest says static, its code is not"):
        releases.stage(lie, unsigned=True)


@pytest.mark.slow
def test_parity_vectors_that_fail_keep_it_from_being_used(releases, two, tmp_path):
    bad = write_changed_artifact(two[1], tmp_path / "bad.pt", answers=0.5)
    proving = Releases(releases.models)
    old, name = releases.current, proving.stage(bad, unsigned=True).name
    with pytest.raises(ArtifactError, match="computes something else here"):
        proving.switch(name)
    assert_drives(releases, {old})
    assert_drives(releases, {deploy(proving, two[1])} - {name})


@pytest.mark.parametrize("content", [b"", b"no artifact", None])
def test_no_artifact(releases, two, tmp_path, content):
    bad = tmp_path / "bad.pt"
    bad.write_bytes(two[1].read_bytes()[:-50_000] if content is None else content)
    with pytest.raises(ArtifactError):
        releases.stage(bad, unsigned=True)


# The switch


def failing(models: Path, when: Callable[[str], bool]) -> Releases:
    def check(name: str) -> None:
        if when(name):
            raise ArtifactError("the card gives other bytes than a minute ago")

    r = Releases(models, check=check)
    return r


def test_a_failed_health_check_rolls_back_by_itself(releases, two):
    old, new = releases.current, releases.stage(two[1]).name
    sick = failing(releases.models, lambda name: name == "current")
    with pytest.raises(ReleaseError, match=f"{old[:12]} is in use again: the card gives other bytes"):
        sick.switch(new)
    assert_drives(releases, {old})
    assert releases.status()["can_roll_back_to"] is None  # what failed was never in use
    assert releases.switch(new)


def test_a_failed_health_check_of_the_first_model_leaves_none(two, tmp_path):
    r = failing(tmp_path / "models", lambda name: name == "current")
    with pytest.raises(ReleaseError, match="no model is in use, as before"):
        r.switch(r.stage(two[0]).name)
    status = r.status()
    assert status["current"] is None and not status["healthy"] and status["trouble"] == "no model: deploy one"


@pytest.mark.parametrize("name", ["current", "..", "policy", "0" * 63, "/etc/passwd", "0" * 64])
def test_what_is_no_release_is_not_switched_to(releases, name):
    with pytest.raises(ReleaseError):
        releases.switch(name)
    assert_drives(releases, {releases.current})


@pytest.mark.slow
def test_back_and_back_again(releases, two, third):
    first = releases.current
    second = deploy(releases, two[1])
    releases.switch(releases.stage(third).name)
    assert releases.status()["can_roll_back_to"] == second
    assert [releases.rollback(), releases.rollback()] == [second, first]
    with pytest.raises(ReleaseError, match=f"no release to roll back to; {first[:12]} stays in use"):
        releases.rollback()
    assert_drives(releases, {first})
    releases.switch(second)
    assert releases.rollback() == first


def test_rollback_with_nothing_to_roll_back_to(releases, tmp_path):
    with pytest.raises(ReleaseError, match=r"no release to roll back to; .* stays in use; deploy one instead"):
        releases.rollback()
    assert_drives(releases, {releases.current})
    with pytest.raises(ReleaseError, match="no model is in use"):
        Releases(tmp_path / "empty").rollback()


@pytest.mark.slow
def test_rollback_passes_over_what_is_damaged(releases, two, third):
    first = releases.current
    second = deploy(releases, two[1])
    releases.switch(releases.stage(third).name)
    damage(releases.path_of(second))
    assert releases.status()["can_roll_back_to"] == first == releases.rollback()


@pytest.mark.slow
def test_prune_keeps_those_used_last_and_the_one_in_use(releases, two, third):
    first = releases.current
    second = deploy(releases, two[1])
    never = releases.stage(third).name
    assert releases.prune(3) == []
    assert releases.prune(2) == [never]
    releases.rollback()
    assert releases.current == first and releases.prune(1) == [second]
    assert_drives(releases, {first})
    with pytest.raises(ReleaseError, match="at least 1"):
        releases.prune(0)


# What happens to a disk


def damage(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(bytes(content))


def test_a_damaged_release_in_use_is_told_and_healed(releases, two):
    name = releases.current
    damage(releases.policy)
    status = releases.status()
    assert not status["healthy"] and "is not what policy.pt.sha256 says" in status["trouble"]
    new = releases.stage(two[0]).name
    assert new == f"{name}-2"  # beside it: what is in use is never taken away
    releases.switch(new)
    assert_drives(releases, {new})
    assert releases.prune(3) == [name]
    assert not releases.stage(two[0]).changed


def test_tampering_with_the_checksum_too_is_found(releases, two):
    folder = releases.policy.parent
    shutil.copy(two[1], releases.policy)
    (folder / "policy.pt.sha256").write_text(f"{sha256_of(releases.policy)}  policy.pt\n")
    status = releases.status()
    assert not status["healthy"] and "tampered with: its content is" in status["trouble"]
    with pytest.raises(ReleaseError, match="tampered with"):
        releases.verify()


@pytest.mark.parametrize("what", ["policy.pt", "policy.pt.sha256", "release.json"])
def test_a_file_of_a_release_that_is_gone(releases, two, what):
    deploy(releases, two[1])
    (releases.policy.parent / what).unlink()
    assert not releases.status()["healthy"]
    releases.rollback()
    assert_drives(releases, {content_hash(two[0])})


@pytest.mark.parametrize("target", ["releases/" + "0" * 64, "/etc", "releases", "nowhere"])
def test_a_link_that_points_elsewhere(releases, two, target):
    releases.current_link.unlink()
    releases.current_link.symlink_to(target)
    status = releases.status()
    assert not status["healthy"] and status["trouble"]
    assert_drives(releases, {deploy(releases, two[0])})


def test_a_folder_in_place_of_the_link_is_healed(releases, two):
    releases.current_link.unlink()
    releases.current_link.mkdir()
    (releases.current_link / "policy.pt").write_text("of somebody")
    assert not releases.status()["healthy"]
    assert_drives(releases, {deploy(releases, two[0])})
    assert [p.name for p in releases.models.iterdir() if p.name.startswith(".new")] == []


def test_sha256sum_agrees(releases):
    folder = releases.policy.parent
    assert subprocess.run(["sha256sum", "--check", "--quiet", "policy.pt.sha256"], cwd=folder).returncode == 0


@pytest.mark.slow
def test_a_history_that_is_no_history(releases, two):
    for content in ("", "{", "[1, null]", '{"a": 1}', '["../.."]', "[" * 90_000, " " * 1_000_000):
        (releases.models / "history.json").write_text(content)
        assert_drives(releases, {deploy(releases, two[1]), deploy(releases, two[0])})


@pytest.mark.parametrize(
    "number, says, n",
    [
        *((errno.ENOSPC, "the disk is full; what was in use still is", n) for n in range(1, 7)),
        (errno.EROFS, "the disk cannot be written (Read-only", 1),
    ],
)
@pytest.mark.slow
def test_a_disk_that_is_full_or_dying_at_some_step(releases, two, n, number, says):
    old, count = releases.current, 0

    def hook(name, call, args):
        nonlocal count
        count += name in ("write", "mkdir", "symlink")
        if count >= n and name in ("write", "mkdir", "symlink"):
            raise OSError(number, os.strerror(number))
        return call()

    def task():
        try:
            deploy(releases, two[1])
        except ReleaseError as error:
            os._exit(7 if says in str(error) else 8)

    status = in_child(task, hook)
    assert os.waitstatus_to_exitcode(status) == 7
    assert_drives(releases, {old, content_hash(two[1])})
    assert_drives(releases, {deploy(releases, two[1])} - {old})


@pytest.mark.slow
def test_on_a_full_disk_a_rover_can_go_back_and_prune(releases, two):
    """What was switched is said to be, too, even when there is no room to write down that it was."""
    old, new = releases.current, releases.stage(two[1]).name

    def hook(name, call, args):
        if name == "write":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return call()

    assert in_child(lambda: releases.switch(new), hook) == 0
    assert_drives(releases, {new})
    assert in_child(lambda: releases.prune(2), hook) == 0
    assert releases.rollback() == old  # the command after it wrote it down
    assert releases.switch(new) and in_child(lambda: releases.rollback(), hook) == 0
    assert_drives(releases, {old})
    assert in_child(lambda: releases.prune(1), hook) == 0
    assert [r.name for r in releases.all()] == [old]


def test_too_little_room_is_said_before_it_is_used_up(releases, two, monkeypatch):
    monkeypatch.setattr(shutil, "disk_usage", lambda path: shutil._ntuple_diskusage(10**9, 10**9, 10**6))
    with pytest.raises(ReleaseError, match=r"1 MB free, .* are needed; prune releases"):
        releases.stage(two[1])
    monkeypatch.undo()
    assert_drives(releases, {content_hash(two[0])})


@pytest.mark.parametrize("year", [1970, 2005, 2099])
def test_a_clock_that_is_wrong_by_years(releases, two, year, monkeypatch):
    old, wrong = releases.current, time.mktime((year, 1, 2, 0, 0, 0, 0, 0, 0))
    monkeypatch.setattr(time, "time", lambda: wrong)
    new = deploy(releases, two[1])
    os.utime(releases.current_link, (wrong, wrong), follow_symlinks=False)
    for path in (releases.releases / new).iterdir():
        os.utime(path, (wrong, wrong))
    assert releases.status()["since"].startswith(str(year))
    assert_drives(releases, {new})
    assert releases.rollback() == old and releases.prune(1) == [new]


@pytest.mark.slow
def test_two_at_once_one_is_refused(releases, two):
    with (releases.models / ".lock").open() as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        for command in (lambda: releases.stage(two[1]), releases.rollback, lambda: releases.prune(1)):
            with pytest.raises(ReleaseError, match="another deployment is at work; wait for it"):
                command()
        assert releases.status()["at_work"]
    assert not releases.status()["at_work"]
    with (releases.models / ".lock").open() as other:  # status, which looks for a moment
        fcntl.flock(other, fcntl.LOCK_SH)
        threading.Timer(0.1, lambda: fcntl.flock(other, fcntl.LOCK_UN)).start()
        releases.prune(3)
    assert_drives(releases, {deploy(releases, two[1])})


def test_one_that_is_refused_does_not_tidy_up_after_the_other(releases, two):
    half = releases.releases / ".new"
    half.mkdir()
    with (releases.models / ".lock").open() as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(ReleaseError):
            releases.stage(two[1])
        assert half.exists()
    releases.prune(3)
    assert not half.exists()


def test_what_is_somebody_elses_among_the_releases_stays(releases):
    theirs = releases.releases / ".git"
    theirs.mkdir()
    releases.prune(3)
    assert theirs.exists()


def test_a_rover_without_anything(tmp_path):
    r = Releases(tmp_path / "models")
    status = r.status()
    assert status["current"] is None and not status["healthy"] and status["releases"] == [] and not status["at_work"]
    with pytest.raises(ReleaseError, match="not there; deploy one"):
        r.verify()
    assert not (tmp_path / "models").exists()  # looking changes nothing


def test_a_strict_umask_does_not_hide_the_model_from_the_service(two, tmp_path):
    r, before = Releases(tmp_path / "models"), os.umask(0o077)
    try:
        name = r.stage(two[0]).name
    finally:
        os.umask(before)
    folder = r.releases / name
    assert stat.S_IMODE(folder.stat().st_mode) == 0o755
    assert {stat.S_IMODE(p.stat().st_mode) for p in folder.iterdir()} == {0o644}


# The command line


def rover(*args: object):
    return CliRunner().invoke(main, ["release", *map(str, args)])


@pytest.mark.slow
def test_a_deployment_by_hand(two, tmp_path, keys):
    models = ["--models", tmp_path / "models"]
    packed = json.loads(rover("pack", "--sign-key", keys / "ours", two[0], tmp_path / "packed").output)
    staged = json.loads(rover(*models, "stage", tmp_path / "packed").output)
    assert staged == {"name": packed["name"], "changed": True}
    assert json.loads(rover(*models, "switch", staged["name"]).output)["changed"] is True
    assert "computes what it should" in rover(*models, "verify").output
    second = json.loads(rover(*models, "stage", two[1]).output)["name"]
    assert rover(*models, "switch", second).exit_code == 0
    assert json.loads(rover(*models, "rollback").output)["name"] == packed["name"]
    shown = rover(*models, "status")
    assert shown.exit_code == 0 and f"* {packed['name'][:12]}  static" in shown.output
    assert json.loads(rover(*models, "prune", "--keep", 1).output)["removed"] == [second]
    found = json.loads(rover(*models, "status", "--json").output)
    assert found["healthy"] and found["current"] == packed["name"]
    assert {"service", "temperature_c", "throttled", "disk_free_mb", "last_drive_s", "rover"} <= set(found)


def test_bad_input_ends_in_a_sentence(two, signed, tmp_path):
    models = ["--models", tmp_path / "models"]
    for command, sentence in [
        ([*models, "status"], "rover: no model: deploy one"),
        ([*models, "switch", "latest"], "named by 64 hexadecimal digits or 'current', found 'latest'"),
        ([*models, "rollback"], "no release to roll back to"),
        ([*models, "stage", tmp_path / "nothing"], "nothing: not found; stage takes"),
        (["pack", signed["fp32"], tmp_path / "packed"], "its mode is fp32"),
        (["--chunk", "50", "pack", two[0], tmp_path / "packed"], "plans 32 actions, this rover takes 50"),
    ]:
        result = rover(*command)
        assert result.exit_code == 1 and sentence in result.output and "Traceback" not in result.output, result.output


def test_staging_takes_no_more_memory_than_it_may(two, tmp_path, monkeypatch):
    """Whoever asks for it: a deployment does so as root, in no unit of systemd's."""
    before = resource.getrlimit(resource.RLIMIT_DATA)
    monkeypatch.setattr("rover_lib.onboard.care.release.inspect_artifact", lambda *_: bytearray(10**9))
    result = rover("--models", tmp_path / "models", "stage", "--unsigned", two[0])
    assert "staging it would take more than 400 MB of memory" in result.output
    assert resource.getrlimit(resource.RLIMIT_DATA) == before


UNIT = """#!/bin/sh
echo "$@" >> {folder}/asked
[ $(basename $0) = systemctl ] && exit {code}
echo "rover: it computes something else here; do not drive with it"
"""


@pytest.mark.parametrize("code", [0, 1])
def test_parity_in_the_services_sandbox(releases, two, tmp_path, monkeypatch, code):
    for name in ("systemctl", "journalctl"):
        script = tmp_path / name
        script.write_text(UNIT.format(folder=tmp_path, code=code))
        script.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    old, name = releases.current, releases.stage(two[1]).name
    result = rover("--models", releases.models, "--sandboxed", "switch", name)
    asked = (tmp_path / "asked").read_text().splitlines()
    assert asked[0] == f"start rover-check@{name}.service"
    if code:
        assert result.exit_code == 1 and "it computes something else here" in result.output
        assert_drives(releases, {old})
    else:
        assert result.exit_code == 0 and asked[1:] == ["start rover-check@current.service"]
        assert_drives(releases, {name})

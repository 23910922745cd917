"""Deployments on the rover: every power cut, every broken artifact; after each there is a model that computes."""

import errno
import fcntl
import os
import shutil
import signal
import stat
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from rover_lib.onboard.artifact.acceptance import Expected
from rover_lib.onboard.artifact.manifest import content_hash, read_manifest
from rover_lib.onboard.care.release import Releases
from rover_lib.onboard.errors import ArtifactError, RoverError
from rover_lib.onboard.stage import sha256_of
from tests.helpers.archives import manifest_with, rewritten, vectors_with
from tests.helpers.command import rover

CHANGES = ("fsync", "mkdir", "symlink", "rename", "replace", "unlink", "rmdir")  # calls that change the disk
Hook = Callable[[str, Callable[[], object], Path], object]  # takes a call's name, the call itself, and its path


@pytest.fixture(scope="session")
def two(artifacts) -> tuple[Path, Path]:
    """Two artifacts that differ and are fit to deploy."""
    return artifacts["static"], artifacts["mixed"]


def answering_differently(artifact: Path, target: Path, by: float) -> Path:
    """Copy an artifact with parity vectors that ask for other plans."""
    vectors = vectors_with(lambda vectors: vectors.update(chunk=vectors["chunk"] + by))
    return rewritten(artifact, target, {"parity.npz": vectors})


@pytest.fixture(scope="session")
def third(artifacts, tmp_path_factory) -> Path:
    return answering_differently(artifacts["static"], tmp_path_factory.mktemp("third") / "policy.pt", 1e-6)


class Quick(Releases):
    """Looks only at bytes when it switches, for the tests' speed."""

    def verify(self, name: str = "current") -> None:
        if wrong := self.wrong_with(self.path_of(name).parent.resolve().name):
            raise RoverError(f"{name}: {wrong}")


@pytest.fixture(scope="session")
def first_models(two, third, tmp_path_factory) -> Path:
    """The models of a rover that drives by the first of the two, and has another that the next deployment removes."""
    r = Quick(tmp_path_factory.mktemp("rover") / "models")
    r.switch(r.stage(two[0]).name)
    r.stage(third)
    return r.models


@pytest.fixture
def releases(tmp_path, first_models) -> Releases:
    return fresh(tmp_path, first_models)


def fresh(folder: Path, models: Path) -> Releases:
    shutil.rmtree(folder / "models", ignore_errors=True)
    return Quick(Path(shutil.copytree(models, folder / "models", symlinks=True)))


def deploy(r: Releases, source: Path) -> str:
    """What deploy.yml does on a rover."""
    name = r.stage(source).name
    r.switch(name)
    r.prune(2)
    return name


def assert_drives(r: Releases, names: set[str]) -> None:
    """The service would load one of these, to the byte, and status says so."""
    status = r.status()
    assert status["healthy"] and status["trouble"] == "" and status["current"] in names, status
    assert content_hash(r.path_of("current")) == status["current"]


def damage(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(bytes(content))


def in_child(task: Callable[[], object], hook: Hook) -> int:
    """Run a task in a child process whose calls that change the disk go through `hook`; its exit code."""

    def through_hook(name: str, call: Callable) -> Callable:
        def replaced(*args, **options):
            path = args[1] if name in ("symlink", "rename", "replace") else args[0]
            path = Path(f"/proc/self/fd/{path}").readlink() if name == "fsync" else Path(path)
            return hook(name, lambda: call(*args, **options), path)

        return replaced

    pid = os.fork()
    if pid == 0:
        try:
            for name in CHANGES:
                setattr(os, name, through_hook(name, getattr(os, name)))
            task()
        except BaseException as error:
            print(repr(error), file=sys.stderr)
            os._exit(1)
        os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def strike(task: Callable[[], object], models: Path, n: int, full: bool = False) -> bool:
    """Run a task whose power is cut before its n-th change. Returns False if it ends earlier.

    Files that were written and not synced are empty afterwards. full: instead, the disk is full from then on.
    """

    def files():
        found = [p for p in models.rglob("*") if p.is_file() and not p.is_symlink()]
        return {(p.stat().st_ino, p.stat().st_mtime_ns): p for p in found}

    before, count = files(), 0
    read, write = os.pipe()

    def hook(name, call, path):
        nonlocal count
        count += 1
        if count >= n and full and name in ("fsync", "mkdir", "symlink"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if count == n and not full:
            os.kill(os.getpid(), signal.SIGKILL)
        result = call()
        if name == "fsync":
            os.write(write, f"{path.stat().st_ino}\n".encode())
        return result

    code = in_child(task, hook)
    os.close(write)
    with os.fdopen(read) as pipe:
        synced = {int(line) for line in pipe}
    for (inode, changed), path in files().items():
        if not full and inode not in synced and (inode, changed) not in before:
            path.write_bytes(b"")
    assert code in (0, 1 if full else -signal.SIGKILL)
    return code != 0


WORK = {  # what comes before, what is struck, and how many changes that makes at least
    "deployment": (lambda r, two: None, lambda r, two: deploy(r, two[1]), 20),
    "rollback": (lambda r, two: deploy(r, two[1]), lambda r, two: r.rollback(), 5),
    "replacing": (lambda r, two: damage(r.path_of("current")), lambda r, two: r.stage(two[0]), 5),
}


@pytest.mark.slow
@pytest.mark.parametrize(("work", "full"), [*((work, False) for work in WORK), ("deployment", True)])
def test_power_cut_or_full_disk_at_each_step(tmp_path, releases, two, work, full):
    prepare, task, least = WORK[work]
    prepare(releases, two)
    policies = {p.read_bytes() for p in (*two, releases.path_of("current"))}
    r, n = fresh(tmp_path / "next", releases.models), 1
    while strike(lambda r=r: task(r, two), r.models, n, full):
        if work == "replacing":  # it was damaged before
            assert r.path_of("current").read_bytes() in policies
        else:
            assert_drives(r, {content_hash(path) for path in two})
        new = deploy(r, two[0] if work == "replacing" else two[1])  # running it again heals it
        assert_drives(r, {new})
        assert {p.name for p in r.models.rglob(".*")} == {".lock"}
        if work == "deployment":
            assert r.rollback() == content_hash(two[0])
        r, n = fresh(tmp_path / "next", releases.models), n + 1
    assert n > least


def test_all_is_synced_before_it_is_used(releases, two):
    read, write = os.pipe()

    def hook(name, call, path):
        os.write(write, f"{name} {path.relative_to(releases.models)}\n".encode())
        return call()

    assert in_child(lambda: releases.switch(releases.stage(two[1]).name), hook) == 0
    os.close(write)
    with os.fdopen(read) as pipe:
        calls = pipe.read().splitlines()
    folder = f"releases/{content_hash(two[1])}"
    synced = [calls.index(f"fsync releases/.new{file}") for file in ("/policy.pt", "/release.json", "")]
    steps = [f"rename {folder}", "fsync releases", "replace current", "fsync ."]
    assert (order := [max(synced), *map(calls.index, steps)]) == sorted(order)


def test_what_arrives_damaged_is_refused_and_the_same_transfer_repeated_heals(releases, two, tmp_path):
    old, sent = releases.current, Path(shutil.copy(two[1], tmp_path / "sent"))
    damage(sent)
    with pytest.raises(RoverError, match="arrived damaged"):
        releases.stage(sent, sha256=sha256_of(two[1]))
    with pytest.raises(ArtifactError) as refused:
        releases.stage(sent)
    assert str(sent) in str(refused.value) and ".new" not in str(refused.value)
    assert_drives(releases, {old})
    assert releases.stage(two[1], sha256=sha256_of(two[1])).changed
    assert not releases.stage(two[1]).changed
    assert_drives(releases, {deploy(releases, two[1])})


def test_what_is_refused_is_not_staged_unless_it_is_allowed(releases, artifacts, tmp_path):
    manifest, expected = read_manifest(artifacts["static"]), Expected()
    rear = [{"name": "cam_rear", "width": 96, "height": 96}]
    others = {"engine": "x86", "chunk": 16, "state_names": ["speed", "yaw_rate"], "cameras": rear}
    assert not set(expected.refusals(manifest))
    assert set(expected.refusals(manifest | others)) == {"engine", "chunk", "state", "camera", "aspect"}
    with pytest.raises(ArtifactError, match="mode"):
        releases.stage(artifacts["fp32"])
    lie = rewritten(artifacts["fp32"], tmp_path / "lie.pt", {"manifest.json": manifest_with(mode="static")})
    with pytest.raises(ArtifactError, match="its code is not"):
        releases.stage(lie)
    assert_drives(releases, {releases.current})
    assert releases.switch(releases.stage(artifacts["fp32"], allow=["mode"]).name)


@pytest.mark.slow
def test_parity_vectors_that_fail_keep_it_from_being_used(releases, two, tmp_path):
    bad = answering_differently(two[1], tmp_path / "bad.pt", 0.5)
    proving = Releases(releases.models)
    name = proving.stage(bad).name
    with pytest.raises(RoverError, match="computes something else"):
        proving.switch(name)
    assert_drives(releases, {content_hash(two[0])})


def test_a_failed_health_check_goes_back_by_itself(releases, two, tmp_path):
    def fails_after_the_switch(name: str) -> None:
        if name == "current":
            raise ArtifactError("the card gives other bytes than a minute ago")

    old, new = releases.current, releases.stage(two[1]).name
    with pytest.raises(RoverError):
        Releases(releases.models, check=fails_after_the_switch).switch(new)
    assert_drives(releases, {old})
    assert releases.switch(new) and not releases.switch(new)
    empty = Releases(tmp_path / "empty", check=fails_after_the_switch)
    with pytest.raises(RoverError):
        empty.switch(empty.stage(two[0]).name)
    assert empty.status()["current"] is None


def test_back_and_back_again_past_what_is_damaged(releases, two, third):
    first, second = releases.current, deploy(releases, two[1])
    last = releases.stage(third).name
    releases.switch(last)
    assert [releases.rollback(), releases.rollback()] == [second, first]
    with pytest.raises(RoverError):
        releases.rollback()
    releases.switch(second)
    releases.switch(last)
    releases.path_of(second).unlink()
    assert releases.rollback() == first
    assert_drives(releases, {first})


def test_prune_keeps_those_used_last_and_the_one_in_use(releases, two, third):
    first, never = releases.current, content_hash(third)
    second = releases.stage(two[1]).name
    releases.switch(second)
    (releases.releases / ".git").mkdir()  # somebody else's
    assert releases.prune(3) == [] and releases.prune(2) == [never]
    releases.rollback()
    assert releases.prune(1) == [second] and (releases.releases / ".git").exists()
    assert_drives(releases, {first})
    damage(releases.path_of("current"))
    assert releases.prune(1) == [] and releases.path_of("current").exists()


def test_a_damaged_release_takes_no_other_ones_place(releases, two, third):
    first, never = releases.current, content_hash(third)
    second = releases.stage(two[1]).name
    for name in (second, first):
        releases.switch(name)
    damage(releases.path_of(second))
    assert releases.prune(2) == [second]
    assert releases.current == first and releases.path_of(never).exists()


@pytest.mark.parametrize("spoiled", ["damaged", "gone", "elsewhere"])
def test_what_is_wrong_with_the_release_in_use_is_seen_and_healed(releases, two, spoiled):
    if spoiled == "damaged":
        damage(releases.path_of("current"))
    elif spoiled == "gone":
        releases.path_of("current").unlink()
    else:
        releases.current_link.unlink()
        releases.current_link.symlink_to("/etc")
    assert not releases.status()["healthy"] and rover("release", "--models", releases.models, "status").exit_code == 1
    with pytest.raises(RoverError):
        releases.verify()
    assert_drives(releases, {name := deploy(releases, two[0])})
    assert f"* {name[:12]}  static" in rover("release", "--models", releases.models, "status").output


def test_a_broken_history_a_wrong_clock_and_a_full_disk(releases, two, monkeypatch):
    (releases.models / "history.json").write_text('["../..", null]')
    old, new = releases.current, deploy(releases, two[1])
    os.utime(releases.current_link, (86_400, 86_400), follow_symlinks=False)
    assert releases.status()["since"].startswith("1970")
    assert releases.rollback() == old and releases.prune(1) == [new]
    monkeypatch.setattr(shutil, "disk_usage", lambda path: shutil._ntuple_diskusage(10**9, 10**9, 10**6))
    with pytest.raises(RoverError, match="1 MB free"):
        releases.stage(two[1])


def test_of_two_at_once_one_is_refused_and_tidies_nothing_up(releases, two):
    """Whatever rights the lock shows; and nobody else can open it later, as the one that older versions left."""
    half, lock = releases.releases / ".new", releases.models / ".lock"
    half.mkdir()
    with lock.open() as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        for command in (lambda: releases.stage(two[1]), releases.rollback, lambda: releases.prune(1)):
            with pytest.raises(RoverError):
                command()
            lock.chmod(0o644)
        assert half.exists() and releases.status()["healthy"]
    lock.chmod(0o644)
    assert_drives(releases, {deploy(releases, two[1])})
    assert not half.exists() and stat.S_IMODE(lock.stat().st_mode) == 0o600


PROGRAM = """#!/bin/sh
echo "$@" >> $(dirname $0)/asked
[ $(basename $0) = systemctl ] && exit 1
echo "rover: it computes something else here"
"""


def test_parity_in_the_services_sandbox(releases, two, tmp_path, monkeypatch):
    for name in ("systemctl", "journalctl"):
        script = tmp_path / name
        script.write_text(PROGRAM)
        script.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    old, name = releases.current, releases.stage(two[1]).name
    result = rover("release", "--models", releases.models, "--sandboxed", "switch", name)
    assert (tmp_path / "asked").read_text().startswith(f"start rover-check@{name}.service\n")
    assert result.exit_code == 1 and "computes something else" in result.output
    assert_drives(releases, {old})

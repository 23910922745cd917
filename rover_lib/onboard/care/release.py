"""Releases of the policy on the rover. Switching is atomic, even if the power fails at any moment.

    models/current              a symbolic link to releases/<content hash>, and the only truth about what is in use
    models/releases/<hash>/     policy.pt, and release.json: its SHA-256, and where it came from
    models/history.json         what was in use, the newest last; for rollback and prune
    models/.lock                held by whoever changes something

The power may fail between any two system calls. So all files of a release are synced before its folder gets its name,
and the folder before `current` is renamed. Leftovers of an interrupted command are removed by the next one.
"""

import contextlib
import json
import os
import re
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import Timeout

from rover_lib.onboard.artifact.acceptance import THIS_CAR, Expected, inspect_artifact
from rover_lib.onboard.durable import sync
from rover_lib.onboard.errors import RoverError, printable
from rover_lib.onboard.stage import private_lock, sha256_of

POLICY, ORIGIN = "policy.pt", "release.json"
NAME = re.compile(r"[0-9a-f]{64}")
SPARE_BYTES = 64 << 20  # left free for logs
HISTORY = 100
SANDBOX = "rover-check@{}.service"

Check = Callable[[str], None]  # takes a release's name or "current"; raises RoverError


@dataclass(frozen=True)
class Staged:
    """The result of staging. name: of the release. changed: whether it is new."""

    name: str
    changed: bool


class Releases:
    """The models of a rover.

    check: checks that a release computes correctly; None: by running its parity vectors. Every method that changes
    something holds the lock, and raises RoverError if another process holds it. After an error the release in use
    stays in use, unless the error says otherwise.
    """

    def __init__(self, models: Path | str, *, check: Check | None = None, expected: Expected = THIS_CAR):
        self.models = Path(models)
        self.releases = self.models / "releases"
        self.current_link = self.models / "current"
        self.expected = expected
        self.check = check or self.verify

    @property
    def current(self) -> str | None:
        """The name of the release in use; if `current` does not point to a release, the path that it points to."""
        try:
            target = str(self.current_link.readlink())
        except OSError:
            return None
        name = target.removeprefix("releases/")
        return name if NAME.fullmatch(name) else target

    def path_of(self, name: str) -> Path:
        """Return the path of the policy of a release, or of "current". Raises RoverError for an invalid name."""
        if name == "current":
            return self.current_link / POLICY
        if not NAME.fullmatch(name):
            raise RoverError("a release has 64 hexadecimal digits, or is 'current'", found=name, remedy="see status")
        return self.releases / name / POLICY

    def wrong_with(self, name: str) -> str:
        """Return what is wrong with the bytes of a release, "" if nothing. Needs no torch."""
        return self._look_at(name)["wrong"]

    def _look_at(self, name: str) -> dict[str, Any]:
        policy = self.releases / name / POLICY
        origin: Any = {}
        megabytes = 0.0
        wrong = ""
        try:
            megabytes = round(policy.stat().st_size / 1e6, 1)
            origin = json.loads(policy.with_name(ORIGIN).read_text())
            if origin["name"] != name or origin["sha256"] != sha256_of(policy):
                wrong = f"{POLICY} is not what {ORIGIN} says"
        except (OSError, ValueError, KeyError, TypeError, RoverError) as e:
            wrong = f"not readable ({type(e).__name__}: {e})"
        facts = dict.fromkeys(("mode", "origin", "sha256"), "?")
        if isinstance(origin, dict):
            facts |= {key: str(origin[key]) for key in facts if key in origin}
        return {"name": name, "current": name == self.current, "megabytes": megabytes, "wrong": wrong, **facts}

    def status(self) -> dict[str, Any]:
        """Return the present state: current, mode, since, healthy, trouble, releases, disk_free_mb.

        releases: name, current, mode, origin, sha256, megabytes and wrong of each, the last used first. since: when
        `current` was switched. healthy: whether the bytes of the release in use are intact; if not, trouble says why.
        """
        releases = [self._look_at(name) for name in self._by_use()]
        current = self.current
        since = None
        none = f"current points to {current}, not to a release" if current else "no model: deploy one"
        in_use = next((r for r in releases if r["current"]), {"mode": None, "wrong": none})
        with contextlib.suppress(OSError):
            since = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(self.current_link.lstat().st_mtime))
        nearest = next(p for p in (self.models, *self.models.absolute().parents) if p.exists())
        return {
            "current": current,
            "mode": in_use["mode"],
            "since": since,
            "healthy": not in_use["wrong"],
            "trouble": in_use["wrong"],
            "releases": releases,
            "disk_free_mb": round(shutil.disk_usage(nearest).free / 1e6),
        }

    def verify(self, name: str = "current") -> None:
        """Check that a release's bytes are intact, and that it computes correctly here (parity vectors), confined.

        Raises RoverError.
        """
        from rover_lib.onboard.policy.confined import run_confined

        path = self.path_of(name)
        if not path.exists():
            raise RoverError(f"{path}: not there", remedy="deploy one" if name == "current" else "stage it again")
        if wrong := self.wrong_with(path.parent.resolve().name):
            raise RoverError(f"{path}: {wrong}", remedy="deploy it again")
        run_confined(load_only, path=str(path))

    def stage(
        self, source: Path | str, *, sha256: str | None = None, origin: str | None = None, allow: Iterable[str] = ()
    ) -> Staged:
        """Make a release of an artifact. The release in use stays in use.

        sha256: what the file's must be, if it is known. origin: where the artifact came from; this host and its path if
        None. A release that exists and is intact stays as it is. The files of a damaged one are replaced, even while
        it is in use: each file is the old or the new one at any moment. Raises RoverError.
        """
        source = Path(source)
        with self._lock():
            free_mb = shutil.disk_usage(self.models).free / 1e6
            if free_mb < (wanted_mb := (source.stat().st_size + SPARE_BYTES) / 1e6):
                problem = f"{self.models}: {free_mb:.0f} MB free, {wanted_mb:.0f} are needed"
                raise RoverError(problem, remedy="prune releases")
            new = self.releases / ".new"
            new.mkdir()
            shutil.copyfile(source, new / POLICY)
            arrived = sha256_of(new / POLICY)
            if sha256 and arrived != sha256:
                raise RoverError(f"{source}: arrived damaged, not {sha256[:12]}", found=arrived, remedy="send it again")
            try:
                artifact = inspect_artifact(new / POLICY, self.expected, allow)
            except RoverError as e:
                problem = e.what.replace(str(new / POLICY), str(source))
                raise type(e)(problem, found=e.found, remedy=e.remedy) from None
            release = self.releases / artifact.content_hash
            if release.exists() and not self.wrong_with(release.name):
                return Staged(release.name, False)
            place = printable(origin or f"{socket.gethostname()}:{source.absolute()}")
            facts = {"schema": 1, "name": release.name, "sha256": arrived, "origin": place}
            (new / ORIGIN).write_text(json.dumps(facts | {"mode": artifact.manifest["mode"]}, indent=1) + "\n")
            for path, mode in ((new / POLICY, 0o644), (new / ORIGIN, 0o644), (new, 0o755)):
                path.chmod(mode)  # for the service's user, whatever the umask is
                sync(path)
            if release.exists():
                for file in (POLICY, ORIGIN):
                    (new / file).replace(release / file)
                sync(release)
            else:
                new.rename(release)
            sync(self.releases)
            return Staged(release.name, True)

    def switch(self, name: str) -> bool:
        """Check a release, switch to it, and check it again through `current`; switch back if that fails.

        Returns whether anything changed. Raises RoverError, whose text says which release is in use now.
        """
        with self._lock():
            before = self.current
            if name == "current":
                raise RoverError("'current' is in use already", remedy="name the release to switch to")
            self.check(name)
            if before == name:
                return False
            self._point_current_at(name)
            try:
                self.check("current")
            except BaseException as error:
                self._point_current_at(before)
                now = f"{before[:12]} is in use again" if before else "no model is in use, as before"
                if isinstance(error, RoverError):
                    raise RoverError(f"{name[:12]} failed after the switch, {now}: {error}") from error
                raise
            self._write_history([*self._history(), name])
            return True

    def rollback(self) -> str:
        """Switch to the newest earlier release that passes its checks. Returns its name. Raises RoverError."""
        with self._lock():
            refused = []
            for name in dict.fromkeys(reversed(_up_to_last(self._history(), self.current))):  # the newest first
                if name == self.current or not self.path_of(name).exists():
                    continue
                try:
                    self.check(name)
                except RoverError as error:
                    refused.append(f"{name[:12]}: {error}")
                    continue
                # Before the switch: after a power cut here, the next rollback starts from the same point.
                self._write_history(_up_to_last(self._history(), name))
                self._point_current_at(name)
                return name
            why = f" ({'; '.join(refused)})" if refused else ""
            now = f"{self.current[:12]} stays in use" if self.current else "no model is in use"
            raise RoverError(f"there is no release to roll back to{why}; {now}", remedy="deploy one instead")

    def prune(self, keep: int = 3) -> list[str]:
        """Remove all but the `keep` (from 1) releases used last, but never the one in use. Returns the removed names.

        A release that was never in use counts as older than any that was. Damaged releases are removed.
        """
        with self._lock():
            names = self._by_use()
            healthy = [name for name in names if not self.wrong_with(name)][:keep]
            removed = [name for name in names if name not in healthy and name != self.current]
            for name in removed:
                away = self.releases / f".gone-{name}"  # after a power cut it is there completely, or not at all
                (self.releases / name).rename(away)
                sync(self.releases)
                shutil.rmtree(away)
            if removed:
                self._write_history([name for name in self._history() if name not in removed])
            return removed

    @contextlib.contextmanager
    def _lock(self) -> Iterator[None]:
        """Hold the lock, and remove what an interrupted command left behind."""
        self.releases.mkdir(parents=True, exist_ok=True)
        try:
            lock = private_lock(self.models / ".lock").acquire()
        except Timeout:
            raise RoverError(f"{self.models}: another deployment is at work", remedy="wait for it") from None
        with lock:
            self._tidy()
            try:
                yield
            finally:
                with contextlib.suppress(OSError):  # what is left now is removed by the next command
                    self._tidy()

    def _tidy(self) -> None:
        ours = (*self.releases.glob(".new"), *self.releases.glob(".gone-*"), *self.models.glob(".new-*"))
        for path in ours:  # other files, such as a .git, stay
            shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
        history = self._history()
        if (current := self.current) in self._by_use() and history[-1:] != [current]:
            self._write_history([*history, current])  # a switch was interrupted before the history was written

    def _point_current_at(self, name: str | None) -> None:
        """Switch `current` to a release, atomically and synced; remove it for None."""
        if name is None:
            self.current_link.unlink()
        else:
            new = self.models / ".new-current"
            new.symlink_to(Path("releases", name))
            new.replace(self.current_link)
        sync(self.models)

    def _history(self) -> list[str]:
        try:
            names = json.loads((self.models / "history.json").read_text())
            return [n for n in names if isinstance(n, str) and NAME.fullmatch(n)]
        except (OSError, ValueError, TypeError):
            return []

    def _write_history(self, names: list[str]) -> None:
        """Write the history, if there is room: a full disk must not prevent a rollback. The next command mends it."""
        new = self.models / ".new-history"
        with contextlib.suppress(OSError):
            new.write_text(json.dumps(names[-HISTORY:], indent=1) + "\n")
            sync(new)
            new.replace(self.models / "history.json")
            sync(self.models)

    def _by_use(self) -> list[str]:
        names = sorted(p.name for p in self.releases.glob("*") if NAME.fullmatch(p.name))
        used = dict.fromkeys([self.current, *reversed(self._history())])
        return [n for n in used if n in names] + [n for n in names if n not in used]


def load_only(path: str) -> None:
    """Load an artifact in a process that confines itself: for run_confined()."""
    from rover_lib.onboard.policy.confined import load_confined

    load_confined({"artifact": path}, threads=os.cpu_count() or 1)


def check_in_sandbox(name: str) -> None:
    """Check a release by `rover release verify NAME` in the service's sandbox, with the unit of provision.yml.

    Raises RoverError, with the check's own sentence, if it does not pass.
    """
    unit = SANDBOX.format(name)
    started = subprocess.run(["systemctl", "start", unit], capture_output=True, text=True)
    if started.returncode:
        ask = ["journalctl", "--unit", unit, "--output=cat", "--grep=^rover: ", "--lines=1"]
        message = subprocess.run(ask, capture_output=True, text=True).stdout.strip().removeprefix("rover: ")
        raise RoverError(f"{unit}: {message or started.stderr.strip() or f'exit code {started.returncode}'}")


def _up_to_last(history: list[str], name: str | None) -> list[str]:
    """Return the history up to the last time that a release was in use; all of it if it never was."""
    return history[: len(history) - history[::-1].index(name)] if name in history else history

"""Releases of the policy on the rover. Switching is atomic, even if the power fails at any moment.

    releases = Releases("/var/lib/rover/models")
    name = releases.stage("/var/lib/rover/incoming").name    # what pack() wrote, or an artifact
    releases.switch(name)                                     # checked before and after; rolls back by itself

    models/current              a symbolic link to releases/<content hash>, and the only truth about what is in use
    models/releases/<hash>/     policy.pt, policy.pt.sha256 (for sha256sum -c), policy.pt.sig (its signature, for
                                ssh-keygen -Y verify) and release.json: where it came from
    models/history.json         what was in use, the newest last; for rollback and prune
    models/.lock                held by whoever changes something

The power may fail between any two system calls, and whatever was not synced is then lost. So all files of a release are
synced before its folder gets its name, and the folder before `current` is renamed. Leftovers of an interrupted command
(.new, .gone-... and .new-...) are removed by the next command. No decision depends on the clock.
"""

import contextlib
import errno
import fcntl
import hashlib
import json
import os
import re
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, BinaryIO

from rover_lib.onboard.artifact.archive import ARCHIVE_BYTES, ONNX
from rover_lib.onboard.artifact.engines import PACKAGES, TORCH
from rover_lib.onboard.artifact.manifest import Artifact
from rover_lib.onboard.errors import ArtifactError, RoverError
from rover_lib.onboard.policy.confine import less_memory
from rover_lib.onboard.stage import open_plain, sha256_of, version_of

MODELS = Path("/var/lib/rover/models")
POLICY, DIGEST, ORIGIN = "policy.pt", "policy.pt.sha256", "release.json"
SIGNATURE = "policy.pt.sig"
SIGNERS = Path("/etc/rover/allowed_signers")  # in the format of ssh-keygen(1); provision.yml writes it
SIGNER, NAMESPACE = "rover", "rover-policy"  # the principal there, and what a signature is for
NAME = re.compile(r"([0-9a-f]{64})(-\d+)?")  # ...-2: a second copy, because the first was damaged while in use
COPIED_BYTES = 8 << 20  # at once
SPARE_BYTES = 64 << 20  # left free for logs
JSON_BYTES = 100_000  # largest release.json or history.json
HISTORY = 100
LOCK_TRIES, LOCK_S = 5, 0.05
SANDBOX = "rover-check@{}.service"

STAGE_MB = 400  # memory that staging may take: until an artifact is staged, it is not trusted
# What can be allowed to differ. Torch, engine and actions cannot: this rover could not drive with others.
MAY_DIFFER = ("mode", "chunk", "camera", "aspect")
CODE_OF_MODE = {"static": b"ops.quantized.conv2d", "mixed": b"ops.quantized.conv2d", "dynamic": b"linear_dynamic"}
ONNX_OF_MODE = {"static": b"QuantizeLinear", "mixed": b"QuantizeLinear"}
OF_MODE: dict[str, dict[str, bytes]] = {"torch": CODE_OF_MODE, "onnxruntime": ONNX_OF_MODE, "hailo": {}}

Check = Callable[[str], None]  # takes a release's name or "current"; raises RoverError


class ReleaseError(RoverError):
    """A deployment that failed. The release in use stays in use, unless the error says otherwise."""


@dataclass(frozen=True)
class Expected:
    """The artifacts that a rover accepts. camera: its name in the manifest. aspect: width / height of its frames."""

    chunk: int = 32
    camera: str = "cam_front"
    aspect: float = 16 / 9
    modes: tuple[str, ...] = ("static", "mixed")

    def refusals(self, manifest: dict[str, Any]) -> dict[str, str]:
        """Return reasons to refuse an artifact, by kind.

        The kinds are those of MAY_DIFFER, and "torch", "engine", "actions" and "state".
        """
        refusals = {}
        if manifest["mode"] not in self.modes:
            refusals["mode"] = f"its mode is {manifest['mode']}, which is several times slower than {self.modes[0]}"
        if manifest["chunk"] != self.chunk:
            refusals["chunk"] = f"it plans {manifest['chunk']} actions, this rover takes {self.chunk}"
        cameras = ", ".join(f"{c['name']} {c['width']}x{c['height']}" for c in manifest["cameras"])
        if [c["name"] for c in manifest["cameras"]] != [self.camera]:
            refusals["camera"] = f"it looks through {cameras}, this rover has {self.camera}"
        if any(round(c["width"] / c["height"], 1) != round(self.aspect, 1) for c in manifest["cameras"]):
            refusals["aspect"] = f"it looks through {cameras}, this rover's pictures are {self.aspect:.2f} to 1"
        engine, made_with = manifest["engine"], str(manifest["versions"].get("torch", "?"))
        package = PACKAGES.get(engine)
        here = version_of(package) if package else None
        if package is None:
            refusals["engine"] = f"it needs the engine '{engine}', rovers have {' or '.join(PACKAGES)}"
        elif here is None:
            refusals["engine"] = f"it needs {package}, which is not installed here"
        elif engine == TORCH and made_with.split(".")[:2] != here.split(".")[:2]:
            refusals["torch"] = f"it was made with torch {made_with}, rovers have {here}"
        for kind, key, does in (("actions", "action_names", "gives"), ("state", "state_names", "is told")):
            if manifest[key] != ["steering", "throttle"]:
                refusals[kind] = f"it {does} {', '.join(manifest[key])}, this car has steering and throttle"
        return refusals


THIS_CAR = Expected()


def inspect_artifact(path: Path | str, expected: Expected = THIS_CAR, allow: Iterable[str] = ()) -> Artifact:
    """Check that an artifact may be deployed, without running it; return it, closed.

    allow: kinds of refusal to ignore, of those in MAY_DIFFER. Raises ArtifactError for a damaged file or a manifest
    that does not fit the code beside it, ReleaseError for an artifact that this rover does not accept.
    """
    allow = set(allow)
    if unknown := allow - set(MAY_DIFFER):
        raise ReleaseError(f"only {', '.join(MAY_DIFFER)} can be allowed", found=", ".join(sorted(unknown)))
    with Artifact(path) as artifact:
        artifact.prove()
        manifest = artifact.manifest
        code = b"".join(artifact.record(n) for n in artifact.names if n.endswith(".py") or n == ONNX)
        if (wanted := OF_MODE[artifact.kind].get(manifest["mode"])) and wanted not in code:
            what = f"{path}: its manifest says {manifest['mode']}, its code is not"
            raise ArtifactError(what, remedy="quantize again")
        for kind, why in expected.refusals(manifest).items():
            if kind not in allow:
                remedy = f"deploy another, or allow it: {kind}" if kind in MAY_DIFFER else "deploy another"
                raise ReleaseError(f"{path}: {why}", remedy=remedy)
        _ = artifact.parity  # has the shapes that the manifest says
    return artifact


def pack(
    artifact: Path | str,
    folder: Path | str,
    expected: Expected = THIS_CAR,
    allow: Iterable[str] = (),
    key: Path | str | None = None,
) -> dict[str, Any]:
    """Put a copy of an artifact into a folder of its own, with its signature and a release.json that describes it.

    What an earlier pack() has left in the folder is replaced. key: ssh key to sign the artifact with; a rover accepts
    only artifacts that its own laptops have signed. Returns the content of release.json: name (the content hash),
    sha256, bytes, mode, origin. Raises as inspect_artifact(). Raises ReleaseError, and changes nothing, if the key
    cannot sign or the folder holds other files.
    """
    artifact, folder = Path(artifact), Path(folder)
    inspected = inspect_artifact(artifact, expected, allow)
    signature = sign(artifact, key) if key else None
    for old in _read_earlier_pack(artifact, folder):
        old.unlink()
    folder.mkdir(parents=True, exist_ok=True)
    about = _about(inspected)
    try:
        (folder / ORIGIN).write_text(json.dumps(about, indent=1, sort_keys=True) + "\n")
        if signature:
            (folder / SIGNATURE).write_bytes(signature)
        shutil.copyfile(artifact, folder / POLICY)
    except BaseException:
        for half in _read_earlier_pack(artifact, folder):  # make room on a full disk
            half.unlink()
        raise
    return about


def _read_earlier_pack(artifact: Path, folder: Path) -> list[Path]:
    """Return the files of an earlier pack(), release.json last. Raises ReleaseError if there are other files."""
    if not folder.exists():
        return []
    remedy = "pack into a folder of its own"
    if not folder.is_dir():
        raise ReleaseError(f"{folder}: not a folder", remedy=remedy)
    files = sorted(folder.iterdir(), key=lambda p: (p.name == ORIGIN, p.name))
    names = (POLICY, SIGNATURE, ORIGIN) if (folder / ORIGIN).is_file() else ()  # a policy.pt alone is somebody's
    ours = [p for p in files if p.is_file() and p.name in names and not p.samefile(artifact)]
    if others := [p for p in files if p not in ours]:
        more = f" and {len(others) - 1} more" if len(others) > 1 else ""
        raise ReleaseError(
            f"{folder}: holds files that 'rover release pack' did not write",
            found=f"{others[0].name}{more}",
            remedy=remedy,
        )
    return ours


def sign(artifact: Path | str, key: Path | str) -> bytes:
    """Sign an artifact by `ssh-keygen -Y sign` and return the signature. A key in the ssh agent is used from there.

    Raises ReleaseError.
    """
    with _open_file(artifact) as content:
        return _ssh_keygen(["sign", "-f", key], content, f"{artifact}: cannot be signed", "is it the right key?")


def check_signature(artifact: Path | str, signature: Path | str, signers: Path | str) -> None:
    """Raise ReleaseError unless one of the signers has signed exactly this artifact."""
    remedy = "deploy it from a laptop that has provisioned this rover, or say --unsigned (rover_unsigned=true)"
    for path, what in ((signature, f"{artifact}: not signed"), (signers, f"{signers}: this rover knows no laptop")):
        if not Path(path).is_file():
            raise ReleaseError(what, remedy=remedy)
    with _open_file(artifact) as content:
        call = ["verify", "-f", signers, "-I", SIGNER, "-s", signature]
        _ssh_keygen(call, content, f"{artifact}: not signed by a laptop that this rover knows", remedy)


def _ssh_keygen(call: list[Any], content: BinaryIO, what: str, remedy: str) -> bytes:
    try:
        command = ["ssh-keygen", "-Y", *map(str, call), "-n", NAMESPACE]
        done = subprocess.run(command, stdin=content, capture_output=True, timeout=60)
    except (OSError, subprocess.SubprocessError) as e:
        raise ReleaseError(f"{what} ({e})", remedy="apt install openssh-client") from None
    if done.returncode:
        why = done.stderr.decode(errors="replace").strip().splitlines()
        raise ReleaseError(f"{what} ({why[-1][:200] if why else f'exit code {done.returncode}'})", remedy=remedy)
    return done.stdout


def _about(artifact: Artifact) -> dict[str, Any]:
    manifest = artifact.manifest
    return {
        "schema": 1,
        "name": artifact.content_hash,
        "sha256": sha256_of(artifact.path),
        "bytes": artifact.path.stat().st_size,
        "mode": manifest["mode"],
        # No time: to Ansible, the same artifact from the same place must look unchanged.
        "origin": {"file": _file(artifact.path), "host": socket.gethostname()},
        "checkpoint": manifest["checkpoint"].get("sha256", ""),
    }


def _file(path: Path) -> str:
    """Return a file's path as printable text, which a rover insists on: a folder's name may hold a no-break space."""
    text = str(path.absolute())
    return text if text.isprintable() else ascii(text)[1:-1]


@dataclass(frozen=True)
class Staged:
    """The result of staging. name: of the release. changed: whether it is new."""

    name: str
    changed: bool


@dataclass(frozen=True)
class Release:
    """One release on the disk.

    signed: whether a laptop that the rover knows now has signed it. wrong: what is wrong with its bytes, "" if nothing.
    """

    name: str
    current: bool
    mode: str
    origin: str
    megabytes: float
    signed: bool
    wrong: str


class Releases:
    """The models of a rover.

    check: checks that a release computes correctly; None: by running its parity vectors. signers: file of the accepted
    signers, SIGNERS if None. Every method that changes something holds the lock, and raises ReleaseError if another
    process holds it.
    """

    def __init__(
        self,
        models: Path | str = MODELS,
        *,
        check: Check | None = None,
        expected: Expected = THIS_CAR,
        signers: Path | str | None = None,
    ):
        self.models = Path(models)
        self.releases = self.models / "releases"
        self.current_link = self.models / "current"
        self.expected, self.signers = expected, Path(signers or SIGNERS)
        self.check = check or self.verify

    # Questions

    @property
    def current(self) -> str | None:
        """The name of the release in use; if `current` does not point to a release, the path that it points to."""
        try:
            target = str(self.current_link.readlink())
        except OSError:
            return None
        name = target.removeprefix("releases/")
        return name if NAME.fullmatch(name) else target

    @property
    def policy(self) -> Path:
        """The artifact that the service loads."""
        return self.current_link / POLICY

    def path_of(self, name: str) -> Path:
        """Return the path of the policy of a release, or of "current". Raises ReleaseError for an invalid name."""
        if name == "current":
            return self.policy
        if not NAME.fullmatch(name):
            raise ReleaseError(
                "a release is named by 64 hexadecimal digits or 'current'", found=f"'{name}'", remedy="see status"
            )
        return self.releases / name / POLICY

    def wrong_with(self, name: str, then: Callable[[Artifact], object] = lambda artifact: None) -> str:
        """Return what is wrong with the bytes of a release, "" if nothing. Needs no torch.

        then: called with the intact artifact while it is open; what it raises is passed on.
        """
        folder, named = self.releases / name, NAME.fullmatch(name)
        if not named:
            return f"'{name}' is no content hash"
        with contextlib.ExitStack() as stack:
            try:
                _read_json(folder / ORIGIN)
                with _open_file(folder / DIGEST) as file:
                    digest = file.read(JSON_BYTES).decode()
                if digest.split()[:1] != [sha256_of(folder / POLICY)]:
                    return f"{POLICY} is not what {DIGEST} says"
                artifact = stack.enter_context(Artifact(folder / POLICY))
                content = artifact.content_hash
            except Exception as e:  # whatever prevents reading it is the answer
                return f"not readable ({type(e).__name__}: {e})"
            if content != named[1]:
                return f"tampered with: its content is {content[:12]}, not what its folder is named after"
            then(artifact)
            return ""

    def all(self) -> list[Release]:
        """Return all releases: the one in use, then those used before, the latest first, then those never used."""
        current, releases = self.current, []
        for name in self._by_use():
            try:
                about = _read_json(self.releases / name / ORIGIN)
                mode, origin = str(about["mode"]), "{host}:{file}".format(**about["origin"])
                megabytes = (self.releases / name / POLICY).stat().st_size / 1e6
            except (OSError, ValueError, KeyError, TypeError, ReleaseError):
                mode, origin, megabytes = "?", "?", 0.0
            wrong = self.wrong_with(name)
            signed = not wrong and self.is_signed(name)
            releases.append(Release(name, name == current, mode, origin, round(megabytes, 1), signed, wrong))
        return releases

    def status(self) -> dict[str, Any]:
        """Return the present state: current, mode, since, healthy, trouble, can_roll_back_to, releases, and others.

        healthy: whether the bytes of the release in use are intact; if not, trouble says why. disk_free_mb: free space
        where the models are. at_work: whether a command holds the lock.
        """
        releases = self.all()
        in_use = next((r for r in releases if r.current), None)
        wrong = {r.name: r.wrong for r in releases}  # each is read and hashed once
        if self.current is None:
            trouble = "no model: deploy one"
        elif in_use is None:
            trouble = f"current points to {self.current}, which is no release: deploy or roll back"
        else:
            trouble = in_use.wrong
        return {
            "current": self.current,
            "mode": in_use.mode if in_use else None,
            "since": self._since(),
            "healthy": not trouble,
            "trouble": trouble,
            "can_roll_back_to": next((n for n in self._used_before() if wrong.get(n) == ""), None),
            "releases": [asdict(r) for r in releases],
            "disk_free_mb": round(shutil.disk_usage(self._nearest_folder()).free / 1e6),
            "at_work": self._locked_by_another(),
        }

    def verify(self, name: str = "current") -> None:
        """Check that a release's bytes are intact, and that it computes correctly here (parity vectors).

        Raises ReleaseError or ArtifactError.
        """
        path = self.path_of(name)
        if not path.exists():
            raise ReleaseError(f"{path}: not there", remedy="deploy one" if name == "current" else "stage it again")
        from rover_lib.onboard.policy.load import load_policy

        real = path.parent.resolve().name
        if wrong := self.wrong_with(real, load_policy):
            raise ReleaseError(f"{path}: {wrong}", remedy="deploy it again")

    # Changes

    def stage(
        self, source: Path | str, *, sha256: str | None = None, allow: Iterable[str] = (), unsigned: bool = False
    ) -> Staged:
        """Make a release of an artifact, or of a folder that pack() wrote. The release in use stays in use.

        The signature is policy.pt.sig in that folder, or lies beside the artifact with .sig added to its name. sha256:
        what the artifact's must be, if it is known. unsigned: accept it without a signature. A release that exists and
        is intact only gets the signature that it may lack. A damaged one is replaced; if it is in use, a second copy
        is made beside it. Raises ReleaseError, ArtifactError.
        """
        source = Path(source)
        with _disk_errors_explained(), _memory_limited(source), self._exclusively():
            if not source.exists():
                raise ReleaseError(
                    f"{source}: not found", remedy="stage takes an artifact, or the folder that pack wrote"
                )
            about = self._packed(source) if source.is_dir() else None
            if about and (existing := self._intact(about["name"])):
                return self._accept(existing, source / SIGNATURE, unsigned)
            self._check_free_space(about["bytes"] if about else source.stat().st_size)
            new = self.releases / ".new"
            new.mkdir()
            new.chmod(0o755)  # whatever the umask is: the service's user must be able to read it
            artifact, most = (source / POLICY, about["bytes"]) if about else (source, ARCHIVE_BYTES)
            arrived, wanted = _copy(artifact, new / POLICY, most), sha256 or (about or {}).get("sha256")
            if wanted and arrived != wanted:
                raise ReleaseError(
                    f"{source}: arrived damaged (sha256 {arrived[:12]}, not {wanted[:12]})", remedy="send it again"
                )
            try:
                if not unsigned:
                    signature = Path(f"{artifact}.sig")
                    check_signature(new / POLICY, signature, self.signers)
                    _copy(signature, new / SIGNATURE, JSON_BYTES)
                here = _about(inspect_artifact(new / POLICY, self.expected, allow))
            except RoverError as e:
                what = e.what.replace(str(new / POLICY), str(source))
                raise type(e)(what, found=e.found, remedy=e.remedy) from None
            if about and about["name"] != here["name"]:
                raise ReleaseError(
                    f"{source}: contains {here['name'][:12]}, not {about['name'][:12]}", remedy="pack it again"
                )
            here["origin"] = about["origin"] if about else {**here["origin"], "file": _file(source)}
            if existing := self._intact(here["name"]):
                return self._accept(existing, new / SIGNATURE, unsigned)
            _write(new / DIGEST, [f"{arrived}  {POLICY}\n".encode()])
            _write(new / ORIGIN, [json.dumps(here, indent=1, sort_keys=True).encode() + b"\n"])
            _sync(new)
            name = self._new_name(here["name"])
            new.rename(self.releases / name)
            _sync(self.releases)
            return Staged(name, True)

    def _accept(self, name: str, signature: Path, unsigned: bool) -> Staged:
        """Stage an intact release again. One that came in unsigned needs a signature now, unless `unsigned`."""
        if unsigned or self.is_signed(name):
            return Staged(name, False)
        policy = self.path_of(name)
        check_signature(policy, signature, self.signers)
        new = policy.with_name(f".{SIGNATURE}")
        new.unlink(missing_ok=True)
        _copy(signature, new, JSON_BYTES)
        new.replace(policy.with_name(SIGNATURE))
        _sync(policy.parent)
        return Staged(name, True)

    def is_signed(self, name: str) -> bool:
        """Whether a laptop that this rover knows now has signed the release."""
        try:
            check_signature(self.releases / name / POLICY, self.releases / name / SIGNATURE, self.signers)
        except ReleaseError:
            return False
        return True

    def switch(self, name: str, *, unsigned: bool = False) -> bool:
        """Check a release, switch to it, and check it again through `current`; switch back if that fails.

        unsigned: use it also if no laptop that this rover knows now has signed it. Returns whether anything changed.
        Raises ReleaseError, whose text says which release is in use now.
        """
        with _disk_errors_explained(), self._exclusively():
            before = self.current
            if name == "current":
                raise ReleaseError("'current' is in use already", remedy="name the release to switch to")
            self.path_of(name)
            self.check(name)
            if not unsigned:
                policy = self.path_of(name)
                try:
                    check_signature(policy, policy.with_name(SIGNATURE), self.signers)
                except ReleaseError as error:
                    raise ReleaseError(f"{error.what}; {self._in_use()}", remedy=error.remedy) from None
            if before == name:
                return False
            self._point_current_at(name)
            try:
                self.check("current")
            except BaseException as error:
                self._point_current_at(before)
                now = f"{before[:12]} is in use again" if before else "no model is in use, as before"
                if isinstance(error, RoverError):
                    raise ReleaseError(f"{name[:12]} failed after the switch, {now}: {error}") from error
                raise
            self._write_history([*self._history(), name])
            return True

    def rollback(self) -> str:
        """Switch to the newest earlier release that passes its checks. Returns its name.

        One that was accepted unsigned may come back. One whose key this rover no longer knows may not.
        """
        with _disk_errors_explained(), self._exclusively():
            refused = []
            for name in self._used_before():
                try:
                    if (self.releases / name / SIGNATURE).exists() and not self.is_signed(name):
                        raise ReleaseError("the laptop that signed it is not known any more")
                    self.check(name)
                except RoverError as error:
                    refused.append(f"{name[:12]}: {error}")
                    continue
                history = self._history()
                # Before the switch: after a power cut here, the next rollback starts from the same point.
                self._write_history(history[: len(history) - history[::-1].index(name)])
                self._point_current_at(name)
                return name
            why = f" ({'; '.join(refused)})" if refused else ""
            raise ReleaseError(
                f"there is no release to roll back to{why}; {self._in_use()}", remedy="deploy one instead"
            )

    def prune(self, keep: int = 3) -> list[str]:
        """Remove all but the `keep` releases used last, but never the one in use. Returns the removed names.

        A release that was never in use counts as older than any that was. Damaged releases are removed.
        """
        if keep < 1:
            raise ReleaseError("at least 1 release is kept", found=keep)
        with _disk_errors_explained(), self._exclusively():
            whole = [name for name in self._by_use() if not self.wrong_with(name)]
            removed = [name for name in self._by_use() if name not in whole[:keep] and name != self.current]
            for name in removed:
                self._remove(self.releases / name)
            if removed:
                self._write_history([name for name in self._history() if name not in removed])
            return removed

    # How

    @contextlib.contextmanager
    def _exclusively(self) -> Iterator[None]:
        """Hold the lock, and remove what an interrupted command left behind."""
        self.releases.mkdir(parents=True, exist_ok=True)
        file = os.open(self.models / ".lock", os.O_RDWR | os.O_CREAT, 0o644)
        try:
            self._lock(file)
            self._tidy()
            try:
                yield
            finally:
                with contextlib.suppress(OSError):  # what is left now is removed by the next command
                    self._tidy()
        finally:
            os.close(file)

    def _lock(self, file: int) -> None:
        for left in reversed(range(LOCK_TRIES)):  # status() holds it for a moment, to see whether another does
            try:
                return fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                if left:
                    time.sleep(LOCK_S)
        raise ReleaseError(f"{self.models}: another deployment is at work", remedy="wait for it (status says at_work)")

    def _tidy(self) -> None:
        ours = (*self.releases.glob(".new"), *self.releases.glob(".gone-*"), *self.models.glob(".new-*"))
        for left in ours:  # other files, such as a .git, stay
            shutil.rmtree(left) if left.is_dir() and not left.is_symlink() else left.unlink()
        history = self._history()
        if (current := self.current) in self._by_use() and history[-1:] != [current]:
            self._write_history([*history, current])  # a switch was interrupted before the history was written

    def _locked_by_another(self) -> bool:
        try:
            file = os.open(self.models / ".lock", os.O_RDONLY)
        except OSError:
            return False
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
        finally:
            os.close(file)
        return False

    def _packed(self, folder: Path) -> dict[str, Any]:
        try:
            about = _read_json(folder / ORIGIN)
            if not (NAME.fullmatch(about["name"]) and NAME.fullmatch(about["sha256"])):
                raise ValueError("its name or sha256 is not a hash")
            origin = {key: about["origin"][key] for key in ("file", "host")}
            if not all(isinstance(v, str) and v.isprintable() for v in origin.values()):
                raise ValueError("its origin is not printable text")
            if not isinstance(about["bytes"], int) or not 0 < about["bytes"] <= ARCHIVE_BYTES:
                raise ValueError("its size is impossible")
            return {key: about[key] for key in ("name", "sha256", "bytes")} | {"origin": origin}
        except (OSError, ValueError, KeyError, TypeError, ReleaseError) as e:
            raise ReleaseError(
                f"{folder / ORIGIN}: not what 'rover release pack' writes ({e})", remedy="send it again"
            ) from None

    def _check_free_space(self, needed: int) -> None:
        free = shutil.disk_usage(self.models).free
        if free < needed + SPARE_BYTES:
            wanted_mb = (needed + SPARE_BYTES) / 1e6
            raise ReleaseError(
                f"{self.models}: {free / 1e6:.0f} MB free, {wanted_mb:.0f} are needed", remedy="prune releases"
            )

    def _intact(self, content: str) -> str | None:
        """Return the name of an intact release with that content, preferably the one in use; None if there is none."""
        return next((n for n in self._by_use() if n.startswith(content) and not self.wrong_with(n)), None)

    def _new_name(self, content: str) -> str:
        """Return a free name for a release with that content. An old one of the name is removed unless it is in use."""
        name, number = content, 1
        while (self.releases / name).exists():
            if name != self.current:
                self._remove(self.releases / name)
                break
            number += 1
            name = f"{content}-{number}"
        return name

    def _exists(self, name: str) -> bool:
        return (self.releases / name / POLICY).exists()

    def _in_use(self) -> str:
        return f"{self.current[:12]} stays in use" if self.current else "no model is in use"

    def _since(self) -> str | None:
        """Return when `current` was switched, by the clock at that time; None if there is none."""
        try:
            return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(self.current_link.lstat().st_mtime))
        except (OSError, ValueError, OverflowError):
            return None

    def _nearest_folder(self) -> Path:
        """Return the models' folder, or the nearest parent folder that exists."""
        return next(p for p in (self.models, *self.models.absolute().parents) if p.exists())

    def _point_current_at(self, name: str | None) -> None:
        """Switch `current` to a release, atomically and synced; remove it for None."""
        if name is None:
            self.current_link.unlink()
        else:
            new = self.models / ".new-current"
            new.symlink_to(Path("releases", name))
            if self.current_link.is_dir() and not self.current_link.is_symlink():  # not ours: that is a link
                self.current_link.rename(self.models / ".new-was-current")  # the next command removes it
            new.replace(self.current_link)
        _sync(self.models)

    def _history(self) -> list[str]:
        try:
            names = _read_json(self.models / "history.json")
            return [n for n in names if isinstance(n, str) and NAME.fullmatch(n)]
        except (OSError, ValueError, TypeError, ReleaseError):
            return []

    def _write_history(self, names: list[str]) -> None:
        """Write the history, if there is room. A full disk must not prevent a rollback or pruning.

        If there was no room, the next command adds what is missing.
        """
        new = self.models / ".new-history"
        with contextlib.suppress(OSError):
            _write(new, [json.dumps(names[-HISTORY:]).encode()])
            new.replace(self.models / "history.json")
            _sync(self.models)

    def _used_before(self) -> list[str]:
        """Return the releases that were in use before the present one and still exist: the newest first, each once."""
        history, current = self._history(), self.current
        if current in history:
            history = history[: len(history) - history[::-1].index(current)]
        return [n for n in dict.fromkeys(reversed(history)) if n != current and self._exists(n)]

    def _by_use(self) -> list[str]:
        names = sorted(p.name for p in self.releases.glob("*") if NAME.fullmatch(p.name))
        used = dict.fromkeys([self.current, *reversed(self._history())])
        return [n for n in used if n in names] + [n for n in names if n not in used]

    def _remove(self, folder: Path) -> None:
        """Remove a folder of releases/. After a power cut it is there completely, or not at all."""
        away = self.releases / f".gone-{folder.name}"
        folder.rename(away)
        _sync(self.releases)
        shutil.rmtree(away)


def check_in_sandbox(name: str) -> None:
    """Check a release by `rover release verify NAME` in the service's sandbox, with the unit of provision.yml.

    Raises ReleaseError, with the check's own sentence, if it does not pass.
    """
    unit = SANDBOX.format(name)
    started = subprocess.run(["systemctl", "start", unit], capture_output=True, text=True)
    if started.returncode:
        journal = subprocess.run(
            ["journalctl", "--unit", unit, "--output=cat", "--grep=^rover: ", "--lines=1"],
            capture_output=True,
            text=True,
        )
        why = (
            journal.stdout.strip().removeprefix("rover: ")
            or started.stderr.strip()
            or f"exit code {started.returncode}"
        )
        raise ReleaseError(f"{unit}: {why}")


@contextlib.contextmanager
def _memory_limited(source: Path) -> Iterator[None]:
    try:
        with less_memory(STAGE_MB):
            yield
    except MemoryError:
        raise ReleaseError(
            f"{source}: staging it would take more than {STAGE_MB} MB of memory", remedy="is it an artifact of ours?"
        ) from None


@contextlib.contextmanager
def _disk_errors_explained() -> Iterator[None]:
    try:
        yield
    except OSError as e:
        if e.errno in (errno.ENOSPC, errno.EDQUOT):
            raise ReleaseError(
                "the disk is full; what was in use still is", remedy="prune releases or old recordings"
            ) from e
        if e.errno in (errno.EROFS, errno.EIO):  # a worn-out card fails like this
            raise ReleaseError(
                f"the disk cannot be written ({e.strerror}); what was in use still is",
                remedy="look at dmesg, use another card",
            ) from e
        raise


def _open_file(path: Path | str) -> BinaryIO:
    return open_plain(path, ReleaseError(f"{path}: not a file", remedy="send it again"))


def _read_json(path: Path) -> Any:
    """Return the content of a small JSON file. Raises ValueError, OSError or ReleaseError."""
    with _open_file(path) as file:
        text = file.read(JSON_BYTES + 1)
    if len(text) > JSON_BYTES:
        raise ValueError(f"more than {JSON_BYTES} bytes")
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def _copy(source: Path, target: Path, most: int) -> str:
    """Copy a file into a new, synced one, and return its SHA-256.

    Raises ReleaseError if it is missing, or has more than `most` bytes.
    """
    digest = hashlib.sha256()

    def contents() -> Iterator[bytes]:
        left = most
        with _open_file(source) as file:
            while content := file.read(min(COPIED_BYTES, left + 1)):
                if (left := left - len(content)) < 0:
                    raise ReleaseError(f"{source}: larger than it can be", remedy="send it again")
                digest.update(content)
                yield content

    try:
        _write(target, contents(), os.O_EXCL)
    except FileNotFoundError:
        raise ReleaseError(f"{source}: not arrived", remedy="send it again") from None
    return digest.hexdigest()


def _write(path: Path, contents: Iterable[bytes], how: int = os.O_TRUNC) -> None:
    file = os.open(path, os.O_WRONLY | os.O_CREAT | how, 0o644)
    try:
        os.fchmod(file, 0o644)
        for content in contents:
            left = memoryview(content)
            while left:
                left = left[os.write(file, left) :]
        os.fsync(file)
    finally:
        os.close(file)


def _sync(folder: Path) -> None:
    """Write a folder to the disk: only then does a rename in it survive a power cut."""
    file = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(file)
    finally:
        os.close(file)

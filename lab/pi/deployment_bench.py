"""The bench for deployments: a rover that is deployed to while something goes wrong, and the network to it.

It sees on the rover's disk how far a deployment has come, by looking
at it from this machine every millisecond or so. So the code that is deployed needs no hook for tests.
"""

import contextlib
import io
import json
import os
import shutil
import tempfile
import threading
import time
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_EXCEPTION, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lab.pi import playbooks
from lab.pi.container import Container
from lab.pi.emulation import EmulationError, wait_for
from lab.pi.network import Network
from lab.pi.playbooks import Play
from rover_lib.onboard.care.release import POLICY, Releases, pack

STATE = "var/lib/rover"  # on the rover; it has models/, which has incoming/
ROVER = "/opt/rover/venv/bin/rover"
CHECK = "rover-check@{}.service"
LOOK_S = 0.001  # between looks at the disk
PLAY_S = 1800.0
CHECK_S = 600.0
INTO_CHECK_S = 1.0  # how long a health check runs before something is done to it
CGROUPS = Path("/sys/fs/cgroup")


class Missed(EmulationError):
    """A moment of a deployment passed unseen, so the row proves nothing."""


# What is on the disk


@dataclass(frozen=True)
class Disk:
    """How far a deployment has come, by what is on the rover's disk.

    ready: whether there is a folder for what arrives. sending: whether a part of the policy is where Ansible keeps it
    until all of it is there. arrived: the names of the files that have arrived. complete: whether these are all.
    staging: the files of a release that has no name yet, with their bytes. staged: whether its policy is complete.
    released: whether the release has its name. switched: whether it is in use. remembered: whether it was proven again
    since then.
    """

    ready: bool = False
    sending: bool = False
    arrived: tuple[str, ...] = ()
    complete: bool = False
    staging: Mapping[str, int] = field(default_factory=dict)
    staged: bool = False
    released: bool = False
    switched: bool = False
    remembered: bool = False

    @classmethod
    def seen(cls, state: Path, about: Mapping[str, Any]) -> "Disk":
        """Look at the disk now. state: the folder that has models/. about: what pack() returned."""
        models, incoming = state / "models", state / "models" / "incoming" / about["sha256"]
        ready, arrived, staging, current, last = False, (), {}, "", ""
        with contextlib.suppress(OSError):
            arrived = tuple(sorted(p.name for p in incoming.iterdir() if not p.name.startswith(".")))
            ready = True
        with contextlib.suppress(OSError):
            staging = {entry.name: entry.stat().st_size for entry in os.scandir(models / "releases" / ".new")}
        with contextlib.suppress(OSError):
            current = str((models / "current").readlink()).removeprefix("releases/")
        with contextlib.suppress(OSError, ValueError, IndexError):
            last = json.loads((models / "history.json").read_text())[-1]
        name = str(about["name"])
        switched = current.startswith(name)
        return cls(
            ready=ready,
            sending=any(p.stat().st_size for p in half_sent(state)),
            arrived=arrived,
            complete=len(arrived) == 3,  # the policy, its signature, and what describes it
            staging=staging,
            staged=staging.get(POLICY) == about["bytes"],
            released=any(True for _ in (models / "releases").glob(f"{name}*/{POLICY}")),
            switched=switched,
            remembered=switched and last == current,
        )

    # Moments

    def awaiting(self) -> bool:
        return self.ready and not self.arrived

    def arriving(self) -> bool:
        return self.ready and self.sending and POLICY not in self.arrived

    def unopened(self) -> bool:
        return self.complete and not self.staging

    def writing(self) -> bool:
        return self.staging.get(POLICY, 0) > 0 and not self.staged

    def written(self) -> bool:
        return self.staged and not self.released

    def named(self) -> bool:
        return self.released and not self.switched

    def just_switched(self) -> bool:
        return self.switched and not self.remembered


def half_sent(state: Path) -> list[Path]:
    """Return what Ansible has of a policy until all of it has arrived. state: the rover's folder that has models/."""
    return list(state.parents[2].glob(f"home/*/.ansible/tmp/*/.source{Path(POLICY).suffix}"))


class Line(NamedTuple):
    """A rover's line in the table of status.yml. model: the beginning of its name. notes: the lines below that line."""

    healthy: bool
    model: str
    mode: str
    notes: str


def line_of(output: str, name: str) -> Line:
    """Find a rover's line in the output of status.yml. Raises EmulationError if there is none."""
    lines = [line.strip().strip('",') for line in output.splitlines() if line.strip().startswith('"')]
    for i, line in enumerate(lines):
        words = line.split()
        if words[:1] != [name] or len(words) < 4:
            continue
        notes = []
        for note in lines[i + 1 :]:
            if not note.startswith(" "):
                break
            notes.append(note.strip())
        return Line(words[1] == "yes", words[2], words[3], "; ".join(notes))
    raise EmulationError(f"status.yml has no line of {name}, it ends: {output[-600:]}")


def write_changed_artifact(artifact: Path, target: Path, *, answers: float = 0.0, **changes: Any) -> Path:
    """Write the artifact with another manifest to `target`, with all checksums right, and return that.

    answers: by how much the plans of its parity vectors are made wrong. changes: of the manifest.
    """
    with zipfile.ZipFile(artifact) as old, zipfile.ZipFile(target, "w", zipfile.ZIP_STORED) as new:
        for item in old.infolist():
            content = old.read(item)
            if item.filename.endswith("/extra/manifest.json"):
                content = json.dumps({**json.loads(content), **changes}).encode()
            if item.filename.endswith("/extra/parity.npz") and answers:
                vectors = dict(np.load(io.BytesIO(content)))
                vectors["chunk"] += answers
                buffer = io.BytesIO()
                np.savez_compressed(buffer, allow_pickle=False, **vectors)
                content = buffer.getvalue()
            new.writestr(item.filename, content)
    return target


# One rover, and what is done to it


class DeploymentBench:
    """A rover that is deployed to, and the network to it.

    before, target: the mode in use, and the mode to be deployed. artifacts: two that are fit to be deployed, by mode.
    allow: in what they may differ, as rover_allow. packed: what pack() returned for each. disk_then: the disk when the
    power was cut.
    """

    before = target = ""
    disk_then = Disk()
    disk_is_small = False

    def __init__(
        self,
        pi: Container,
        artifacts: Mapping[str, Path],
        folder: Path,
        stop: threading.Event,
        allow: Sequence[str] = (),
    ):
        self.pi, self.artifacts, self.stop, self.allow = pi, dict(artifacts), stop, list(allow)
        self.folder = folder / pi.name
        self.folder.mkdir(parents=True)
        self.network = Network(pi)
        self.undo = contextlib.ExitStack()
        self.seconds: dict[str, float] = {}
        self.outputs: list[str] = []
        self.packed = {mode: pack(path, self.folder / "packed", allow=allow) for mode, path in self.artifacts.items()}

    def __enter__(self) -> "DeploymentBench":
        self.network.__enter__()
        return self

    def __exit__(self, *exc: object) -> None:
        self.undo.close()
        self.network.__exit__(*exc)

    @property
    def state(self) -> Path:
        """The rover's folder that has models/. While the rover is on, this includes what is mounted there."""
        if self.pi.on:
            return Path(f"/proc/{self.pi.leader}/root/{STATE}")
        return self.pi.root / STATE

    @property
    def releases(self) -> Releases:
        """The rover's releases, which this machine only reads."""
        return Releases(self.state / "models")

    @property
    def about(self) -> dict[str, Any]:
        """What pack() returned for the model to be deployed."""
        return self.packed[self.target]

    @property
    def disk(self) -> Disk:
        return Disk.seen(self.state, self.about)

    @property
    def incoming(self) -> Path:
        return self.state / "models" / "incoming" / self.about["sha256"]

    @property
    def released(self) -> Path:
        """The policy in the release that is being deployed, which must be on the rover already."""
        return next((self.state / "models" / "releases").glob(f"{self.about['name']}*/{POLICY}"))

    def begin(self, fresh: bool = False) -> None:
        """Begin a row: choose a model that is not in use as the target. fresh: remove all releases not in use."""
        self.before = self._mode_of(self.releases.current or "", "")
        self.target = next(mode for mode in self.artifacts if mode != self.before)
        self.seconds, self.outputs, self.disk_is_small = {}, [], False
        for file in half_sent(self.state):  # of a transfer that was cut off
            file.unlink()
        if fresh:
            for release in (self.state / "models" / "releases").iterdir():
                if release.name != self.releases.current:
                    shutil.rmtree(release)

    def play(self, book: str, *, name: str = "", **variables: Any) -> Play:
        """Run a playbook on this rover. name: a folder of its own, as on another laptop."""
        if self.stop.is_set():
            raise EmulationError("told to stop")
        folder = self.folder / (name or "laptop")
        folder.mkdir(exist_ok=True)
        given = {"rover_packed": str(folder / "packed"), **variables}
        return playbooks.run(book, [self.network], folder=folder, variables=given, timeout_s=PLAY_S)

    def deploy(self, artifact: Path | None = None, **more: Any) -> Play:
        """Run deploy.yml with an artifact, or else with the target's; keep what it printed in `outputs`."""
        artifact = artifact or self.artifacts[self.target]
        play = self.play("deploy", rover_artifact=str(artifact), rover_allow=self.allow, **more)
        self.outputs.append(play.output)
        return play

    def deploy_until(self, moment: Callable[[Disk], bool], strike: Callable[[], object], **more: Any) -> Play:
        """Run deploy.yml, and call `strike` once at the moment. Raises Missed if the moment was never seen."""
        over = threading.Event()

        def reached() -> bool:
            try:
                return moment(self.disk)
            except (OSError, EmulationError):  # the disk changes while it is read
                return False

        def watch() -> bool:
            while not reached():
                if over.wait(LOOK_S):
                    return False
            strike()
            return True

        with ThreadPoolExecutor(1) as pool:
            struck = pool.submit(watch)
            try:
                play = self.deploy(**more)
            finally:
                over.set()
        if not struck.result():
            raise Missed(f"{self.pi.name}: the moment did not come, or passed unseen; deploy.yml: {play.end[-600:]}")
        return play

    def cut_power(self, moment: Callable[[Disk], bool]) -> None:
        """Cut the power. Raises Missed if the disk is then no longer as it is at that moment."""
        self.pi.cut_power()
        self.disk_then = self.disk
        if not moment(self.disk_then):
            raise Missed(f"{self.pi.name}: the power was cut a moment too late", found=vars(self.disk_then))

    def proves(self) -> bool:
        """Return whether a health check is running, by its control group, which is quicker than to ask systemctl."""
        tops = [CGROUPS / self.pi.machine, *CGROUPS.glob(f"*/{self.pi.machine}")]  # cgroup v2, and its hierarchies
        return any(True for top in tops for _ in top.glob(f"**/{CHECK.format('*')}"))

    def wait_for_check(self) -> None:
        """Wait until a health check has been running for INTO_CHECK_S. Raises Missed if there is none."""
        if not wait_for(self.proves, 5, every_s=0.0):
            raise Missed(f"{self.pi.name}: no health check is at work")
        self.stop.wait(INTO_CHECK_S)

    def rover(self, *command: object) -> str:
        """Run `rover` on the rover, as if by hand; return what it printed, and keep that in `outputs`."""
        done = self.pi.inside(ROVER, *command, check=False, timeout_s=CHECK_S)
        self.outputs.append(done.stdout + done.stderr)
        return self.outputs[-1]

    def small_disk(self, free: int) -> None:
        """Put models and what arrives on a file system with `free` bytes left, until the row is over."""
        used = sum(p.stat().st_size for p in self.state.rglob("*") if p.is_file() and not p.is_symlink())
        self.pi.inside(
            "sh",
            "-ec",
            f"cd /; mkdir -p /mnt/small; mount -t tmpfs -o mode=755,size={used + free} small /mnt/small;"
            f" cp -a /{STATE}/. /mnt/small; mount --bind /mnt/small /{STATE}; umount /mnt/small",
        )
        self.undo.callback(self.pi.inside, "umount", "--lazy", f"/{STATE}", check=False)
        self.disk_is_small = True

    def heal(self) -> None:
        """Do what a human does about the cause before deploying again: make room on a small disk."""
        if self.disk_is_small:
            self.pi.inside("mount", "-o", "remount,size=1g", f"/{STATE}")
            (self.state / "ballast").unlink(missing_ok=True)

    def clean(self) -> None:
        """Undo what the fault has left. If the rover went off, its mounts are gone anyway, so errors are ignored."""
        with contextlib.suppress(EmulationError, OSError):
            self.undo.close()

    @contextlib.contextmanager
    def timed(self, what: str) -> Iterator[None]:
        started = time.monotonic()
        yield
        self.seconds[what] = self.seconds.get(what, 0.0) + time.monotonic() - started

    def mode_in_use(self) -> tuple[str, bool]:
        """Return the mode of the release in use, and whether its bytes are right.

        The mode is "another" if it is none of our models, and "none" if no release is in use.
        """
        current = self.releases.current
        if current is None:
            return "none", False
        return self._mode_of(current, "another"), not self.releases.wrong_with(current)

    def _mode_of(self, release: str, otherwise: str) -> str:
        return next((mode for mode, about in self.packed.items() if release.startswith(about["name"])), otherwise)

    def healthy(self) -> bool:
        """Return whether the release in use passes its parity vectors in the service's sandbox."""
        done = self.pi.inside("systemctl", "start", CHECK.format("current"), check=False, timeout_s=CHECK_S)
        return done.returncode == 0

    def status(self, healthy: bool) -> tuple[str, str]:
        """Return what status.yml shows, and what of that should be otherwise: an empty string if all is true."""
        line = line_of(self.play("status").output, self.pi.name)
        current = self.releases.current
        mode = self._mode_of(current or "", line.mode)
        wrong = [r.name[:12] for r in self.releases.all() if r.wrong and not r.current]
        is_so = {
            f"healthy is {healthy}": line.healthy == healthy,
            f"model is {(current or 'none')[:12]}": line.model == (current or "none")[:12],
            f"mode is {mode}": line.mode == mode,
            **{f"release {name} is damaged": name in line.notes for name in wrong},
        }
        shown = f"{'healthy' if line.healthy else 'NOT healthy'}, {line.model}, {line.mode}"
        return shown + (f" ({line.notes})" if line.notes else ""), "; ".join(k for k, v in is_so.items() if not v)


def flip(path: Path) -> None:
    """Flip one bit in the middle of a file, in place."""
    with path.open("r+b") as f:
        f.seek(path.stat().st_size // 2)
        byte = f.read(1)
        f.seek(-1, os.SEEK_CUR)
        f.write(bytes([byte[0] ^ 1]))
        os.fsync(f.fileno())


# Several of them


@contextlib.contextmanager
def rovers(
    names: Sequence[str], layers: Sequence[Path], artifacts: Mapping[str, Path]
) -> Iterator[list[DeploymentBench]]:
    """Give rovers that are switched on. Whatever ends the block, nothing of them is left."""
    stop = threading.Event()
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rover-breaks-")))
        benches = []
        for name in names:
            pi = stack.enter_context(Container(name, layers=layers))
            benches.append(stack.enter_context(DeploymentBench(pi, artifacts, folder, stop)))
            pi.boot()
        try:
            yield benches
        finally:
            stop.set()


def in_parallel(task: Callable[[DeploymentBench], Any], benches: Sequence[DeploymentBench]) -> list[Any]:
    """Do the task for all rovers at once, and return the results. If one raises, all rovers are switched off first."""
    with ThreadPoolExecutor(len(benches)) as pool:
        futures = [pool.submit(task, bench) for bench in benches]
        try:
            wait(futures, return_when=FIRST_EXCEPTION)
            return [future.result() for future in futures]
        except BaseException:  # ^C too. Threads that wait for a rover that is off do not wait for long.
            for bench in benches:
                bench.stop.set()
                bench.pi.cut_power()
            raise


def give_first_model(bench: DeploymentBench) -> None:
    """Deploy a model to a rover that has none of ours in use. Raises EmulationError if that fails."""
    if bench.mode_in_use()[0] not in bench.artifacts:
        play = bench.play("deploy", rover_artifact=str(next(iter(bench.artifacts.values()))))
        if not play.ok:
            raise EmulationError(f"{bench.pi.name}: the first model cannot be deployed: {play.end}")

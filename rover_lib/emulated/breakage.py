"""What can go wrong with a deployment, on emulated Pis: `make pi-fast` writes the rows to runs/pi-fast.json.

    artifacts = {"static": Path("policy_static.pt"), "mixed": Path("policy_mixed.pt")}
    rows = break_deployments(pi.layers, artifacts)      # of a Container that was provisioned, and is off
    result = fleet(pi.layers, artifacts)

Each fault meets ansible/deploy.yml (or rollback.yml) as a human runs it, against real systemd and sshd, and there is no
hook for it in what runs: when a deployment has come to a certain point is seen on the rover's disk, looked at from this
machine every millisecond or so. A row in which the moment was missed is done again. After each fault the rover is
asked for three things. Its model still passes its parity vectors, in the service's sandbox. What status.yml shows is
what is on the disk. And deploy.yml, run again, leaves the rover with the new model.

A power cut ends every program of the rover at one moment and leaves its disk as it was. What a real one also takes
away, writes that were not synced, a container cannot show, because its disk is a layer over a folder of this machine:
tests/onboard/test_release.py cuts the same commands after every system call that changes something, and there what was
not synced is lost.
"""

import contextlib
import json
import os
import re
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

from rover_lib.emulated import plays
from rover_lib.emulated.container import Container
from rover_lib.emulated.plays import Play
from rover_lib.emulated.system import EmulationError, run
from rover_lib.emulated.wire import Wire
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.release import ORIGIN, POLICY, SPARE_BYTES, Releases, pack
from rover_lib.workshop.arm import fetch_packages
from rover_lib.workshop.cache import cached_folder, key_of

STATE = "var/lib/rover"  # on the rover; models/ and incoming/ are in it
ROVER = "/opt/rover/venv/bin/rover"
CHECK = "rover-check@{}.service"
LOOK_S = 0.001  # between looks at the disk
PLAY_S = 600.0
CHECK_S = 180.0
INTO_CHECK_S = 1.0  # of a health check, when the power is cut in it
ROOM = 4 << 20  # bytes free on a full disk
TRIES = 3  # of a row whose moment was missed
WORKERS = 2  # rovers that are broken at the same time; each keeps a core busy
NOBODY = 9  # a port on which no sshd listens
LIBRARY = "/usr/lib/aarch64-linux-gnu/faketime/libfaketimeMT.so.1"  # of Debian's libfaketime

CGROUPS = Path("/sys/fs/cgroup")

Say = Callable[[str], None]


class Missed(EmulationError):
    """A moment of a deployment that passed unseen: the row says nothing."""


# What is on the disk


@dataclass(frozen=True)
class Disk:
    """How far a deployment has come, by what is on the rover's disk.

    ready: there is a folder for what arrives. arrived: names of what has. staging: bytes of the files of a release
    that has no name yet. released: it has. switched: it is in use. remembered: and was proven again since.
    """

    ready: bool = False
    arrived: tuple[str, ...] = ()
    staging: Mapping[str, int] = field(default_factory=dict)
    released: bool = False
    switched: bool = False
    remembered: bool = False

    @classmethod
    def seen(cls, state: Path, about: Mapping[str, Any]) -> "Disk":
        """state: the folder of models/ and incoming/. about: what pack() returned."""
        models, incoming = state / "models", state / "incoming" / about["sha256"]
        try:
            arrived = tuple(sorted(p.name for p in incoming.iterdir() if not p.name.startswith(".")))
            ready = True
        except OSError:
            arrived, ready = (), False
        staging = {}
        with contextlib.suppress(OSError):
            staging = {entry.name: entry.stat().st_size for entry in os.scandir(models / "releases" / ".new")}
        try:
            current = str((models / "current").readlink()).removeprefix("releases/")
        except OSError:
            current = ""
        try:
            last = json.loads((models / "history.json").read_text())[-1]
        except (OSError, ValueError, IndexError):
            last = ""
        name = str(about["name"])
        switched = current.startswith(name)
        released = (models / "releases" / name / POLICY).exists()
        return cls(ready, arrived, staging, released, switched, switched and last == current)

    def complete(self, about: Mapping[str, Any]) -> bool:
        """All parts have arrived, and what describes them."""
        return len(self.arrived) == about["parts"] + 1

    def row(self) -> dict[str, Any]:
        """For the report."""
        return {**vars(self), "arrived": list(self.arrived), "staging": dict(self.staging)}


class Line(NamedTuple):
    """A rover in the table of status.yml. model: the beginning of its name. notes: what is said below its line."""

    healthy: bool
    model: str
    mode: str
    notes: str


def line_of(output: str, name: str) -> Line:
    """A rover's line in what status.yml said. Raises EmulationError if it has none."""
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


def changed_artifact(artifact: Path, target: Path, **changes: Any) -> Path:
    """The artifact with another manifest, and every checksum right."""
    with zipfile.ZipFile(artifact) as old, zipfile.ZipFile(target, "w", zipfile.ZIP_STORED) as new:
        for item in old.infolist():
            content = old.read(item)
            if item.filename.endswith("/extra/manifest.json"):
                content = json.dumps({**json.loads(content), **changes}).encode()
            new.writestr(item.filename, content)
    return target


# One rover, and what is done to it


class Bench:
    """A rover that is deployed to, and the network to it. before, target: the mode in use, and the one to be deployed.

    artifacts: two that are fit to be deployed, by their mode.
    """

    def __init__(self, pi: Container, artifacts: Mapping[str, Path], folder: Path, stop: threading.Event):
        self.pi, self.artifacts, self.stop = pi, dict(artifacts), stop
        self.folder = folder / pi.name
        self.folder.mkdir(parents=True)
        self.wire = Wire(pi)
        self.undo = contextlib.ExitStack()
        self.seconds: dict[str, float] = {}
        self.said: list[str] = []
        self._about = {mode: pack(path, self.folder / "packed") for mode, path in self.artifacts.items()}

    def __enter__(self) -> "Bench":
        self.wire.__enter__()
        return self

    def __exit__(self, *exc: object) -> None:
        self.undo.close()
        self.wire.__exit__(*exc)

    @property
    def state(self) -> Path:
        """The rover's folder of models/ and incoming/; what is mounted there as long as it is on."""
        if self.pi.on:
            return Path(f"/proc/{self.pi.leader}/root/{STATE}")
        return self.pi.root / STATE

    @property
    def releases(self) -> Releases:
        """As this machine reads them; it changes nothing."""
        return Releases(self.state / "models")

    @property
    def about(self) -> dict[str, Any]:
        """What pack() says of the model to be deployed."""
        return self._about[self.target]

    @property
    def disk(self) -> Disk:
        return Disk.seen(self.state, self.about)

    @property
    def incoming(self) -> Path:
        return self.state / "incoming" / self.about["sha256"]

    @property
    def released(self) -> Path:
        """The policy of the release that is deployed."""
        return self.state / "models" / "releases" / self.about["name"] / POLICY

    def begin(self, fresh: bool = False) -> None:
        """Of a row: what is not in use is to be deployed. fresh: it was never on the rover."""
        current = self.releases.current or ""
        self.before = next((mode for mode, about in self._about.items() if current.startswith(about["name"])), "")
        self.target = next(mode for mode in self.artifacts if mode != self.before)
        self.seconds, self.said = {}, []
        if fresh:
            shutil.rmtree(self.released.parent, ignore_errors=True)

    def play(self, book: str, *, others: Sequence[plays.Host] = (), name: str = "", **variables: Any) -> Play:
        """Runs a playbook on this rover, and on others after it. name: of a laptop of its own."""
        if self.stop.is_set():
            raise EmulationError("told to stop")
        folder = self.folder / (name or "laptop")
        folder.mkdir(exist_ok=True)
        given = {"rover_packed": str(folder / "packed"), **variables}
        return plays.run(book, [self.wire, *others], folder=folder, variables=given, timeout_s=PLAY_S)

    def deploy(self, artifact: Path | None = None, **more: Any) -> Play:
        """Runs deploy.yml with an artifact, or with the one to be deployed; what it said is noted."""
        play = self.play("deploy", rover_artifact=str(artifact or self.artifacts[self.target]), **more)
        self.said.append(play.output)
        return play

    def deploy_until(self, moment: Callable[[Disk], bool], strike: Callable[[], object], **more: Any) -> Play:
        """Runs deploy.yml, and strikes once at the moment. Raises Missed if it never came."""
        struck: list[BaseException | None] = []
        over = threading.Event()

        def watch() -> None:
            while not over.is_set():
                with contextlib.suppress(OSError, EmulationError):
                    if moment(self.disk):
                        try:
                            strike()
                        except Exception as error:
                            return struck.append(error)
                        return struck.append(None)
                time.sleep(LOOK_S)

        watcher = threading.Thread(target=watch, name=f"watcher of {self.pi.name}")
        watcher.start()
        try:
            play = self.deploy(**more)
        finally:
            over.set()
            watcher.join()
        if not struck:
            raise Missed(f"{self.pi.name}: the moment did not come, or passed unseen; deploy.yml: {play.end[-600:]}")
        if struck[0]:
            raise struck[0]
        return play

    def cut_power(self, holds: Callable[[Disk], bool]) -> Callable[[], None]:
        """To strike with. holds: what the disk is like then; another moment was hit if it is not."""

        def strike() -> None:
            self.pi.cut_power()
            self.found = self.disk
            if not holds(self.found):
                raise Missed(f"{self.pi.name}: the power was cut a moment too late, there is {self.found.row()}")

        return strike

    def set_clock(self, years: int) -> None:
        """What starts from now on sees another year, until the row is over: by libfaketime, in every aarch64 program.

        The monotonic clock of what systemd starts stays as it is, as it does when a real clock is set.
        """
        copied = self.pi.root / LIBRARY.lstrip("/")
        preload, settings = self.pi.root / "etc/ld.so.preload", self.pi.root / "etc/faketimerc"
        copied.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(_faketime() / LIBRARY.lstrip("/"), copied)
        settings.write_text(f"{years:+d}y\n")
        preload.write_text(f"{LIBRARY}\n")
        self.undo.callback(preload.unlink, missing_ok=True)
        self.undo.callback(settings.unlink, missing_ok=True)

    def proves(self) -> bool:
        """Whether a health check is at work now, by its control group, which is quicker than to ask systemctl."""
        tops = [CGROUPS / self.pi.machine, *CGROUPS.glob(f"*/{self.pi.machine}")]  # cgroup v2, and its hierarchies
        return any(True for top in tops for _ in top.glob(f"**/{CHECK.format('*')}"))

    def wait_for_check(self) -> None:
        """Until a health check has loaded something of what it needs. Raises Missed if there is none."""
        until = time.monotonic() + 5
        while not self.proves():
            if time.monotonic() > until:
                raise Missed(f"{self.pi.name}: no health check is at work")
        self.stop.wait(INTO_CHECK_S)

    def rover(self, *command: object) -> str:
        """Runs `rover` on the rover, by hand; what it said is noted."""
        done = self.pi.inside(ROVER, *command, check=False, timeout_s=CHECK_S)
        said = (done.stdout + done.stderr).decode(errors="replace")
        self.said.append(said)
        return said

    def small_disk(self, free: int) -> None:
        """Models and what arrives are now on a file system with so many bytes free, until the row is over."""
        used = sum(p.stat().st_size for p in self.state.rglob("*") if p.is_file() and not p.is_symlink())
        self.pi.inside(
            "sh",
            "-ec",
            f"mkdir -p /mnt/small; mount -t tmpfs -o mode=755,size={used + free} small /mnt/small;"
            f" cp -a /{STATE}/. /mnt/small; mount --move /mnt/small /{STATE}",
        )
        self.undo.callback(self.pi.inside, "umount", "--lazy", f"/{STATE}", check=False)

    def make_room(self) -> None:
        self.pi.inside("mount", "-o", "remount,size=1g", f"/{STATE}")
        (self.state / "ballast").unlink(missing_ok=True)

    def make_read_only(self) -> None:
        """As a card does when it comes to its end; until the row is over."""
        self.pi.inside("mount", "--bind", f"/{STATE}", f"/{STATE}")
        self.pi.inside("mount", "-o", "remount,bind,ro", f"/{STATE}")
        self.undo.callback(self.pi.inside, "umount", "--lazy", f"/{STATE}", check=False)

    def clean(self) -> None:
        """Undoes what the fault has left; what was mounted in a rover that went off is gone."""
        with contextlib.suppress(EmulationError, OSError):
            self.undo.close()

    @contextlib.contextmanager
    def timed(self, what: str) -> Iterator[None]:
        started = time.monotonic()
        yield
        self.seconds[what] = self.seconds.get(what, 0.0) + time.monotonic() - started

    def mode_in_use(self) -> tuple[str, bool]:
        """The mode of what is in use, "another" or "none" else, and whether its bytes are whole."""
        current = self.releases.current
        if current is None:
            return "none", False
        mode = next((mode for mode, about in self._about.items() if current.startswith(about["name"])), "another")
        return mode, not self.releases.wrong_with(current)

    def healthy(self) -> bool:
        """Whether what is in use passes its parity vectors, in the service's sandbox."""
        done = self.pi.inside("systemctl", "start", CHECK.format("current"), check=False, timeout_s=CHECK_S)
        return done.returncode == 0

    def status(self, healthy: bool) -> tuple[str, str]:
        """What status.yml shows, and what of it is not so: an empty string if all is."""
        line = line_of(self.play("status").output, self.pi.name)
        current = self.releases.current
        mode = next((m for m, about in self._about.items() if (current or "").startswith(about["name"])), line.mode)
        wrong = [r.name[:12] for r in self.releases.all() if r.wrong and not r.current]
        is_so = {
            f"healthy is {healthy}": line.healthy == healthy,
            f"model is {(current or 'none')[:12]}": line.model == (current or "none")[:12],
            f"mode is {mode}": line.mode == mode,
            **{f"release {name} is damaged": name in line.notes for name in wrong},
        }
        shown = f"{'healthy' if line.healthy else 'NOT healthy'}, {line.model}, {line.mode}"
        return shown + (f" ({line.notes})" if line.notes else ""), "; ".join(k for k, v in is_so.items() if not v)


# The faults


@dataclass(frozen=True)
class Fault:
    """A row. inject: makes a deployment meet it. says: what must be said of it, a regular expression. how: it is made.

    heal: what a human does about the cause before deploying again. fresh: the model to be deployed is not on the rover
    yet, so that it travels; otherwise it is there, of which the deployment takes the other half.
    """

    name: str
    inject: Callable[[Bench], object]
    says: str
    how: str
    fresh: bool = False
    heal: Callable[[Bench], object] = lambda bench: None


FAULTS: list[Fault] = []
LOST = "(?i)unreachable"  # what Ansible says when ssh ends


def _fault(name: str, says: str, how: str, **more: Any) -> Callable[[Callable], Callable]:
    def add(inject: Callable[[Bench], object]) -> Callable[[Bench], object]:
        FAULTS.append(Fault(name, inject, says, how, **more))
        return inject

    return add


def _power_cut(
    when: str, moment: Callable[[Bench, Disk], bool], how: str, *, in_check: bool = False, fresh: bool = True
) -> None:
    """in_check: not at that moment, but in the health check that it begins with."""

    @_fault(f"power cut {when}", LOST, how, fresh=fresh)
    def inject(bench: Bench) -> None:
        cut = bench.cut_power(lambda disk: moment(bench, disk))

        def strike() -> None:
            if in_check:
                bench.wait_for_check()
            cut()

        bench.deploy_until(lambda disk: moment(bench, disk), strike)


def _arriving(bench: Bench, disk: Disk) -> bool:
    return bool(disk.arrived) and not disk.complete(bench.about)


def _written_in_part(bench: Bench, disk: Disk) -> bool:
    return 0 < disk.staging.get(POLICY, 0) < bench.about["bytes"]


_power_cut(
    "before the transfer", lambda b, d: d.ready and not d.arrived, "once there is a folder for it, and nothing in it"
)
_power_cut("in the transfer", _arriving, "once a part of it is there")
_power_cut(
    "after the transfer",
    lambda b, d: d.complete(b.about) and not d.staging,
    "once all is there, and nothing made of it",
)
_power_cut("before fsync", _written_in_part, "while the new release's policy.pt is written")
_power_cut(
    "after fsync",
    lambda b, d: bool(d.staging.get("policy.pt.sha256")) and not d.released,
    "once its bytes are on the disk, and its folder has no name yet",
)
_power_cut("after the release has its name", lambda b, d: d.released and not d.switched, "once its folder has its name")
_power_cut(
    "in the health check before the switch",
    lambda b, d: d.released and not d.switched,
    "a second into its parity vectors",
    in_check=True,
    fresh=False,
)
_power_cut(
    "right after the switch", lambda b, d: d.switched and not d.remembered, "once current points to it", fresh=False
)
_power_cut(
    "in the health check after the switch",
    lambda b, d: d.switched and not d.remembered,
    "a second into its parity vectors",
    in_check=True,
    fresh=False,
)
_power_cut(
    "between switch and restart",
    lambda b, d: d.remembered,
    "once it was proven again, before anything restarts",
    fresh=False,
)


@_fault(
    "disk full in the transfer",
    "No space left on device",
    f"{ROOM >> 20} MB are free",
    heal=Bench.make_room,
    fresh=True,
)
def _no_room_to_arrive(bench: Bench) -> None:
    bench.small_disk(ROOM)
    bench.deploy()


@_fault(
    "too little room for a release",
    r"\d+ MB free, \d+ are needed; prune releases",
    "it can arrive, but the release does not fit beside it",
    heal=Bench.make_room,
    fresh=True,
)
def _no_room_to_stage(bench: Bench) -> None:
    bench.small_disk(2 * bench.about["bytes"] + ROOM)
    bench.deploy()


@_fault(
    "disk full while the release is written",
    "the disk is full; what was in use still is",
    "something else takes all that is free, once there was room enough",
    heal=Bench.make_room,
    fresh=True,
)
def _fill_while_staging(bench: Bench) -> None:
    bench.small_disk(2 * bench.about["bytes"] + SPARE_BYTES + 2 * ROOM)

    def fill() -> None:
        with (bench.state / "ballast").open("wb") as f:
            free = shutil.disk_usage(bench.state).free
            os.posix_fallocate(f.fileno(), 0, max(free - (1 << 20), 1))

    bench.deploy_until(lambda disk: bool(disk.staging), fill)


@_fault("a byte flipped on the way", LOST, "in the network, once a part has come through: ssh notices", fresh=True)
def _flip_on_the_wire(bench: Bench) -> None:
    bench.deploy_until(lambda disk: _arriving(bench, disk), lambda: bench.wire.flip(after=1 << 20))


@_fault(
    "a byte flipped in what has arrived",
    "arrived damaged .* send it again",
    "in a part on the rover's disk",
    fresh=True,
)
def _flip_on_disk(bench: Bench) -> None:
    bench.deploy_until(lambda disk: disk.complete(bench.about), lambda: _flip(bench.incoming / "part-0000"))


def _flip(path: Path) -> None:
    """One bit in the middle of a file, in place."""
    with path.open("r+b") as f:
        f.seek(path.stat().st_size // 2)
        byte = f.read(1)
        f.seek(-1, os.SEEK_CUR)
        f.write(bytes([byte[0] ^ 1]))
        os.fsync(f.fileno())


@_fault(
    "ssh lost in the transfer",
    LOST,
    "the network is cut a megabyte after the first part; the transfer goes on",
    fresh=True,
)
def _lose_ssh_in_transfer(bench: Bench) -> dict[str, Any]:
    def strike() -> None:
        until = bench.wire.sent + (1 << 20)
        while bench.wire.sent < until and not bench.disk.complete(bench.about) and not bench.stop.is_set():
            time.sleep(LOOK_S)
        bench.wire.cut()

    sent = bench.wire.sent
    bench.deploy_until(lambda disk: _arriving(bench, disk), strike)
    first = bench.wire.sent - sent
    bench.wire.mend()
    arrived = {p.name: p.stat().st_ino for p in bench.incoming.glob("part-*")}
    kept: dict[str, int] = {}
    sent = bench.wire.sent

    def look() -> None:
        kept.update({p.name: p.stat().st_ino for p in bench.incoming.glob("part-*")})

    bench.deploy_until(lambda disk: disk.complete(bench.about), look)
    travelled = [name for name, inode in kept.items() if arrived.get(name) != inode]
    if not arrived or set(arrived) & set(travelled):
        raise EmulationError(f"{bench.pi.name}: {sorted(arrived)} had arrived, and {travelled} travelled again")
    # All that Ansible sends is in these, its modules too.
    return {
        "had_arrived": sorted(arrived),
        "travelled_then": travelled,
        "sent_mb": [round(first / 1e6, 1), round((bench.wire.sent - sent) / 1e6, 1)],
    }


@_fault("ssh lost in the health check", LOST, "the network is cut while the rover proves the new model; it goes on")
def _lose_ssh_in_check(bench: Bench) -> None:
    bench.deploy_until(lambda disk: disk.released, lambda: (bench.wait_for_check(), bench.wire.cut()))


@_fault(
    "network silent in the transfer", LOST, "out of reach: no packet comes through, and no connection ends", fresh=True
)
def _go_silent(bench: Bench) -> None:
    bench.deploy_until(lambda disk: _arriving(bench, disk), bench.wire.silence)


@_fault(
    "artifact with a wrong hash",
    "contains [0-9a-f]{12}, not [0-9a-f]{12}; pack it again",
    "what describes the parts names another artifact",
    fresh=True,
)
def _wrong_hash(bench: Bench) -> None:
    def strike() -> None:
        path = bench.incoming / ORIGIN
        other = bench._about[bench.before]["name"]
        path.write_text(json.dumps({**json.loads(path.read_text()), "name": other[::-1]}))

    bench.deploy_until(lambda disk: disk.complete(bench.about), strike)


def _refused(bench: Bench, artifact: Path, says: str) -> None:
    """By the laptop, before anything travels; and by the rover, brought there by hand."""
    if bench.deploy(artifact).ok:
        raise EmulationError(f"{bench.pi.name}: {artifact.name} was deployed")
    there = bench.state / "by-hand.pt"
    shutil.copy(artifact, there)
    bench.undo.callback(there.unlink, missing_ok=True)
    if not re.search(says, bench.rover("release", "stage", f"/{STATE}/by-hand.pt")):
        raise EmulationError(
            f"{bench.pi.name}: the rover took {artifact.name}, or said another thing: {bench.said[-1]}"
        )


OTHER_TORCH = r"made with torch 9\.9\.9, rovers have"


@_fault("artifact of another torch", OTHER_TORCH, "its manifest says so; refused by laptop and rover")
def _other_torch(bench: Bench) -> None:
    versions = {"torch": "9.9.9", "rover_lib": ""}
    bad = changed_artifact(bench.artifacts[bench.target], bench.folder / "torch.pt", versions=versions)
    _refused(bench, bad, OTHER_TORCH)


A_LIE = "its manifest says dynamic, its code is not"


@_fault("manifest that lies", A_LIE, "it says dynamic of INT8 convolutions; refused by laptop and rover")
def _lie(bench: Bench) -> None:
    bad = changed_artifact(bench.artifacts[bench.target], bench.folder / "lie.pt", mode="dynamic")
    _refused(bench, bad, A_LIE)


@_fault("parity vectors that fail", "computes something else here", "the manifest tolerates less than no difference")
def _fail_parity(bench: Bench) -> None:
    with zipfile.ZipFile(bench.artifacts[bench.target]) as z:
        manifest = json.loads(z.read(next(n for n in z.namelist() if n.endswith("/extra/manifest.json"))))
    parity = {"tolerance": dict.fromkeys(manifest["action_names"], -1.0), "reason": "to fail"}
    bench.deploy(changed_artifact(bench.artifacts[bench.target], bench.folder / "parity.pt", parity=parity))


@_fault(
    "two deployments at once",
    "another deployment is at work",
    "the second is of the model in use, and begins while the first one's is proven",
)
def _two_at_once(bench: Bench) -> None:
    with ThreadPoolExecutor(1) as pool:
        second: list[Any] = []

        def strike() -> None:
            bench.wait_for_check()
            second.append(pool.submit(bench.deploy, bench.artifacts[bench.before], name="second"))

        bench.deploy_until(lambda disk: bench.proves(), strike)
        second[0].result()


def _wrong_clock(years: int) -> None:
    @_fault(
        f"clock wrong by {years:+d} years", "deployed", "libfaketime is loaded into all that systemd and sshd start"
    )
    def inject(bench: Bench) -> dict[str, str]:
        bench.set_clock(years)
        bench.deploy()
        return {"date": bench.pi.ssh("sudo date +%Y").stdout.decode().strip()}


@_fault(
    "release tampered with before it was proven",
    r"is not what policy\.pt\.sha256 says",
    "a byte of it, as its health check begins",
)
def _tamper_before(bench: Bench) -> None:
    bench.deploy_until(lambda disk: bench.proves(), lambda: _flip(bench.released))


@_fault(
    "release tampered with after the switch",
    "failed after the switch, [0-9a-f]{12} is in use again",
    "a byte of it, once it is in use: the health check fails, and the rover goes back by itself",
)
def _tamper_after(bench: Bench) -> None:
    bench.deploy_until(lambda disk: disk.switched, lambda: _flip(bench.released))


@_fault(
    "release in use tampered with",
    "deployed",
    "a byte of it; status says so, its health check fails, and the next deployment replaces it",
)
def _tamper_in_use(bench: Bench) -> dict[str, Any]:
    _flip(bench.releases.policy.resolve())
    shown, wrong = bench.status(bench.healthy())
    bench.deploy(bench.artifacts[bench.before])
    return {"status_before": shown, "status_before_true": not wrong}


@_fault(
    "rollback with nothing to roll back to",
    "there is no release to roll back to",
    "rollback.yml, then deploy.yml",
    fresh=True,
)
def _roll_back(bench: Bench) -> None:
    play = bench.play("rollback")
    bench.said.append(play.output)
    if play.ok:
        raise EmulationError(f"{bench.pi.name}: rolled back to nothing")


for years in (-20, 20):
    _wrong_clock(years)


class Nobody(NamedTuple):
    """A line of the inventory behind which no rover is."""

    name: str
    key: Path
    port: int = NOBODY


@_fault("a host in the inventory that does not exist", r"nobody: unreachable", "after this one, which gets its model")
def _nobody_there(bench: Bench) -> dict[str, Any]:
    nobody = Nobody("nobody", bench.pi.key)
    play = bench.deploy(others=[nobody])
    table = bench.play("status", others=[nobody]).output
    if f"{bench.pi.name}: deployed" not in play.output or play.code == 0 or "does not answer" not in table:
        raise EmulationError(
            f"{bench.pi.name} was not deployed to or reported, because nobody is not there: {play.end}"
        )
    return {"status_of_nobody": "does not answer"}


# Rows


def break_deployments(
    layers: Sequence[Path],
    artifacts: Mapping[str, Path],
    *,
    only: str = "",
    workers: int = WORKERS,
    say: Say = lambda text: None,
) -> list[dict[str, Any]]:
    """Every fault whose name contains `only`, each on one of so many rovers; their rows, in the order of FAULTS.

    layers: of a Container that was provisioned, and is off. A rover without a model gets the first of the artifacts.
    Raises EmulationError if no row can be made at all.
    """
    waiting = [fault for fault in FAULTS if only in fault.name]
    if not waiting:
        raise EmulationError(f"no fault has '{only}' in its name; there are: {', '.join(f.name for f in FAULTS)}")
    rows: dict[str, dict[str, Any]] = {}
    with _rovers([f"breaks{i + 1}" for i in range(min(workers, len(waiting)))], layers, artifacts) as benches:

        def work(bench: Bench) -> None:
            _give_first_model([bench])
            while waiting and not bench.stop.is_set():
                fault = waiting.pop(0)
                rows[fault.name] = _row(fault, bench)
                say(_told(rows[fault.name]))

        _in_parallel(work, benches)
    return [rows[fault.name] for fault in FAULTS if fault.name in rows]


def wrong_rows(rows: Sequence[Mapping[str, Any]], at_least: int) -> list[str]:
    """What is not as it must be, in sentences. at_least: so many rows must be there."""
    found = [f"{r['fault']}: {r['error']}" for r in rows if r.get("error")]
    for key, what in (
        ("healthy", "the rover has no model that passes its parity vectors"),
        ("status_true", "status.yml does not show what is"),
        ("healed_by_rerun", "running deploy.yml again does not heal it"),
    ):
        found += [f"{row['fault']}: {what}" for row in rows if not row.get("error") and not row[key]]
    if len(rows) < at_least:
        found.append(f"{len(rows)} faults of a deployment were made, at least {at_least} are wanted")
    return found


def _row(fault: Fault, bench: Bench) -> dict[str, Any]:
    started = time.monotonic()
    row: dict[str, Any] = {"fault": fault.name, "how": fault.how}
    try:
        for left in reversed(range(TRIES)):
            try:
                row |= _after(fault, bench)
                break
            except Missed:
                if not left:
                    raise
                _restore(bench)
                row["missed"] = row.get("missed", 0) + 1
    except RoverError as error:
        nothing = {"model_after": None, "healthy": False, "status_true": False, "healed_by_rerun": False}
        row |= {**nothing, "error": str(error)[-2000:]}
        if bench.stop.is_set():
            raise
        _restore(bench)
    return {**row, "seconds": round(time.monotonic() - started, 1)}


def _after(fault: Fault, bench: Bench) -> dict[str, Any]:
    """A fault, and what the rover is like after it."""
    bench.begin(fault.fresh)
    with bench.timed("fault"):
        details = fault.inject(bench)
    row = details if isinstance(details, dict) else {}
    if not bench.pi.on:
        row["disk"] = bench.found.row()
        with bench.timed("boot"):
            bench.pi.boot()
    bench.wire.mend()
    said = " ".join(" ".join(bench.said).replace("\\n", " ").split())
    match = re.search(fault.says, said)
    if not match:
        raise Missed(f"{bench.pi.name}: nobody said '{fault.says}', but: {said[-800:]}")
    with bench.timed("health"):
        healthy = bench.healthy()
    with bench.timed("status"):
        shown, untrue = bench.status(healthy)
    model, whole = bench.mode_in_use()
    row |= {
        "model_before": bench.before,
        "model_after": model,
        "model_after_hash": bench.releases.current,
        "healthy": healthy and whole,
        "status": shown,
        "status_true": not untrue,
        **({"status_lies": untrue} if untrue else {}),
        "said": said[max(0, match.start() - 60) : match.end() + 100],
    }
    fault.heal(bench)
    with bench.timed("rerun"):
        again = bench.deploy()
    model, whole = bench.mode_in_use()
    row["healed_by_rerun"] = again.ok and whole and model == bench.target
    if not row["healed_by_rerun"]:
        row["rerun"] = again.end[-1500:]
    bench.clean()
    return {**row, "seconds_of": {k: round(v, 1) for k, v in bench.seconds.items()}}


def _restore(bench: Bench) -> None:
    """After a row that did not come to its end."""
    bench.clean()
    bench.wire.mend()
    if not bench.pi.on:
        bench.pi.boot()
    bench.begin()
    bench.deploy()


def _told(row: Mapping[str, Any]) -> str:
    if row.get("error"):
        return f"{row['fault']}: {row['error']}"
    good = row["healthy"] and row["status_true"] and row["healed_by_rerun"]
    return f"{row['fault']}: {row['model_after']} {'healthy, healed' if good else 'NOT WELL'} ({row['seconds']:.0f} s)"


# Fleets

NAMES = ("canary", "second", "third")
ONE_BY_ONE = [1, 1, 1]  # batches


def fleet(layers: Sequence[Path], artifacts: Mapping[str, Path], *, say: Say = lambda text: None) -> dict[str, Any]:
    """deploy.yml on three rovers of which one's disk can be read only, as that of a dying card: a row for each case.

    Each: broken, exit_code, results (what the report says of each), models, healthy, good (it is as it must be).
    """
    cases = []
    with _rovers(NAMES, layers, artifacts) as benches:
        _give_first_model(benches)
        for broken, batches in (("canary", None), ("second", ONE_BY_ONE), ("", None)):
            started = time.monotonic()
            case = _case(benches, broken, batches)
            cases.append({**case, "seconds": round(time.monotonic() - started, 1)})
            say(f"fleet, {broken or 'nobody'} broken: {case['results']}, {'good' if case['good'] else 'NOT GOOD'}")
    return {"rovers": len(NAMES), "cases": cases, "good": all(case["good"] for case in cases)}


def _case(benches: Sequence[Bench], broken: str, batches: list[int] | None) -> dict[str, Any]:
    new = list(benches[0].artifacts)[1]
    before = {bench.pi.name: bench.mode_in_use()[0] for bench in benches}
    for bench in benches:
        if bench.pi.name == broken:
            bench.make_read_only()
    variables = {"rover_batches": batches} if batches else {}
    artifact = str(benches[0].artifacts[new])
    others = [bench.wire for bench in benches[1:]]
    play = benches[0].play("deploy", others=others, rover_artifact=artifact, **variables)
    healthy = _in_parallel(Bench.healthy, benches)
    models = {bench.pi.name: bench.mode_in_use()[0] for bench in benches}
    for bench in benches:
        bench.clean()
    results = results_of(play.output)
    wanted = wanted_of(broken, before, new)
    good = (
        all(healthy)
        and set(results) == set(NAMES)
        and all(results[n].startswith(start) and models[n] == model for n, (start, model) in wanted.items())
        and (play.code != 0) == bool(broken)
    )
    return {
        "broken": broken,
        "batches": batches or [1, "100%"],
        "exit_code": play.code,
        "results": results,
        "models": models,
        "healthy": dict(zip(NAMES, healthy, strict=True)),
        "good": good,
    }


def wanted_of(broken: str, before: Mapping[str, str], new: str) -> dict[str, tuple[str, str]]:
    """What the report must begin with, and the model, by rover: all before the broken one get the new model."""
    wanted, failed = {}, False
    for name, model in before.items():
        failed = failed or name == broken
        if failed:
            wanted[name] = ("failed" if name == broken else f"untouched: {broken} failed", model)
        else:
            wanted[name] = ("had it already" if model == new else "deployed", new)
    return wanted


def results_of(output: str) -> dict[str, str]:
    """What deploy.yml's report says of each rover."""
    report = output.partition("TASK [Show what came of each]")[2].partition("TASK [")[0]
    return {name: json.loads(f'"{said}"') for name, said in re.findall(r'"msg": "([\w.-]+): (.*)"', report)}


# How


@contextlib.contextmanager
def _rovers(names: Sequence[str], layers: Sequence[Path], artifacts: Mapping[str, Path]) -> Iterator[list[Bench]]:
    """Rovers that are on. Whatever ends the block, nothing of them is left."""
    stop = threading.Event()
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="rover-breaks-")))
        benches = []
        for name in names:
            pi = stack.enter_context(Container(name, layers=layers))
            benches.append(stack.enter_context(Bench(pi, artifacts, folder, stop)))
            pi.boot()
        try:
            yield benches
        finally:
            stop.set()


def _in_parallel(task: Callable[[Bench], Any], benches: Sequence[Bench]) -> list[Any]:
    with ThreadPoolExecutor(len(benches)) as pool:
        futures = [pool.submit(task, bench) for bench in benches]
        try:
            wait(futures, return_when=FIRST_EXCEPTION)
            return [future.result() for future in futures]
        except BaseException:  # ^C too: what waits for a rover that is off does not wait for long
            for bench in benches:
                bench.stop.set()
                bench.pi.cut_power()
            raise


def _give_first_model(benches: Sequence[Bench]) -> None:
    without = [bench for bench in benches if bench.releases.current is None]
    if not without:
        return
    first = without[0]
    artifact = next(iter(first.artifacts.values()))
    play = first.play("deploy", others=[bench.wire for bench in without[1:]], rover_artifact=str(artifact))
    if not play.ok:
        raise EmulationError(f"{first.pi.name}: the first model cannot be deployed: {play.end}")


def _faketime() -> Path:
    """Debian's libfaketime for aarch64, unpacked, from the cache or made now."""

    def make(folder: Path) -> None:
        with tempfile.TemporaryDirectory() as scratch:
            for package in fetch_packages(Path(scratch), ["libfaketime"]):
                if package.name.startswith("libfaketime_"):
                    run(["dpkg-deb", "--extract", package, folder], f"{package.name} cannot be unpacked")

    return cached_folder("pi-faketime", key_of({"library": LIBRARY}), make)

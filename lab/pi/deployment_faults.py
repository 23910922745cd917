"""Break deployments on emulated Pis in every way we know: `make pi-fast` writes the rows to runs/pi-fast.json.

    artifacts = {"static": Path("policy_static.pt"), "mixed": Path("policy_mixed.pt")}
    rows = break_deployments(pi.layers, artifacts)      # pi: a Container that was provisioned, and is off

Each fault happens while ansible/deploy.yml (or rollback.yml) runs as a human runs it, against real systemd and sshd.
The code that runs has no hook for this: the rover's disk shows how far a deployment has come, and this machine looks at
it every millisecond or so. If the moment was missed, the row is done again. After each fault three things are checked:
the rover's model still passes its parity vectors, in the service's sandbox; status.yml shows what is on the disk; and
deploy.yml, run again, leaves the rover with the new model.

A power cut ends every program of the rover at one moment and leaves its disk as it was. A real one also loses writes
that were not synced. A container cannot show that, because its disk is a layer over a folder of this machine. So
tests/onboard/care/test_release.py cuts the same commands after every system call that changes something, and loses
what was not synced.
"""

import contextlib
import json
import re
import shutil
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lab.pi.deployment_bench import (
    STATE,
    DeploymentBench,
    Disk,
    Missed,
    flip,
    give_first_model,
    in_parallel,
    rovers,
    write_changed_artifact,
)
from lab.pi.emulation import EmulationError
from rover_lib.onboard.care.release import ORIGIN, POLICY, SPARE_BYTES
from rover_lib.onboard.errors import RoverError
from rover_lib.workshop.run_program import run

ROOM = 4 << 20  # bytes free on a full disk
TRIES = 2  # how often a row is tried if its moment was missed
WORKERS = 2  # how many rovers are broken at the same time; each keeps a core busy
RETRY_S = 30  # how long Ansible tries to reach a rover that does not answer

Say = Callable[[str], None]


@dataclass(frozen=True)
class DeploymentFault:
    """A fault of a deployment. inject: runs a deployment and makes the fault happen meanwhile.

    message: a regular expression for what is printed about it. how: it is made, in words. fresh: whether the model to
    be deployed must not be on the rover yet, so that it travels; otherwise it may be there from before, which is
    quicker.
    """

    name: str
    inject: Callable[[DeploymentBench], object]
    message: str
    how: str
    fresh: bool = False


# How they are made


def _strike(
    moment: Callable[[Disk], bool], action: Callable[[DeploymentBench], object], *, in_check: bool = False, **more: Any
) -> Callable[[DeploymentBench], None]:
    """Return an inject that does something to a rover at a moment of its deployment.

    in_check: wait until a health check begins at that moment, and then for another second.
    """

    def inject(bench: DeploymentBench) -> None:
        def act() -> None:
            if in_check:
                bench.wait_for_check()
            action(bench)

        bench.deploy_until(lambda disk: moment(disk) and (not in_check or bench.proves()), act, **more)

    return inject


def _anytime(disk: Disk) -> bool:
    return True


def _little_room(policies: int) -> Callable[[DeploymentBench], None]:
    """Return an inject for a disk with little more room than that many times the policy's bytes."""

    def inject(bench: DeploymentBench) -> None:
        bench.small_disk(policies * bench.about["bytes"] + ROOM)
        bench.deploy()

    return inject


def _fill_while_staging(bench: DeploymentBench) -> None:
    bench.small_disk(2 * bench.about["bytes"] + SPARE_BYTES + 2 * ROOM)

    def fill() -> None:
        with contextlib.suppress(OSError), (bench.state / "ballast").open("wb", buffering=0) as f:
            while True:
                f.write(bytes(1 << 20))

    bench.deploy_until(lambda disk: disk.complete and bool(disk.staging), fill)


def _name_another(bench: DeploymentBench) -> None:
    path = bench.incoming / ORIGIN
    other = bench.packed[bench.before]["name"]
    path.write_text(json.dumps({**json.loads(path.read_text()), "name": other[::-1]}))


def _refused(message: str, **changes: Any) -> Callable[[DeploymentBench], None]:
    """Return an inject for an artifact with a changed manifest, which laptop and rover must both refuse.

    The laptop refuses it before anything travels. Then it is copied to the rover by hand.
    """

    def inject(bench: DeploymentBench) -> None:
        bad = write_changed_artifact(bench.artifacts[bench.target], bench.folder / "changed.pt", **changes)
        if bench.deploy(bad).ok:
            raise EmulationError(f"{bench.pi.name}: an artifact was deployed of which is true: {message}")
        there = bench.state / "by-hand.pt"
        shutil.copy(bad, there)
        bench.undo.callback(there.unlink, missing_ok=True)
        if not re.search(message, bench.rover("release", "stage", "--unsigned", f"/{STATE}/by-hand.pt")):
            what = f"{bench.pi.name}: the rover did not refuse it by '{message}'"
            raise EmulationError(what, found=bench.outputs[-1])

    return inject


def _sign_by_another(bench: DeploymentBench) -> None:
    key = bench.folder / "another"
    if not key.exists():
        run("ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "another laptop", "-f", key, error=EmulationError)
    bench.deploy(rover_signing_key=str(key))


def _two_at_once(bench: DeploymentBench) -> None:
    with ThreadPoolExecutor(1) as pool:
        second: list[Any] = []

        def begin(bench: DeploymentBench) -> None:
            second.append(pool.submit(bench.deploy, bench.artifacts[bench.before], name="second"))

        _strike(_anytime, begin, in_check=True)(bench)
        second[0].result()


def _tamper_in_use(bench: DeploymentBench) -> dict[str, Any]:
    flip(bench.releases.policy)
    shown, wrong = bench.status(bench.healthy())
    bench.deploy(bench.artifacts[bench.before])
    return {"status_before": shown, "status_before_true": not wrong}


def _roll_back(bench: DeploymentBench) -> None:
    play = bench.play("rollback")
    bench.outputs.append(play.output)
    if play.ok:
        raise EmulationError(f"{bench.pi.name}: rolled back to nothing")


# The table

LOST = "UNREACHABLE!|does not answer any more"  # printed when ssh ends
FULL = "No space left on device"
IN_CHECK = "a second into its parity vectors"
OTHER_TORCH, A_LIE = r"made with torch 9\.9\.9, rovers have", "its manifest says dynamic, its code is not"


def _power_cut(
    when: str, moment: Callable[[Disk], bool], how: str = IN_CHECK, *, fresh: bool = True
) -> DeploymentFault:
    def cut(bench: DeploymentBench) -> None:
        bench.cut_power(moment)

    in_check = how == IN_CHECK
    inject = _strike(moment, cut, in_check=in_check)
    return DeploymentFault(f"power cut {when}", inject, LOST, how, fresh=fresh and not in_check)


FAULTS = [
    _power_cut("before the transfer", Disk.awaiting, "once there is a folder for it, and nothing in it"),
    _power_cut("in the transfer", Disk.arriving, "once some of it is there"),
    _power_cut("after the transfer", Disk.unopened, "once all is there, and nothing made of it"),
    _power_cut("before fsync", Disk.writing, "while the new release's policy.pt is written"),
    _power_cut("before the release has its name", Disk.written,
               "once all its bytes are written, while they are looked at"),
    _power_cut("after fsync and rename", Disk.named, "once its folder has its name"),
    _power_cut("in the health check before the switch", Disk.named),
    _power_cut("right after the switch", Disk.just_switched, "once current points to it", fresh=False),
    _power_cut("in the health check after the switch", Disk.just_switched),
    _power_cut("between switch and restart", lambda disk: disk.remembered, fresh=False, how=
               "once it was proven again; a power cut ends a service too, which then loads what current points to"),
    DeploymentFault("disk full in the transfer", _little_room(0), FULL, f"{ROOM >> 20} MB are free", fresh=True),
    DeploymentFault("too little room for a release", _little_room(2), r"\d+ MB free, \d+ are needed; prune releases",
                    "it can arrive, but the release does not fit beside it", fresh=True),
    DeploymentFault("disk full while the release is written", _fill_while_staging, "the disk is full; what was in use "
                    "still is", "something else takes all that is free, once there was room enough", fresh=True),
    DeploymentFault("a byte flipped on the way", _strike(Disk.arriving, lambda bench: bench.network.flip(1 << 20)),
                    f"transfer mechanism failed|{LOST}", "in the network, once some of it has come through: ssh "
                    "notices and ends, and Ansible may send it again", fresh=True),
    DeploymentFault("a byte flipped in what has arrived",
                    _strike(lambda disk: disk.complete, lambda bench: flip(bench.incoming / POLICY)),
                    "arrived damaged .* send it again", "on the rover's disk", fresh=True),
    DeploymentFault("ssh lost in the transfer", _strike(Disk.arriving, lambda bench: bench.network.cut()), LOST, "the "
                    "network is cut once some of it has come through; the next deployment sends all of it", fresh=True),
    DeploymentFault("ssh lost in the health check", _strike(_anytime, lambda bench: bench.network.cut(), in_check=True),
                    LOST, "the network is cut while the rover proves the new model; it goes on"),
    DeploymentFault("network silent in the transfer",
                    # The limit of each try to reach it again; ssh's own limit is in inventory.ini.
                    _strike(Disk.arriving, lambda bench: bench.network.silence(), ansible_ssh_timeout=RETRY_S), LOST,
                    "out of reach: no packet comes through, and no connection ends", fresh=True),
    DeploymentFault("artifact with a wrong hash", _strike(lambda disk: disk.complete, _name_another),
                    "contains [0-9a-f]{12}, not [0-9a-f]{12}; pack it again",
                    "what describes it names another artifact", fresh=True),
    DeploymentFault("artifact of another torch", _refused(OTHER_TORCH, versions={"torch": "9.9.9", "rover_lib": ""}),
                    OTHER_TORCH, "its manifest says so; refused by laptop and rover"),
    DeploymentFault("manifest that lies", _refused(A_LIE, mode="dynamic"), A_LIE,
                    "it says dynamic of INT8 convolutions; refused by laptop and rover"),
    DeploymentFault("artifact signed by another laptop", _sign_by_another, "not signed by a laptop that this rover "
                    "knows", "with an ssh key that did not provision the rover", fresh=True),
    DeploymentFault("parity vectors that fail", lambda bench: bench.deploy(write_changed_artifact(
                        bench.artifacts[bench.target], bench.folder / "parity.pt", answers=0.5)),
                    "computes something else here", "they want other answers"),
    DeploymentFault("two deployments at once", _two_at_once, "another deployment is at work",
                    "the second is of the model in use, and begins while the first one's is proven"),
    DeploymentFault("release tampered with before it was proven",
                    lambda bench: bench.deploy_until(lambda disk: bench.proves(), lambda: flip(bench.released)),
                    r"is not what policy\.pt\.sha256 says", "a byte of it, as its health check begins"),
    DeploymentFault("release tampered with after the switch",
                    _strike(lambda disk: disk.switched, lambda bench: flip(bench.released)),
                    "failed after the switch, [0-9a-f]{12} is in use again",
                    "a byte of it, once it is in use: the health check fails, and the rover goes back by itself"),
    DeploymentFault("release in use tampered with", _tamper_in_use, ": deployed", "a byte of it; status says so, its "
                    "health check fails, and the next deployment replaces it"),
    DeploymentFault("rollback with nothing to roll back to", _roll_back, "there is no release to roll back to",
                    "rollback.yml on a rover with one release, then deploy.yml", fresh=True),
]  # fmt: skip


# Rows


def break_deployments(
    layers: Sequence[Path],
    artifacts: Mapping[str, Path],
    *,
    done: Callable[[dict[str, Any]], object] = lambda row: None,
    say: Say = lambda text: None,
) -> list[dict[str, Any]]:
    """Run every fault, each on one of a few rovers; return their rows in the order of FAULTS.

    layers: of a Container that was provisioned, and is off. A rover with another model first gets the first artifact.
    done: called with each finished row, one at a time. Raises EmulationError if no row can be made at all.
    """
    waiting = list(FAULTS)
    rows: dict[str, dict[str, Any]] = {}
    telling = threading.Lock()
    with rovers([f"breaks{i + 1}" for i in range(WORKERS)], layers, artifacts) as benches:

        def work(bench: DeploymentBench) -> None:
            give_first_model(bench)
            while waiting and not bench.stop.is_set():
                fault = waiting.pop(0)
                row = _row(fault, bench)
                with telling:
                    rows[fault.name] = row
                    done(row)
                    say(_line(row))

        in_parallel(work, benches)
    return [rows[fault.name] for fault in FAULTS if fault.name in rows]


def wrong_rows(rows: Sequence[Mapping[str, Any]], at_least: int) -> list[str]:
    """Return a sentence for everything that is not as it must be. at_least: how many rows there must be."""
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


def row_of(name: str, bench: DeploymentBench) -> dict[str, Any]:
    """Run one fault on a rover that has one of the bench's models, and return its row."""
    return _row(next(fault for fault in FAULTS if fault.name == name), bench)


def _row(fault: DeploymentFault, bench: DeploymentBench) -> dict[str, Any]:
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


def _after(fault: DeploymentFault, bench: DeploymentBench) -> dict[str, Any]:
    """Make a fault happen; return how the rover is afterwards, and whether deploying again heals it."""
    bench.begin(fault.fresh)
    with bench.timed("fault"):
        details = fault.inject(bench)
    row = details if isinstance(details, dict) else {}
    if not bench.pi.on:
        row["disk"] = vars(bench.disk_then)
        with bench.timed("boot"):
            bench.pi.boot()
    bench.network.mend()
    output = " ".join(" ".join(bench.outputs).replace("\\n", " ").split())
    match = re.search(fault.message, output)
    if not match:
        raise Missed(f"{bench.pi.name}: nobody reported '{fault.message}', but: {output[-800:]}")
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
        "said": output[max(0, match.start() - 60) : match.end() + 100],
    }
    bench.heal()
    with bench.timed("rerun"):
        again = bench.deploy()
    model, whole = bench.mode_in_use()
    row["healed_by_rerun"] = again.ok and whole and model == bench.target
    if not row["healed_by_rerun"]:
        row["rerun"] = again.end[-1500:]
    bench.clean()
    return {**row, "seconds_of": {k: round(v, 1) for k, v in bench.seconds.items()}}


def _restore(bench: DeploymentBench) -> None:
    """Make the rover usable again after a row that did not come to its end."""
    bench.clean()
    bench.network.mend()
    if not bench.pi.on:
        bench.pi.boot()
    bench.begin()
    bench.deploy()


def _line(row: Mapping[str, Any]) -> str:
    if row.get("error"):
        return f"{row['fault']}: {row['error']}"
    good = row["healthy"] and row["status_true"] and row["healed_by_rerun"]
    return f"{row['fault']}: {row['model_after']} {'healthy, healed' if good else 'NOT WELL'} ({row['seconds']:.0f} s)"

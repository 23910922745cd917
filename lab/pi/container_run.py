"""`make pi-fast`: run every playbook on an emulated Pi that is up in seconds, and prove from within what they promise.

    report = run_container("runs/pi-fast.json", "runs/demo")

It goes from a flashed card to a driving service: provision, twice and in check mode; deploy, status, benchmark, drive,
a second model, rollback. Then it proves what is installed, what the service's sandbox lets through, what systemd does
if a loop hangs, if the camera is gone, and at boot, and how a Pi camera and a gamepad end a drive. The Pi is a
container (container.py); its Arduino is the real firmware in simavr, its camera a FIFO of JPEGs. Debian's and Python's
packages come from the network by this machine's own settings, as they would for a newcomer.

Times of the emulated programs say nothing about a Pi: they are some ten times slower. systemd and the Arduino take
their real time. An INT8 plan takes half a second here, which is too long to drive by. So the small policy of the fault
bench drives, deployed like any other, at HZ. The INT8 policy is deployed, proven by its parity vectors in the service's
sandbox, loaded by the service until it could drive, and timed.

runs/pi-fast.json is a stage "pi-fast" (onboard/stage.py). Its metrics:
    steps          [{step, seconds, ok, ...}], for a playbook also play and recap (Ansible's counts by host)
    second_run     Ansible's own recap of provisioning a second time, as lines
    driving_after_s  from the beginning until a human could arm the car; plays_s: for all playbooks before the proofs
    system_cached  whether the Pi's file system was in the cache
    engine         what computes the policy there
    environment    {packages: [{name, version, from}], unhashed, lerobot, missing, others, of_view, size_mb}
    sandbox        {exposure, writable, probes: [{probe, inside, outside}]}; inside: "" means that it worked
    service        {hang: {...}, start_limit: {...}, boot: {...}}, in seconds, see the functions of those names
    drive          {ticks, driven, ended} of the fetched flight log; recorded: {episodes, left, frames, commands}
    view, car      [{row, wanted, found, holds}], see view_proofs.py and car_proofs.py
    pieces         {cut_after, changed_after, undone, stale} of provisioning that is cut off, see cut_plays.py
    faults         [{fault, model_after, healthy, healed_by_rerun, ...}], see deployment_faults.py
    gates          [{gate, wanted, found, holds}], the limits from lab/params.yml
`wrong` has a sentence for everything that is not as it should be. The file pi-fast.log beside it has all that the
playbooks printed.
"""

import contextlib
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from balloon_world.car import CameraFeed
from balloon_world.simulated_arduino import REST_US
from lab.arduino.emulator import NICE as ARDUINO_NICE
from lab.arduino.emulator import EmulatedArduino
from lab.driving.policy import PLAIN, make_artifact, pictures
from lab.pi import playbooks
from lab.pi.car_proofs import VARIABLES, camera_rows, gamepad_rows, offer_camera
from lab.pi.container import CAMERA, PORT, Container
from lab.pi.cut_plays import provision_in_pieces
from lab.pi.debian_image import debian_image
from lab.pi.deployment_bench import DeploymentBench
from lab.pi.deployment_faults import break_deployments, row_of, wrong_rows
from lab.pi.emulation import EmulationError, emulation, free_port, interruptible, require, require_arduino, wait_for
from lab.pi.playbooks import Play
from lab.pi.pulses import Pins, moving
from lab.pi.report import PiReport, Row
from lab.pi.service_proofs import READY_S, STATE, VENV, environment, hang, sandbox, show, start_limit
from lab.pi.view_proofs import view_again, view_beside_a_drive, view_gone
from rover_lib.onboard.artifact.engines import ONNXRUNTIME, TORCH
from rover_lib.onboard.artifact.manifest import ONNX_SUFFIX
from rover_lib.onboard.drive.flight_log import read_log
from rover_lib.onboard.drive.service import UNIT
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.recording.episode import json_controls
from rover_lib.onboard.stage import sha256_of

STAGE = "pi-fast"
ROVER = "rover1"
ARTIFACTS = {  # by engine: what is deployed first, and what after it
    "torch": ("policy_static.pt", "policy_mixed.pt"),
    "onnxruntime": (f"policy_static{ONNX_SUFFIX}", f"policy_fp32{ONNX_SUFFIX}"),
}
MAKES = {"torch": "make demo leaves them", "onnxruntime": "rover export RUN --onnx leaves them"}
HZ = 10  # the service's rate, which the emulator manages on a busy machine; a real Pi drives at 30
NICE = -5  # the priority of the emulated Pi, as a real one has a processor of its own
ONE_FAULT = "a byte flipped in what has arrived"  # the only one of deployment_faults.py that CI runs


def run_container(
    output: Path | str,
    demo: Path | str,
    *,
    engine: str = "torch",
    short: bool = False,
    view: bool = False,
    faults: bool = True,
    pieces: int | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> PiReport:
    """Run everything, and write the report to `output` whatever fails.

    demo: a run's folder with ARTIFACTS. engine: what computes the policy on the Pi, as in rover_engine. short: only
    provision, deploy, one fault of a deployment and armed drives, as CI has no more time. view: with `short`, include
    the view's service, which other runs always include. faults: include the faults of deployments, which
    run only with torch. pieces: only provision, cut off after each of so many tasks. say: called with a line for
    each step.
    Raises RoverError if it cannot begin: without root, without artifacts, or if packages cannot be installed.
    """
    output, demo = Path(output), Path(demo)
    artifacts = [demo / name for name in ARTIFACTS[engine]]
    if gone := [a.name for a in artifacts if not a.is_file()]:
        raise EmulationError(f"{demo}: no {' and no '.join(gone)} to deploy", remedy=MAKES[engine])
    require()
    require_arduino()
    report = PiReport(STAGE, output, say, {a.name: sha256_of(a) for a in artifacts})
    output.parent.mkdir(parents=True, exist_ok=True)
    with (
        interruptible(),
        emulation(),
        tempfile.TemporaryDirectory(prefix="rover-plays-") as folder,  # ssh's sockets want a short path
        output.with_suffix(".log").open("w") as log,
    ):
        run = _Run(report, Path(folder), log, engine)
        try:
            run.all(artifacts[0], artifacts[1], short=short, view=view, faults=faults, pieces=pieces)
        except RoverError as error:
            report.wrong.append(str(error))
        finally:
            report.write()
    return report


class _Run:
    def __init__(self, report: PiReport, folder: Path, log: Any, engine: str):
        self.report, self.folder, self.log, self.engine = report, folder, log, engine
        self.metrics = report.metrics
        self.metrics["engine"] = engine
        self.variables: dict[str, Any] = {
            "rover_engine": engine,
            "rover_wheels": str(folder / "wheels"),
            "rover_packed": str(folder / "packed"),
            "rover_fetched": str(folder / "fetched"),
            "rover_camera": CAMERA,
            "rover_film": True,
            "rover_port": PORT,
            "rover_hz": HZ,
            "rover_ready_s": READY_S,
            "rover_record": True,
            "rover_view_port": free_port(),  # a free one, as the network is this machine's, which may run a view too
        }

    def all(self, static: Path, other: Path, *, short: bool, view: bool, faults: bool, pieces: int | None) -> None:
        begun = time.monotonic()
        with self.report.step("system") as row:
            debian_image()
            cached = row["cached"] = self.metrics["system_cached"] = time.monotonic() - begun < 5
        if pieces:
            return self.cut_off(pieces)
        with Container(ROVER, nice=NICE) as pi:
            offer_camera(pi)
            with self.report.step("boot"):
                pi.boot()
            with _car(pi) as pins:
                if short:
                    self.variables |= {**VARIABLES, "rover_view": view}
                    self.one_fault(pi, static)
                    if view:
                        self.view(pi, pins)
                        self.no_view(pi)
                    self.car(pi, pins)
                    return self.environment(pi)
                driving_s = self.playbooks(pi, static, other)
                self.metrics["driving_after_s"] = round(driving_s - begun, 1)
                self.metrics["plays_s"] = round(time.monotonic() - begun, 1)
                what = f"from nothing to a driving service, image {'' if cached else 'not '}cached"
                minutes = self.report.gates["minutes" if cached else "minutes_uncached"]
                self.report.limit(what, round((driving_s - begun) / 60, 1), minutes, "min")
                self.proofs(pi, pins)
            if faults and self.engine == "torch":
                self.deployment_faults(pi, static, other)
        if not short:
            self.cut_off(1)

    # The playbooks

    def playbooks(self, pi: Container, static: Path, other: Path) -> float:
        """Run all playbooks; return when the service could drive for the first time (monotonic seconds)."""
        gate = self.report.gate
        self.play("provision", pi)
        self.play("deploy", pi, rover_artifact=str(static))
        self.play("drive", pi, "drive, not armed")
        driving_s = time.monotonic()
        state = show(pi, "ActiveState", "StatusText")
        could = state["ActiveState"] == "active" and state["StatusText"].startswith("disarmed")
        gate("the service could drive", "active, disarmed", state, could)
        again = self.play("provision", pi, "provision again")
        self.metrics["second_run"] = again.recap_lines
        self.report.say("\n".join(again.recap_lines))
        gate("provision a second time", "changed=0", again.changed, again.changed == 0)
        checked = self.play("provision", pi, "provision --check", check=True)
        gate("provision in check mode", "changed=0", checked.changed, checked.changed == 0)
        self.play("status", pi)
        self.play("benchmark", pi, rover_iterations=3)
        fetched = self.folder / "fetched" / f"benchmark-{ROVER}.json"
        gate("benchmark fetched", "a file", fetched.name, fetched.is_file())
        current = pi.root / "var/lib/rover/models/current"
        first = current.readlink().name
        self.play("deploy", pi, "deploy another", rover_artifact=str(other), rover_allow=["mode"])
        second = current.readlink().name
        gate("another model deployed", "another content hash", second[:12], first != second != "")
        self.play("rollback", pi)
        back = current.readlink().name
        gate("rolled back", first[:12], back[:12], back == first)
        self.play("deploy", pi, "deploy a quick one", rover_artifact=str(self.quick()), rover_allow=["mode"])
        self.play("drive", pi, rover_arm=True, rover_seconds=10)
        self.flight(pi)
        self.play("status", pi, "status again")
        return driving_s

    def one_fault(self, pi: Container, static: Path) -> None:
        """Let a deployment fail: the rover must stay as it was, and another deployment must heal it. Then drive."""
        with _bytecode_from_here(pi.root):
            self.play("provision", pi)
        self.play("deploy", pi, rover_artifact=str(static))
        artifacts = {"static": static, "fp32": self.quick()}
        with (
            self.report.step(ONE_FAULT),
            DeploymentBench(pi, artifacts, self.folder, threading.Event(), ("mode",)) as bench,
        ):
            row = row_of(ONE_FAULT, bench)
            self.metrics["faults"] = [row]
        wrong = wrong_rows([row], 1)
        self.report.gate(ONE_FAULT, "the rover healthy, and healed", wrong or "healed", not wrong)
        self.play("drive", pi, rover_arm=True, rover_seconds=10)
        self.flight(pi)

    def quick(self) -> Path:
        """Make an artifact that is quick enough for an emulated Pi to drive by."""
        engine, suffix = (TORCH, ".pt") if self.engine == "torch" else (ONNXRUNTIME, ONNX_SUFFIX)
        path = self.folder / f"policy_quick{suffix}"
        make_artifact(path, camera="cam_front", size=(72, 128), engine=engine)
        return path

    def play(self, book: str, pi: Container, name: str = "", *, check: bool = False, **variables: Any) -> Play:
        """Run a playbook, which has to work. Raises EmulationError with the end of its output if it fails."""
        with self.report.step(name or book) as row:
            done = playbooks.run(book, [pi], folder=self.folder, check=check, variables={**self.variables, **variables})
            self.log.write(f"===== {name or book}\n{done.output}\n")
            self.log.flush()
            row |= {**done.row(), "seconds": row.get("seconds")}
            if not done.ok:
                raise EmulationError(f"{book}.yml failed, its output ends: {done.end}")
        return done

    def flight(self, pi: Container) -> None:
        """Check the flight log and the episode that drive.yml brought home."""
        fetched = self.folder / "fetched" / ROVER
        log = next(iter(fetched.rglob("flight.log")), None)
        if log is None:
            self.report.wrong.append("drive.yml fetched no flight log")
            return
        flight = read_log(log)
        states = list(flight.ticks["state"])
        driven = sum(s == "A" for s in states)
        self.report.gate("ticks driven", "at least 10", driven, driven >= 10)
        home = fetched / "episodes"
        left = [p.name for p in (pi.root / STATE.lstrip("/") / "episodes").glob("*")]
        episodes = [p.name for p in home.glob("*")]
        frames = len(list(home.glob("*/frames/*.jpg")))
        commands = sum(len(json_controls(home / name / "episode_data.json")) for name in episodes)
        recorded = {"episodes": episodes, "left": left, "frames": frames, "commands": commands}
        whole = len(episodes) == 1 and not left and min(frames, commands) >= 10
        self.report.gate("the drive, recorded and brought home", "an episode, none left on the rover", recorded, whole)
        ended = next((str(e) for e in reversed(flight.events) if "ended" in str(e)), "")
        self.metrics["drive"] = {"ticks": len(states), "driven": driven, "ended": ended, "recorded": recorded}

    def cut_off(self, every: int) -> None:
        """Provision another rover, from nothing, by plays that are killed after every `every`-th task."""

        def done(play: Play) -> None:
            self.log.write(f"===== provision, in pieces\n{play.output}\n")
            self.log.flush()

        with Container("rover2", nice=NICE) as pi, self.report.step("provision, in pieces") as row:
            pi.boot()
            variables = {**self.variables, "rover_engine": "onnxruntime", "rover_view": True}
            row |= provision_in_pieces(pi, folder=self.folder, variables=variables, every=every, done=done)
            installed = environment(pi.root, "onnxruntime")
        self.metrics["pieces"] = row
        lacks = {key: row[key] for key in ("changed_after", "undone", "stale") if row[key]}
        lacks |= {key: installed[key] for key in ("missing", "others", "unhashed") if installed[key]}
        what = f"provision, killed {len(row['cut_after'])} times"
        self.report.gate(what, "whole, and changed=0 after", lacks or "so", not lacks and len(row["cut_after"]) > 5)

    # The proofs

    def proofs(self, pi: Container, pins: Pins) -> None:
        gate, gates = self.report.gate, self.report.gates
        self.environment(pi)
        with self.report.step("sandbox"):
            sandboxed = self.metrics["sandbox"] = sandbox(pi)
        self.report.limit("systemd-analyze security", sandboxed["exposure"], gates["exposure"], "of 10")
        leaks = [p["probe"] for p in sandboxed["probes"] if p["refused"] and not p["inside"]]
        blunt = [p["probe"] for p in sandboxed["probes"] if p["outside"]]
        gate("sandbox, from within", "all refused", leaks or "all refused", not leaks)
        gate("the same, outside of it", "all work", blunt or "all work", not blunt)
        with self.report.step("hang"):
            hung = hang(pi, pins)
        with self.report.step("start_limit"):
            limited = start_limit(pi)
        self.metrics["service"] = {"hang": hung, "start_limit": limited}
        self.report.limit("hung loop restarted", hung["restarted_s"], gates["restart_s"], "s")
        self.report.limit("hung loop, throttle off", hung["stopped_s"], gates["stopped_s"], "s")
        gate("hung loop, the car", "disarmed", hung, hung["disarmed"])
        left = limited["tries"] == 5 and limited["state"] == "failed"
        gate("start limit", "5 tries, then failed", limited, left)
        self.variables["rover_view"] = True
        self.play("provision", pi, "provision, with the view")
        self.view(pi, pins)
        self.boot(pi, pins)
        with self.report.step("the view again"):
            self.report.rows("view", view_again(pi, self.variables["rover_view_port"]))
        self.variables |= VARIABLES
        self.no_view(pi)
        self.car(pi, pins)

    def environment(self, pi: Container) -> None:
        """Check what is installed, without the view."""
        gate, limit_mb = self.report.gate, self.report.gates["environment_mb"][self.engine]
        with self.report.step("environment"):
            installed = self.metrics["environment"] = environment(pi.root, self.engine)
        size_mb = installed["size_mb"]
        gate("the Pi's environment", f"under {limit_mb} MB", size_mb, size_mb < limit_mb)
        gate("all of it hashed, no lerobot", "none else", installed["unhashed"], not installed["unhashed"])
        lacks_or_has = installed["missing"] + installed["others"] + installed["of_view"]
        gate(f"{self.engine}, no other engine and no view", "so installed", lacks_or_has or "so installed",
             not lacks_or_has)  # fmt: skip

    def view(self, pi: Container, pins: Pins) -> None:
        """Prove the provisioned view's service beside an armed drive of the small policy."""
        with self.report.step("the view"):
            installed = environment(pi.root, self.engine)
            needs, unhashed = installed["of_view"], installed["unhashed"]
            installed_row = Row("what the view needs", "all by hash", unhashed or needs, bool(needs) and not unhashed)
            port, stop_s = self.variables["rover_view_port"], self.report.gates["view_stop_s"]
            self.report.rows("view", [installed_row, *view_beside_a_drive(pi, pins, port, stop_s)])

    def no_view(self, pi: Container) -> None:
        """Provision without the view again, and prove that it is gone."""
        self.variables["rover_view"] = False
        self.play("provision", pi, "provision, without the view")
        with self.report.step("no view"):
            self.report.rows("view", view_gone(pi, self.variables["rover_view_port"]))

    def car(self, pi: Container, pins: Pins) -> None:
        """Prove what a Pi camera, a gamepad and a power cut of the Arduino end in."""
        with self.report.step("camera of the Pi"):
            self.report.rows("car", camera_rows(pi, pins))
        with self.report.step("gamepad, and the Arduino's power"):
            self.report.rows("car", gamepad_rows(pi))

    def boot(self, pi: Container, pins: Pins) -> None:
        """Prove that the service is disabled at boot by default, and that with rover_start_at_boot it starts disarmed.

        The car must not move meanwhile.
        """
        with self.report.step("boot without the service"):
            default = show(pi, "UnitFileState")["UnitFileState"]
        enabled = self.play("provision", pi, "provision, to start at boot", rover_start_at_boot=True)
        with self.report.step("power cut and boot"):
            pi.cut_power()
            at_s = time.monotonic()
            pi.boot()
            ready = wait_for(lambda: show(pi, "StatusText")["StatusText"].startswith("disarmed"), READY_S)
            time.sleep(2)
            moved = moving(pins.since(at_s))
            booted = {"by_default": default, "changed": enabled.changed, "disarmed": ready, "moved": moved}
            booted["ready_s"] = round(time.monotonic() - at_s, 1)
            self.metrics["service"]["boot"] = booted
        ok = default == "disabled" and ready and not moved
        self.report.gate("boot", "disabled by default; enabled it is disarmed", booted, ok)

    def deployment_faults(self, pi: Container, static: Path, mixed: Path) -> None:
        """Run the faults of a deployment on rovers that start from what this one has become."""
        pi.inside("systemctl", "disable", UNIT)  # the service of those rovers would only look for a camera
        pi.power_off()
        artifacts, least = {"static": static, "mixed": mixed}, self.report.gates["rows"]
        rows = self.metrics["faults"] = []

        def done(row: dict[str, Any]) -> None:
            rows.append(row)
            self.report.write()

        with self.report.step("faults of a deployment"):
            rows[:] = break_deployments(pi.layers, artifacts, done=done, say=self.report.say)
        wrong = wrong_rows(rows, least)
        self.report.gate("faults of a deployment", f"{least} rows, healthy and healed", wrong or len(rows), not wrong)


@contextlib.contextmanager
def _bytecode_from_here(root: Path) -> Iterator[None]:
    """Let this machine's Python compile what pip installs, if it has the Pi's version: emulated, that takes minutes."""
    if not (root / f"usr/lib/python{sys.version_info[0]}.{sys.version_info[1]}").is_dir():
        yield
        return
    with (root / "etc/pip.conf").open("a") as settings:
        settings.write("[install]\nno-compile = no\n")  # a double negation: pip wants "no" for such an option
    yield
    # In another process, because this one has threads. A file that cannot be compiled is ignored, as by pip.
    command = [sys.executable, "-m", "compileall", "-q", "-j", "0", "-s", str(root), "-p", "/", f"{root}{VENV}"]
    subprocess.run(command, capture_output=True)


# The car


@contextlib.contextmanager
def _car(pi: Container) -> Iterator[Pins]:
    """Plug in a camera and an Arduino, and give what its pins do."""
    with (
        CameraFeed(pi.bench / "camera", *pictures(PLAIN, (180, 320)), rate_hz=HZ),
        EmulatedArduino(every_pulse=False, transmitter=REST_US, ready=True, nice=ARDUINO_NICE) as board,
        Pins(board) as pins,
    ):
        (pi.bench / "camera").chmod(0o666)
        pi.plug(board.port)
        yield pins

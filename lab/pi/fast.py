"""`make pi-fast`: every playbook on an emulated Pi that is up in seconds, and what they promise proven from within.

    outcome = run_fast("runs/pi-fast.json", "runs/demo")

From a flashed card to a driving service (provision, twice, and checked; deploy, status, benchmark, drive, a second
model, rollback), then: what is installed, what the service's sandbox lets through, what systemd does with a loop that
hangs, with a camera that is gone, and at boot. The Pi is a container (container.py); its Arduino is the real firmware
in simavr, its camera a FIFO of JPEGs. Debian's and Python's packages come online, by this machine's own settings, as
they would for a newcomer; without internet is tested in the whole machine (`make pi`).

Times of the emulated programs say nothing about a Pi: they are some ten times slower. What systemd does takes its real
time, and so does the Arduino. An INT8 plan takes half a second here, which is too long to drive by; so what drives is
the small policy of the fault bench, deployed as any other, at HZ. The INT8 policy is deployed, proven by its parity
vectors in the service's sandbox, loaded by the service until it could drive, and timed. It drives in `make pi`, whose
clock is slower.

runs/pi-fast.json is a stage "pi-fast" (onboard/stage.py). Its metrics:
    steps          [{step, seconds, ok, ...}], of a playbook also play and recap (Ansible's counts by host)
    second_run     Ansible's own recap of provisioning a second time, as lines
    driving_after_s  from switching on until a human could arm the car; plays_s: of all playbooks before the proofs
    system_cached  whether the Pi's file system was in the cache
    environment    {packages: [{name, version, from}], unhashed, lerobot, size_mb}
    sandbox        {exposure, writable, probes: [{probe, inside, outside}]}; inside: "" is "it worked"
    service        {hang: {...}, start_limit: {...}, boot: {...}}, in seconds, see the functions of those names
    drive          {ticks, driven, ended} of the fetched flight log; recorded: {episodes, left, frames, commands}
    faults         [{fault, model_after, healthy, healed_by_rerun, ...}], see breakage.py
    fleet          {cases: [{broken, results, models, healthy, ...}], good}, see fleet.py
    gates          [{gate, wanted, found, holds}], the limits from lab/params.yml
What is not as it should be is a sentence in `wrong`. Beside it, pi-fast.log has all that the playbooks said.
"""

import contextlib
import json
import os
import re
import shlex
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

from lab.arduino.emulator import NICE as ARDUINO_NICE
from lab.arduino.emulator import EmulatedArduino
from lab.driving.policy import PLAIN, make_artifact, pictures
from lab.pi import plays
from lab.pi.bench import Bench
from lab.pi.breakage import break_deployments, row_of, wrong_rows
from lab.pi.container import CAMERA, PORT, Container
from lab.pi.fleet import fleet
from lab.pi.outcome import Outcome
from lab.pi.pulses import Pins
from lab.pi.system import EmulationError, emulation, interruptible, require, require_arduino, system
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.pwm import STOPPED_THROTTLE_US
from rover_lib.onboard.recording import read_controls
from rover_lib.onboard.service import UNIT
from rover_lib.onboard.stage import sha256_of
from rover_lib.onboard.telemetry import read_log
from rover_lib.world.car import CameraFeed
from rover_lib.world.standin import REST_US

STAGE = "pi-fast"
ROVER = "rover1"
VENV, STATE = "/opt/rover/venv", "/var/lib/rover-drive"
ARTIFACTS = ("policy_static.pt", "policy_mixed.pt")
HZ = 10  # of the service: what the emulator manages on a busy machine; a Pi has 30
NICE = -5  # of the emulated Pi, which has a processor of its own
ONE_FAULT = "a byte flipped in what has arrived"  # of those in breakage.py the one that CI meets
READY_S = 600  # torch under emulation on a busy machine


def run_fast(
    output: Path | str,
    demo: Path | str,
    *,
    short: bool = False,
    faults: bool = True,
    say: Callable[[str], None] = lambda text: None,
) -> Outcome:
    """All of it; the report is written to `output` whatever fails.

    demo: a run's folder with ARTIFACTS. short: provision, deploy, one fault of a deployment and an armed drive, which
    is what CI has time for. faults: of deployments, and the fleet, too. say: told a line for each step.
    Raises RoverError where it cannot begin: no root, packages that cannot be installed, no artifacts.
    """
    output, demo = Path(output), Path(demo)
    artifacts = [demo / name for name in ARTIFACTS]
    if gone := [a.name for a in artifacts if not a.is_file()]:
        raise EmulationError(f"{demo}: no {' and no '.join(gone)} to deploy; make demo leaves them")
    require()
    require_arduino()
    outcome = Outcome(STAGE, output, say, {a.name: sha256_of(a) for a in artifacts})
    output.parent.mkdir(parents=True, exist_ok=True)
    with (
        interruptible(),
        emulation(),
        tempfile.TemporaryDirectory(prefix="rover-plays-") as folder,  # ssh's sockets want a short path
        output.with_suffix(".log").open("w") as log,
    ):
        run = _Run(outcome, Path(folder), log)
        try:
            run.all(artifacts[0], artifacts[1], short=short, faults=faults)
        except RoverError as error:
            outcome.wrong.append(str(error))
        finally:
            outcome.write()
    return outcome


class _Run:
    def __init__(self, outcome: Outcome, folder: Path, log: Any):
        self.outcome, self.folder, self.log = outcome, folder, log
        self.metrics = outcome.metrics
        self.variables: dict[str, Any] = {
            "rover_wheels": str(folder / "wheels"),
            "rover_packed": str(folder / "packed"),
            "rover_fetched": str(folder / "fetched"),
            "rover_command": str(Path(sys.executable).with_name("rover")),
            "rover_camera": CAMERA,
            "rover_port": PORT,
            "rover_hz": HZ,
            "rover_ready_s": READY_S,
            "rover_record": True,
        }

    def all(self, static: Path, mixed: Path, *, short: bool, faults: bool) -> None:
        gates = self.outcome.gates
        with self.outcome.step("system") as row:
            before = time.monotonic()
            system()
            row["cached"] = self.metrics["system_cached"] = time.monotonic() - before < 5
        begun = time.monotonic() - self.outcome.steps[0]["seconds"]
        with Container(ROVER, nice=NICE) as pi:
            with self.outcome.step("boot"):
                pi.boot()
            with _car(pi) as pins:
                if short:
                    self.one_fault(pi, static)
                    return
                driving_s = self.playbooks(pi, static, mixed)
                self.metrics["driving_after_s"] = round(driving_s - begun, 1)
                self.metrics["plays_s"] = round(time.monotonic() - begun, 1)
                cached = self.metrics["system_cached"]
                minutes = gates["minutes" if cached else "minutes_uncached"]
                self.outcome.gate(
                    f"all plays green, from nothing to a driving service, image {'' if cached else 'not '}cached",
                    f"at most {minutes} min",
                    round(self.metrics["driving_after_s"] / 60, 1),
                    self.metrics["driving_after_s"] <= 60 * minutes and all(s["ok"] for s in self.outcome.steps),
                )
                self.proofs(pi, pins)
            if faults:
                self.breakage(pi, static, mixed)

    # The playbooks

    def playbooks(self, pi: Container, static: Path, mixed: Path) -> float:
        """All playbooks; when the service could drive for the first time (monotonic seconds)."""
        self.play("provision", pi)
        self.play("deploy", pi, rover_artifact=str(static))
        self.play("drive", pi, "drive, not armed")
        driving_s = time.monotonic()
        said = show(pi, "ActiveState", "StatusText")
        could = said["ActiveState"] == "active" and said["StatusText"].startswith("disarmed")
        self.outcome.gate("the service could drive", "active, disarmed", said, could)
        again = self.play("provision", pi, "provision again")
        self.metrics["second_run"] = again.recap_lines
        self.outcome.say("\n".join(again.recap_lines))
        self.outcome.gate("provision a second time", "changed=0", again.changed, again.changed == 0)
        checked = self.play("provision", pi, "provision --check", check=True)
        self.outcome.gate("provision in check mode", "changed=0", checked.changed, checked.changed == 0)
        self.play("status", pi)
        self.play("benchmark", pi, rover_iterations=3)
        fetched = self.folder / "fetched" / f"benchmark-{ROVER}.json"
        self.outcome.gate("benchmark fetched", "a file", fetched.name, fetched.is_file())
        first = self.current(pi)
        self.play("deploy", pi, "deploy another", rover_artifact=str(mixed))
        second = self.current(pi)
        self.outcome.gate("another model deployed", "another content hash", second[:12], first != second != "")
        self.play("rollback", pi)
        self.outcome.gate("rolled back", first[:12], self.current(pi)[:12], self.current(pi) == first)
        self.play("deploy", pi, "deploy a quick one", rover_artifact=str(self.quick()), rover_allow=["mode"])
        self.play("drive", pi, rover_arm=True, rover_seconds=10)
        self.flight(pi)
        self.play("status", pi, "status again")
        return driving_s

    def one_fault(self, pi: Container, static: Path) -> None:
        """A deployment that fails, leaves the rover as it was and is healed by another; it then drives what came."""
        self.play("provision", pi)
        self.play("deploy", pi, rover_artifact=str(static))
        artifacts = {"static": static, "fp32": self.quick()}
        with self.outcome.step(ONE_FAULT), Bench(pi, artifacts, self.folder, threading.Event(), ("mode",)) as bench:
            row = row_of(ONE_FAULT, bench)
            self.metrics["faults"] = [row]
        wrong = wrong_rows([row], 1)
        self.outcome.gate(ONE_FAULT, "the rover healthy, and healed", wrong or "healed", not wrong)
        self.play("drive", pi, rover_arm=True, rover_seconds=10)
        self.flight(pi)

    def quick(self) -> Path:
        """A policy that an emulated Pi can drive by."""
        path = self.folder / "policy_quick.pt"
        make_artifact(path, camera="cam_front", size=(72, 128), engine="qnnpack")
        return path

    def play(self, book: str, pi: Container, name: str = "", *, check: bool = False, **variables: Any) -> plays.Play:
        """Runs one, which has to work. Raises EmulationError with the end of what it said if not."""
        with self.outcome.step(name or book) as row:
            done = plays.run(book, [pi], folder=self.folder, check=check, variables={**self.variables, **variables})
            self.log.write(f"===== {name or book}\n{done.output}\n")
            self.log.flush()
            row |= {**done.row(), "seconds": row.get("seconds")}
            if not done.ok:
                raise EmulationError(f"{book}.yml failed, and said at its end: {done.end}")
        return done

    def current(self, pi: Container) -> str:
        """The content hash of the model in use."""
        return (pi.root / "var/lib/rover/models/current").readlink().name

    def flight(self, pi: Container) -> None:
        """What the flight log and the episode say that drive.yml brought home."""
        found = next(iter((self.folder / "fetched" / ROVER).rglob("flight.log")), None)
        if found is None:
            self.outcome.wrong.append("drive.yml fetched no flight log")
            return
        flight = read_log(found)
        states = list(flight.ticks["state"])
        self.metrics["drive"] = {
            "ticks": len(states),
            "driven": sum(s == "A" for s in states),
            "ended": next((str(e) for e in reversed(flight.events) if "ended" in str(e)), ""),
        }
        driven = self.metrics["drive"]["driven"]
        self.outcome.gate("ticks driven", "at least 10", driven, driven >= 10)
        home = self.folder / "fetched" / ROVER / "episodes"
        left = [p.name for p in (pi.root / STATE.lstrip("/") / "episodes").glob("*")]
        episodes = [p.name for p in home.glob("*")]
        found = {"episodes": episodes, "left": left, "frames": len(list(home.glob("*/frames/*.jpg")))}
        found["commands"] = sum(len(read_controls(home / name).times_s) for name in episodes)
        self.metrics["drive"]["recorded"] = found
        whole = len(episodes) == 1 and not left and min(found["frames"], found["commands"]) >= 10
        self.outcome.gate("the drive, recorded and brought home", "an episode, none left on the rover", found, whole)

    # The proofs

    def proofs(self, pi: Container, pins: Pins) -> None:
        with self.outcome.step("environment"):
            self.metrics["environment"] = found = environment(pi.root)
        limit = self.outcome.gates["environment_mb"]
        self.outcome.gate("the Pi's environment", f"under {limit} MB", found["size_mb"], found["size_mb"] < limit)
        self.outcome.gate("all of it hashed, no lerobot", "none else", found["unhashed"], not found["unhashed"])
        with self.outcome.step("sandbox"):
            self.metrics["sandbox"] = found = sandbox(pi)
        most = self.outcome.gates["exposure"]
        self.outcome.gate("systemd-analyze security", f"at most {most}", found["exposure"], found["exposure"] <= most)
        leaks = [p["probe"] for p in found["probes"] if p["refused"] and not p["inside"]]
        blunt = [p["probe"] for p in found["probes"] if p["outside"]]
        self.outcome.gate("sandbox, from within", "all refused", leaks or "all refused", not leaks)
        self.outcome.gate("the same, outside of it", "all work", blunt or "all work", not blunt)
        service = self.metrics["service"] = {}
        for name, proof in (("hang", hang), ("start_limit", start_limit)):
            with self.outcome.step(name):
                service[name] = proof(pi, pins)
        gates, hung, limited = self.outcome.gates, service["hang"], service["start_limit"]
        in_time = hung["restarted_s"] <= gates["restart_s"]
        self.outcome.gate("hung loop restarted", f"within {gates['restart_s']} s", hung["restarted_s"], in_time)
        stopped = hung["stopped_s"] <= gates["stopped_s"] and hung["disarmed"]
        self.outcome.gate("hung loop, the car", f"stopped within {gates['stopped_s']} s, disarmed", hung, stopped)
        left = limited["tries"] == 5 and limited["state"] == "failed"
        self.outcome.gate("start limit", "5 tries, then failed", limited, left)
        self.boot(pi, pins)

    def boot(self, pi: Container, pins: Pins) -> None:
        """Disabled at boot by default; with rover_start_at_boot it is up, and disarmed, and the car stands."""
        with self.outcome.step("boot without the service"):
            default = show(pi, "UnitFileState", "ActiveState")
        enabled = self.play("provision", pi, "provision, to start at boot", rover_start_at_boot=True)
        with self.outcome.step("power cut and boot"):
            pi.cut_power()
            at_s = time.monotonic()
            pi.boot()
            ready = wait_for(lambda: show(pi, "StatusText")["StatusText"].startswith("disarmed"), READY_S)
            time.sleep(2)
            moved = moving(pins, at_s)
            found = {"by_default": default["UnitFileState"], "changed": enabled.changed, "disarmed": ready}
            found |= {"ready_s": round(time.monotonic() - at_s, 1), "moved": moved}
            self.metrics["service"]["boot"] = found
        ok = default["UnitFileState"] == "disabled" and ready and not moved
        self.outcome.gate("boot", "disabled by default; enabled it is disarmed", found, ok)

    def breakage(self, pi: Container, static: Path, mixed: Path) -> None:
        """What can go wrong with a deployment, and a fleet, on rovers that start from what this one has become."""
        pi.inside("systemctl", "disable", UNIT)  # their own service would only look for a camera
        pi.power_off()
        artifacts, wanted = {"static": static, "mixed": mixed}, self.outcome.gates["rows"]
        with self.outcome.step("faults of a deployment"):
            rows = self.metrics["faults"] = []

            def done(row: dict[str, Any]) -> None:
                rows.append(row)
                self.outcome.write()

            rows[:] = break_deployments(pi.layers, artifacts, done=done, say=self.outcome.say)
        wrong = wrong_rows(rows, wanted)
        self.outcome.gate("faults of a deployment", f"{wanted} rows, healthy and healed", wrong or len(rows), not wrong)
        with self.outcome.step("fleet"):
            found = self.metrics["fleet"] = fleet(pi.layers, artifacts, say=self.outcome.say)
        cases = [case["results"] for case in found["cases"]]
        self.outcome.gate("fleet of three, one broken", "the rest untouched, all reported", cases, found["good"])


# The car


@contextlib.contextmanager
def _car(pi: Container) -> Iterator[Pins]:
    """Camera and Arduino, plugged in; what the pins do."""
    with (
        CameraFeed(pi.bench / "camera", *pictures(PLAIN, (180, 320)), rate_hz=HZ),
        EmulatedArduino(every_pulse=False, transmitter=REST_US, nice=ARDUINO_NICE) as board,
        Pins(board) as pins,
    ):
        (pi.bench / "camera").chmod(0o666)
        pi.plug(arduino=board.port)
        yield pins


def moving(pins: Pins, since_s: float) -> list[float]:
    """When (monotonic seconds) pulses that move the car began, or became others."""
    return [e.monotonic_s for e in pins.since(since_s) if e.pin == "throttle" and e.pulse_us > STOPPED_THROTTLE_US]


# What is proven, each on a Pi that is provisioned and has a model


def environment(root: Path) -> dict[str, Any]:
    """What is installed for the policy: name, version and who vouches for it; unhashed: what nobody does."""
    site = next((root / VENV.lstrip("/") / "lib").glob("python3*/site-packages"))
    pinned = hashed(plays.REPOSITORY / "requirements_pi.txt")
    packages = []
    for found in sorted(distributions(path=[str(site)]), key=lambda d: d.metadata["Name"].lower()):
        name, version = re.sub(r"[-_.]+", "-", found.metadata["Name"]).lower(), found.version
        origin = ""
        if version in pinned.get(name, ()):
            origin = "requirements_pi.txt, by hash"
        elif name == "rover-policy":
            origin = "the rover's own wheel"
        elif name in ("pip", "setuptools"):
            origin = "Debian's python3-venv"
        packages.append({"name": name, "version": version, "from": origin})
    venv = root / VENV.lstrip("/")
    sizes = {(s.st_dev, s.st_ino): s.st_blocks * 512 for p in venv.rglob("*") if (s := p.lstat())}
    names = {p["name"] for p in packages}
    return {
        "packages": packages,
        "unhashed": [p["name"] for p in packages if not p["from"] or p["name"] == "lerobot"],
        "lerobot": "lerobot" in names,
        "missing": sorted({"torch", "numpy", "opencv-python-headless", "pyserial"} - names),
        "size_mb": round(sum(sizes.values()) / 1e6),
    }


def hashed(requirements: Path) -> dict[str, set[str]]:
    """Versions by name that a requirements file pins together with at least one hash."""
    found: dict[str, set[str]] = {}
    for entry in re.split(r"\n(?=\S)", requirements.read_text()):
        if (pin := re.match(r"([A-Za-z0-9._-]+)==([^\s;\\]+)", entry)) and "--hash=sha256:" in entry:
            found.setdefault(re.sub(r"[-_.]+", "-", pin[1]).lower(), set()).add(pin[2])
    return found


PROBE = "/opt/rover/probe.py"
PROBES = r"""
import json, os, pathlib, socket, sys

def writes(path):
    pathlib.Path(path).write_text("x")
    os.unlink(path)

def connects(port):
    socket.create_connection(("127.0.0.1", port), 5).close()

def sends():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as s:
        s.connect(("192.0.2.1", 9))  # of no network; a route is all that this asks for
        s.send(b"x")

def has_route():
    socket.socket(socket.AF_INET, socket.SOCK_STREAM).close()

def asks_kernel():
    socket.socket(socket.AF_NETLINK, socket.SOCK_RAW).close()

def interfaces():
    names = {line.partition(":")[0].strip() for line in open("/proc/net/dev") if ":" in line}
    assert names - {"lo"}, "only lo"

found = {}
def probe(name, action, *arguments):
    try:
        action(*arguments)
        found[name] = ""
    except (OSError, AssertionError) as error:
        found[name] = f"{type(error).__name__}: {error}"

given = json.loads(sys.argv[1])
for path in given["write"]:
    probe(f"write {path}", writes, path)
for path in given["read"]:
    probe(f"read {path}", os.listdir, path)
probe("connect to a port of this machine", connects, given["port"])
probe("send to another machine", sends)
probe("open a network socket", has_route)
probe("ask the kernel about networks", asks_kernel)
probe("see a network", interfaces)

writable = []
for folder, folders, files in os.walk("/"):
    folders[:] = [f for f in folders if os.path.join(folder, f) not in ("/proc", "/sys")]
    if os.access(folder, os.W_OK):
        name = os.path.join(folder, ".probe")
        try:
            writes(name)
            writable.append(folder)
        except OSError:
            pass
print("PROBED", json.dumps({"found": found, "writable": sorted(writable)}))
"""
OPEN = "/etc/rover-open"  # anybody may write there, outside of the sandbox
# Its state, its runtime folder (which model it has loaded), and its own /tmp, which nobody else sees and which ends
# with it.
ALLOWED = (STATE, "/run/rover-drive", "/tmp", "/var/tmp")


def sandbox(pi: Container) -> dict[str, Any]:
    """Probes from within the service's own unit, with nothing but another program to start, and the same outside.

    What is refused must be what the sandbox refuses: so each probe has to work for the same user outside of it.
    """
    (pi.root / PROBE.lstrip("/")).write_text(PROBES)
    homes = ["/home/pi", "/root"]
    open_folder = pi.root / OPEN.lstrip("/")
    open_folder.mkdir(exist_ok=True)
    open_folder.chmod(0o777)
    before = {home: (pi.root / home.lstrip("/")).stat().st_mode & 0o7777 for home in homes}
    given = json.dumps({"write": [f"{STATE}/probe", f"{OPEN}/probe"], "read": homes, "port": pi.port})
    argv = f"{VENV}/bin/python {PROBE} {shlex.quote(given)}"
    try:
        for home in homes:
            (pi.root / home.lstrip("/")).chmod(0o755)
        installed = (pi.root / "etc/systemd/system" / UNIT).read_text()
        inside = _probe(pi, "rover-probe.service", unit_for(installed, argv))
        plain = ["[Service]", "Type=oneshot", "User=rover", "StateDirectory=rover-drive", f"ExecStart={escaped(argv)}"]
        outside = _probe(pi, "rover-probe-outside.service", "\n".join(plain) + "\n")
    finally:
        for home, mode in before.items():
            (pi.root / home.lstrip("/")).chmod(mode)
        (pi.root / PROBE.lstrip("/")).unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            open_folder.rmdir()
    told = pi.inside("systemd-analyze", "security", "--no-pager", UNIT, check=False).stdout.decode()
    exposure = re.search(r"Overall exposure level for \S+: ([\d.]+)", told)
    wanted = f"write {STATE}/probe"
    probes = [
        {"probe": n, "refused": n != wanted, "inside": inside["found"][n], "outside": outside["found"][n]}
        for n in inside["found"]
    ]
    if inside["found"][wanted]:
        raise EmulationError(f"the service cannot write to its own {STATE}: {inside['found'][wanted]}")
    beyond = [f for f in inside["writable"] if f not in ALLOWED and not f.startswith(tuple(f"{a}/" for a in ALLOWED))]
    probes.append({"probe": "write anywhere else", "refused": True, "inside": "refused" if not beyond else "",
                   "outside": ""})  # fmt: skip
    return {
        "exposure": float(exposure[1]) if exposure else None,
        "probes": probes,
        "writable": inside["writable"],
        "writable_outside": outside["writable"],
        "beyond": beyond,
    }


def unit_for(text: str, argv: str) -> str:
    """The drive service's unit with another program, that is started once and has nobody to tell."""
    drop = ("ExecStart", "ExecStartPre", "NotifyAccess", "WatchdogSec", "WatchdogSignal", "Restart", "RestartSec",
            "ConditionPathExists", "StartLimitIntervalSec", "StartLimitBurst", "Type", "WantedBy")  # fmt: skip
    lines = [line for line in text.splitlines() if line.partition("=")[0] not in drop]
    at = lines.index("[Service]") + 1
    return "\n".join([*lines[:at], "Type=oneshot", f"ExecStart={escaped(argv)}", *lines[at:]]) + "\n"


def escaped(argv: str) -> str:
    """A command for a unit: % and $ mean themselves."""
    return argv.replace("%", "%%").replace("$", "$$")


def _probe(pi: Container, name: str, unit: str) -> dict[str, Any]:
    (pi.root / "etc/systemd/system" / name).write_text(unit)
    try:
        pi.inside("systemctl", "daemon-reload")
        started = pi.inside("systemctl", "start", name, check=False)
        said = pi.inside("journalctl", f"--unit={name}", "--output=cat", "--no-pager").stdout.decode()
        found = [line for line in said.splitlines() if line.startswith("PROBED ")]
        if not found:
            raise EmulationError(f"{name} could not look: {started.stderr.decode()} {said[-800:]}")
        return json.loads(found[-1].removeprefix("PROBED "))
    finally:
        (pi.root / "etc/systemd/system" / name).unlink()


def hang(pi: Container, pins: Pins) -> dict[str, Any]:
    """The loop's process hangs while it drives: SIGSTOP.

    stopped_s: until the throttle pulses of the Arduino were neutral. killed_s: until systemd's watchdog had killed it.
    restarted_s: until systemd started it again. running_s: until its program ran, after ExecStartPre=, which takes
    milliseconds on a Pi. ready_s: until it could drive, most of it torch under emulation.
    disarmed: nobody armed it again, and no pulse moved the car since.
    """
    pi.inside("systemctl", "reset-failed", UNIT, check=False)
    pi.inside("systemctl", "start", UNIT)
    asked_s = time.monotonic()
    pi.inside(f"{VENV}/bin/rover", "arm-car", "--yes")
    if not wait_for(lambda: moving(pins, asked_s), 30):
        raise EmulationError(f"the car does not drive, its service says: {show(pi, 'StatusText')['StatusText']}")
    pid = int(show(pi, "MainPID")["MainPID"])
    here = pi.pid_of(pid)
    at_s = time.monotonic()
    os.kill(here, signal.SIGSTOP)
    while _lives(here):
        if time.monotonic() > at_s + 20:
            raise EmulationError("a hung loop was not killed within 20 s")
        time.sleep(0.002)
    killed_s = time.monotonic()
    ready = wait_for(lambda: show(pi, "StatusText", "ActiveState")["StatusText"].startswith("disarmed"), READY_S)
    ready_s = time.monotonic()
    told = show(pi, "InactiveExitTimestampMonotonic", "ExecMainStartTimestampMonotonic", "NRestarts")
    time.sleep(1)
    moved = moving(pins, at_s)
    pi.inside("systemctl", "stop", UNIT)
    return {
        "stopped_s": round(stopped_s(pins, at_s) - at_s, 3),
        "killed_s": round(killed_s - at_s, 2),
        "restarted_s": round(int(told["InactiveExitTimestampMonotonic"]) / 1e6 - at_s, 2),
        "running_s": round(int(told["ExecMainStartTimestampMonotonic"]) / 1e6 - at_s, 2),
        "ready_s": round(ready_s - at_s, 1),
        "restarts": int(told["NRestarts"]),
        "disarmed": ready and not [t for t in moved if t > at_s + 1],
    }


def stopped_s(pins: Pins, since_s: float) -> float:
    """When the throttle's pulses became neutral for good, monotonic seconds; infinite if they did not."""
    throttle = [e for e in pins.since(0) if e.pin == "throttle" and e.kind == "pulse"]
    if not throttle or throttle[-1].pulse_us > STOPPED_THROTTLE_US:
        return float("inf")
    last = max((i for i, e in enumerate(throttle) if e.pulse_us > STOPPED_THROTTLE_US), default=-1)
    return max(since_s, throttle[last + 1].monotonic_s)


def start_limit(pi: Container, pins: Pins) -> dict[str, Any]:
    """The camera is gone: tries until systemd leaves it, and what it is then, and ten seconds later."""
    pi.inside("systemctl", "reset-failed", UNIT, check=False)
    camera, away = pi.bench / "camera", pi.bench / "unplugged"
    camera.rename(away)
    try:
        at_s = time.monotonic()
        pi.inside("systemctl", "start", "--no-block", UNIT)
        ended = wait_for(lambda: show(pi, "ActiveState", "SubState")["ActiveState"] == "failed", 180)
        took_s = time.monotonic() - at_s
        time.sleep(10)
        told = show(pi, "ActiveState", "NRestarts", "Result", "StatusText")
    finally:
        away.rename(camera)
    cursor = pi.inside("journalctl", f"--unit={UNIT}", "--output=cat", "--no-pager", f"--since=-{took_s + 15:.0f}s")
    said = cursor.stdout.decode()
    pi.inside("systemctl", "reset-failed", UNIT, check=False)
    return {
        "tries": len(re.findall(rf"^Starting {re.escape(UNIT)}", said, re.M)),
        "ended": ended,
        "seconds": round(took_s, 1),
        "state": told["ActiveState"],
        "result": told["Result"],
        "said": next((line for line in said.splitlines() if line.startswith("rover: ")), ""),
    }


def show(pi: Container, *names: str) -> dict[str, str]:
    """What systemd says of the service."""
    told = pi.inside("systemctl", "show", f"--property={','.join(names)}", UNIT).stdout.decode()
    found = dict(line.partition("=")[::2] for line in told.splitlines())
    return {name: found.get(name, "") for name in names}


def wait_for(condition: Callable[[], Any], within_s: float) -> bool:
    """Whether it came true in time."""
    end = time.monotonic() + within_s
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.2)
    return False


def _lives(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False

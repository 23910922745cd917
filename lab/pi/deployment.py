"""Deploy to an emulated Pi, as a newcomer would, and drive: python -m lab pi.

From a flashed card: provision, and again, which changes nothing; deploy; a damaged artifact is refused, and the model
in use stays; benchmark, and fetch it; deploy another model, and drive by it; roll back. The Pi is a container, its
Arduino the real firmware in simavr, its camera a FIFO of JPEGs. A policy with a constant plan drives, at HZ.

runs/pi.json is a stage "pi". Its metrics are steps: [{step, seconds, ok}], gates: [{gate, wanted, found, holds}] and
wrong, a sentence for everything that is not as it should be. pi.log has all that the playbooks printed.
"""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from balloon_world.car import CameraFeed
from balloon_world.simulated_arduino import REST_US
from lab.arduino.emulator import NICE, REPOSITORY, EmulatedArduino
from lab.driving.pins import most_throttle_us
from lab.driving.policy import make_artifact, pictures
from lab.pi.container import CAMERA, PORT, Container
from lab.pi.debian_image import USER, debian_image
from lab.pi.emulation import emulation, require
from rover_lib.onboard.artifact.manifest import content_hash
from rover_lib.onboard.drive.flight_log import read_log
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.signal_event import signals
from rover_lib.onboard.stage import sha256_of, write_stage

MOST_S = 3600.0
NO_KNOWN_HOSTS = "-o UserKnownHostsFile=/dev/null -o StrictHostKeyChecking=no -o LogLevel=ERROR"
ROVER = "rover1"
ARTIFACT = "policy_static.pt"  # of a run
HZ = 10  # the service's rate, which the emulator manages on a busy machine; a real Pi drives at 30. Its camera is twice
# as fast: no picture for 0.14 s ends a drive.
READY_S = 600  # how long the service may take until it can drive, with emulated torch on a busy machine
DRIVE_S = 10
LEAST_TICKS = 10  # with the policy driving


def deploy_and_drive(output: Path, demo: Path, say: Callable[[str], None] = lambda text: None) -> list[str]:
    """Do all steps, write the report whatever fails, and return `wrong`. Raises RoverError if it cannot begin.

    demo: a run's folder with ARTIFACT.
    """
    artifact = demo.absolute() / ARTIFACT
    if not artifact.is_file():
        raise RoverError(f"{artifact}: not found", remedy="make demo makes it")
    require()
    output.parent.mkdir(parents=True, exist_ok=True)
    with (
        signals(signal.default_int_handler),  # whatever ends it, all is cleaned up as after ^C
        emulation(),
        tempfile.TemporaryDirectory(prefix="rover-plays-") as folder,  # ssh's sockets want a short path
        output.with_suffix(".log").open("w") as log,
    ):
        deployment = Deployment(output, {artifact.name: sha256_of(artifact)}, say, Path(folder), log)
        try:
            with deployment.step("make the system"):
                debian_image()
            with (
                Container(ROVER) as pi,
                CameraFeed(pi.bench / "camera", *pictures((180, 320)), rate_hz=2 * HZ),
                EmulatedArduino(every_pulse=False, transmitter=REST_US, ready=True, nice=NICE) as board,
            ):
                (pi.bench / "camera").chmod(0o666)
                pi.plug(board.port)
                deployment.run(pi, board, artifact)
        except RoverError as error:
            deployment.wrong.append(str(error))
        deployment.write()
    return deployment.wrong


class Deployment:
    """The steps, and what they found. The report is written after each step.

    say: called with a line for each step and gate. folder: for what comes and goes. log: takes what playbooks print.
    """

    def __init__(self, path: Path, inputs: dict[str, str], say: Callable[[str], None], folder: Path, log: TextIO):
        self.path, self.inputs, self.say, self.folder, self.log = path, inputs, say, folder, log
        self.steps: list[dict[str, Any]] = []
        self.gates: list[dict[str, Any]] = []
        self.wrong: list[str] = []
        self.variables: dict[str, Any] = {f"rover_{name}": str(folder / name) for name in ("wheels", "fetched")}
        self.variables |= {"rover_camera": CAMERA, "rover_port": PORT}
        self.variables |= {"rover_hz": HZ, "rover_ready_s": READY_S}

    def gate(self, name: str, wanted: str, found: Any, holds: bool) -> None:
        """Add a gate, and a sentence to `wrong` if it does not hold."""
        self.gates.append({"gate": name, "wanted": wanted, "found": found, "holds": holds})
        self.say(f"{'ok  ' if holds else 'FAIL'}       {name}: {wanted}")
        if not holds:
            self.wrong.append(f"{name}: wanted {wanted}, found {found}")

    @contextlib.contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Time a step, which is in the report whether it works or not."""
        begun, row = time.monotonic(), {"step": name, "ok": False}
        self.steps.append(row)
        self.say(f"{name} ...")
        try:
            yield
            row["ok"] = True
        finally:
            row["seconds"] = round(time.monotonic() - begun, 1)
            self.say(f"{row['seconds']:7.1f} s  {name}{'' if row['ok'] else ': failed'}")
            self.write()

    def write(self) -> None:
        metrics = {"steps": self.steps, "gates": self.gates, "wrong": self.wrong}
        write_stage(self.path, "pi", params={}, metrics=metrics, inputs=self.inputs)

    def run(self, pi: Container, board: EmulatedArduino, artifact: Path) -> None:
        """Do the steps that need the Pi. Raises RoverError if one fails that the next ones need."""
        self.pi, self.board, name = pi, board, content_hash(artifact)
        with self.step("boot"):
            pi.boot()
        with _compile_here(pi.root):
            self.play("provision")
        again = self.play("provision", "provision again")
        self.gate("provision again", "changed=0", again.changed, again.changed == 0)
        self.deploy("deploy", artifact)
        self.refuse(artifact)
        self.expect("after a damaged artifact", name)
        self.play("benchmark", rover_iterations=3)
        benchmark = self.folder / "fetched" / f"benchmark-{ROVER}.json"
        self.gate("benchmark", "fetched", benchmark.name, benchmark.is_file())
        constant = self.folder / "policy_constant.pt"
        make_artifact(constant, camera="cam_front", size=(72, 128))
        self.deploy("deploy another", constant)
        self.drive()
        self.play("rollback")
        self.expect("rollback", name)

    def play(self, book: str, step: str = "", works: bool = True, **variables: Any) -> "Play":
        """Run a playbook. works: whether it has to; raises RoverError with the end of its output if it fails."""
        with self.step(step or book):
            play = run_playbook(book, self.pi, self.folder, {**self.variables, **variables})
            self.log.write(f"===== {step or book}\n{play.output}\n")
            if works and not play.ok:
                raise RoverError(f"{book}.yml failed, its output ends: {play.end}")
        return play

    def expect(self, what: str, name: str) -> None:
        """Add a gate: whether the model in use is the one of that name."""
        current = (self.pi.root / "var/lib/rover/models/current").readlink().name
        self.gate(what, f"model {name[:12]} in use", current[:12], current == name)

    def deploy(self, step: str, artifact: Path) -> None:
        self.play("deploy", step, rover_artifact=str(artifact), rover_allow=["mode"])
        self.expect(step, content_hash(artifact))

    def refuse(self, artifact: Path) -> None:
        """Deploy an artifact with one wrong byte, which must be refused."""
        content = bytearray(artifact.read_bytes())
        content[len(content) // 2] ^= 1
        damaged = self.folder / "damaged.pt"
        damaged.write_bytes(content)
        play = self.play("deploy", "deploy a damaged artifact", works=False, rover_artifact=str(damaged))
        refused = not play.ok and f"{ROVER}: failed: " in play.output and "damaged" in play.output
        self.gate("a damaged artifact", "refused", play.end[-300:], refused)

    def drive(self) -> None:
        """Drive armed: by the flight log, and on the Arduino's throttle pin, which must move the car and then not."""
        self.board.pulses()  # drop what was before
        self.play("drive", rover_arm=True, rover_seconds=DRIVE_S)
        log = next(iter((self.folder / "fetched" / ROVER).rglob("flight.log")), None)
        ticks = sum(state == "A" for state in read_log(log).ticks["state"]) if log else 0
        self.gate("ticks driven", f"at least {LEAST_TICKS}", ticks, ticks >= LEAST_TICKS)
        throttle_us = [e.pulse_us for e in self.board.pulses() if e.kind == "pulse" and e.pin == "throttle"]
        most_us = most_throttle_us()
        is_moved = max(throttle_us, default=0.0) > most_us >= (throttle_us or [most_us + 1])[-1]
        self.gate("throttle's pulses", "moved the car, and stopped it", throttle_us[-1:], is_moved)


@contextlib.contextmanager
def _compile_here(root: Path) -> Iterator[None]:
    """Let this machine's Python compile what pip installs, if it has the Pi's version: emulated, that takes minutes."""
    if not (root / f"usr/lib/python{sys.version_info[0]}.{sys.version_info[1]}").is_dir():
        yield
        return
    with (root / "etc/pip.conf").open("a") as settings:
        settings.write("[install]\nno-compile = no\n")  # a double negation: pip wants "no" for such an option
    yield
    # In another process, because this one has threads. A file that cannot be compiled is ignored, as by pip.
    venv = f"{root}/opt/rover/venv"
    command = [sys.executable, "-m", "compileall", "-q", "-j", "0", "-s", str(root), "-p", "/", venv]
    subprocess.run(command, capture_output=True)


@dataclass(frozen=True)
class Play:
    """What a playbook did."""

    code: int
    output: str

    @property
    def ok(self) -> bool:
        """Whether nothing failed and the rover was reached."""
        return self.code == 0 and self.changed >= 0

    @property
    def changed(self) -> int:
        """How many tasks changed something, by Ansible's last lines; -1 if it did not get that far."""
        counts = re.findall(r" : ok=\d+ +changed=(\d+) ", self.output.partition("PLAY RECAP")[2])
        return sum(map(int, counts)) if counts else -1

    @property
    def end(self) -> str:
        """The end of its output before the recap: the failed task, if one failed."""
        return self.output.partition("PLAY RECAP")[0].strip()[-3000:]


def run_playbook(book: str, pi: Container, folder: Path, variables: Mapping[str, Any]) -> Play:
    """Run ansible/<book>.yml on a rover, with variables. A play that fails raises nothing.

    folder: for the inventory and Ansible's own files. Raises RoverError if the play takes longer than MOST_S.
    """
    program = Path(sys.executable).with_name("ansible-playbook")
    (folder / "inventory.ini").write_text(inventory(pi))
    extra = {"rover_command": str(program.with_name("rover")), **variables}
    command = [program, "-i", folder / "inventory.ini", REPOSITORY / "ansible" / f"{book}.yml", "-e", json.dumps(extra)]
    try:
        options: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        options |= {"cwd": REPOSITORY, "env": _environment(folder), "errors": "replace", "timeout": MOST_S}
        done = subprocess.run([str(word) for word in command], text=True, **options)
    except subprocess.TimeoutExpired:
        raise RoverError(f"{book}.yml took more than {MOST_S:g} s") from None
    return Play(done.returncode, done.stdout)


def inventory(pi: Container) -> str:
    """Return the repository's inventory.ini with this rover instead of its own."""
    text = (REPOSITORY / "inventory.ini").read_text()
    address = f"ansible_host=127.0.0.1 ansible_port={pi.port} ansible_ssh_private_key_file={pi.key}"
    text = re.sub("(?m)^rover1 .*", f"{pi.name} {address}", text)
    return f"{text}\nansible_user={USER}\nansible_ssh_extra_args={NO_KNOWN_HOSTS}\n"


def _environment(folder: Path) -> dict[str, str]:
    """Return Ansible's environment: without the user's own settings for it, and with its files in the folder."""
    inherited = {key: value for key, value in os.environ.items() if not key.startswith("ANSIBLE")}
    own = {"ANSIBLE_HOME": str(folder), "ANSIBLE_NOCOLOR": "1", "ANSIBLE_LOCAL_TEMP": str(folder / "local")}
    own["PWD"] = str(REPOSITORY)  # below which the playbooks put wheels and logs
    own["ANSIBLE_TIMEOUT"] = "120"  # sudo, emulated on a busy machine, took more than the usual 10 s
    return {**inherited, **own, "PATH": f"{Path(sys.executable).parent}:{os.environ.get('PATH', '')}"}

"""docs/tonight.md: each of its lines, in its order, from a new Arduino without a car.yml to the first drive.

The car is an ordinary one, the Arduino runs the real firmware in simavr, and a script is the human. Episodes, training
and run are shorter than on the page. Of playbooks only the syntax is checked, and `rover drive` does what the last one
lets a rover do: `python -m lab pi` plays them on an emulated Pi.
"""

import math
import re
import shlex
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from click.testing import CliRunner

from balloon_world.car import CameraFeed
from lab.arduino.emulator import EmulatedArduino
from lab.driving.policy import pictures
from rover_lib.cli import main as rover
from rover_lib.onboard import cli
from rover_lib.onboard.car import car as car_module
from rover_lib.onboard.car.car import read_car
from rover_lib.onboard.recording import recorder
from rover_lib.workshop.run import run as runs
from tests.helpers import needs
from tests.helpers.executed import run_cells

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "tonight.md").read_text()
CRAWLER = read_car(ROOT / "lab" / "cars" / "crawler.yml")
OFF, REST = (0, 0), (1504, 1496)
STICKS = {"to the left": (1996, 1496), "to the right": (1012, 1496), "forward": (1504, 1990), "back": (1504, 1004)}
SHORTER = {
    "record": "--episodes 4 --max-seconds 2",
    "train": "--steps 8",
    "run": "-p samples 6 -p choosing_frames 2 -p held_out_frames 4 -p worlds 0 -p iterations 2 -p modes '[static]'",
}


def lines() -> Iterator[tuple[str, str]]:
    """Yield the machine, W or P, and the text of each line of code."""
    machine = ""
    for heading, line in re.findall(r"^(?:## (.*)|    (\S.*))$", PAGE, re.M):
        machine = next(iter(re.findall(r"· ([WP]):", heading)), machine)
        if line:
            yield machine, line


def execute(source: Path, folder: Path, given: dict, bars: bool) -> None:
    """Run a notebook's cells in this process."""
    run_cells(source.stem, folder, **given)
    shutil.copy(source, folder)


class Evening:
    """A human who types on the laptop, W, and on the Pi, P, and who has a transmitter."""

    def __init__(self, folder: Path, board: EmulatedArduino, patch: pytest.MonkeyPatch):
        self.machines, self.board, self.patch = {"W": folder / "laptop", "P": folder / "pi"}, board, patch
        self.camera, self.typed, self.deployed = folder / "camera", list[str](), ""
        for machine in self.machines.values():
            machine.mkdir()
        self.installed = self.machines["P"] / "etc" / "rover" / "car.yml"
        patch.setattr(car_module, "PLACES", (self.machines["W"] / "car.yml", self.installed))
        patch.setattr(cli, "ask", self.do)
        patch.setattr(recorder, "PAUSE_S", 0.1)
        patch.setattr(runs, "_execute", execute)

    def do(self, asked: str) -> None:
        """Do with the transmitter what a command asks for."""
        sticks = next((us for words, us in STICKS.items() if words in asked), REST)
        self.board.transmitter(*(OFF if "transmitter off" in asked else sticks))
        if "both sides" in asked:
            self.board.wiggle()
        threading.Event().wait(0.2)

    def drive(self, ended: threading.Event) -> None:
        """Drive about by the sticks."""
        for tick in range(10_000):
            if ended.wait(0.05):
                return self.board.transmitter(*REST)
            self.board.transmitter(1504 + 300 * math.sin(tick / 9), 1560 + 20 * math.sin(tick / 5))

    def type(self, machine: str, line: str) -> None:
        self.patch.chdir(self.machines[machine])
        words = shlex.split(line, comments=True)
        if words[0] == "scp":
            source = Path(words[-2].partition(":")[2])
            copy = shutil.copytree if "-r" in words else shutil.copy
            copy(self.machines["P"] / str(source).lstrip("/"), Path(words[-1], source.name))
        elif words[0] == "ansible-playbook":
            given = dict(word.split("=") for word in words if "=" in word)
            self.deployed = given.get("rover_artifact", self.deployed)
            command = [Path(sys.executable).parent / words[0], *words[1:], "--syntax-check"]
            subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
            if "ansible/drive.yml" in words:
                self.drive_by_policy(given["rover_seconds"])
        elif words[0] == "make" and "run" in words:
            command = ["make", "-ns", f"VENV={sys.prefix}", f"--old-file={sys.prefix}/.ready", *words[1:]]
            said = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
            self.rover(shlex.split(said.splitlines()[-1])[1:])
        elif words[:2] == ["make", "-C"]:
            subprocess.run([*words, f"BUILD={Path.cwd()}/firmware"], cwd=ROOT, check=True, capture_output=True)
        elif "rover" in words:
            self.rover(words[words.index("rover") + 1 :])
        else:
            assert words[:2] == ["make", "demo"] or words[0] in (".", "ssh"), line

    def rover(self, words: list[str]) -> None:
        name, *arguments = words
        if Path.cwd() == self.machines["P"]:
            known = {option for parameter in rover.commands[name].params for option in parameter.opts}
            devices = {"--port": self.board.port, "--camera": str(self.camera)}
            arguments += [word for option, at in devices.items() if option in known for word in (option, at)]
        ended = threading.Event()
        if name == "record":
            threading.Thread(target=self.drive, args=(ended,), daemon=True).start()
        done = CliRunner().invoke(rover, [name, *arguments, *shlex.split(SHORTER.get(name, ""))])
        ended.set()
        self.typed.append(name)
        assert done.exit_code == 0, done.output

    def drive_by_policy(self, seconds: str) -> None:
        """Do what the rover's service does once it is armed: wiggle, see it drive, and take over."""
        log = Path("runs/rovers/rover1/flight.log")
        log.parent.mkdir(parents=True, exist_ok=True)
        options = ["--max-seconds", seconds, "--port", self.board.port, "--camera", self.camera, "--log", log]
        command = [Path(sys.executable).parent / "rover", "drive", self.deployed, *options]
        self.board.ready(True)
        self.board.pulses()  # those of the human who recorded
        self.patch.setenv(car_module.FILE_VARIABLE, str(self.installed))
        with subprocess.Popen([*map(str, command)], stderr=subprocess.PIPE, text=True) as process:
            armed = any("rover: armed" in line for line in process.stderr)
            needs.until(lambda: any(e.pin == "throttle" and e.pulse_us > 1520 for e in self.board.pulses()))
            self.board.transmitter(*STICKS["to the right"])
            _, said = process.communicate(timeout=20)
        assert armed and process.returncode == 4, said


@pytest.mark.release
@needs.simavr
def test_the_page_leads_to_a_first_drive(demo_run, tmp_path, monkeypatch):
    monkeypatch.delenv(car_module.FILE_VARIABLE, raising=False)
    with EmulatedArduino(every_pulse=False, car=CRAWLER) as board:
        evening = Evening(tmp_path, board, monkeypatch)
        with CameraFeed(evening.camera, *pictures((180, 320))):
            for machine, line in lines():
                evening.type(machine, line)
    assert evening.typed == ["calibrate", "doctor", "doctor", "record", "train", "run", "log"]
    measured = read_car(evening.installed)
    assert measured.name == "mycar" and measured.numbers == pytest.approx(CRAWLER.numbers, abs=30)

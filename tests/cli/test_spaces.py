"""What the pages show, typed with a space in each name; test_outside_a_clone.py types the long commands so."""

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from rover_lib.onboard.drive.flight_log import FlightLog, Tick
from rover_lib.workshop.run import run_report
from tests.helpers.command import rover

ROOT = Path(__file__).parents[2]
PAGES = [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), ROOT / "ansible" / "README.md"]
OF_A_CAR = {"arm-car", "calibrate", "doctor", "drive", "record"}  # tests/test_tonight.py types what it takes
TYPED = [
    "rover inspect 'my runs/mine'",
    "rover inspect 'my runs'",
    "rover report 'my runs/mine'",
    "rover export 'my runs/mine' --card --license apache-2.0",
    "rover benchmark --warmup 0 --iterations 1 --output 'my times.json' 'my policy_static.pt'",
    "rover log 'my flight.log' -o 'my figure.png'",
    "rover release --models 'my models' stage 'my policy_static.pt' --allow aspect",
    "rover record 'my drives' --finish",
    "rover playbook",
]


@pytest.fixture
def here(tmp_path, monkeypatch, artifacts):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        "rover_lib.onboard.care.benchmark.peak_memory_alone_mb", lambda path, threads: None
    )  # for speed
    shutil.copytree(ROOT / "results" / "demo", "my runs/mine")
    run_report.write("my runs/mine")
    shutil.copy(artifacts["static"], "my policy_static.pt")
    (tmp_path / "my drives").mkdir()
    with FlightLog(
        "my flight.log", header={"hz": 30, "fade_s": 0.5, "stop_s": 1.0}, max_bytes=1_000_000, keep=1
    ) as log:
        for i in range(30):
            log.tick(Tick(i / 30, 0.1, "A", "a", 0.1, 0.05, 1500, 150, 1500, 150, 1, 50.0, 40.0, 1.0, i))
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("line", TYPED)
def test_a_space_in_each_name(here, line):
    result = rover(*shlex.split(line)[1:])
    assert result.exit_code == 0, result.output


def test_make_hands_a_name_on_as_it_is():
    dry = ["make", "-n", "--no-print-directory", f"VENV={sys.prefix}", f"--old-file={sys.prefix}/.ready"]
    names = {
        "run": ["CHECKPOINT=my policy.pth", "EPISODES=my drives", "NAME=mine"],
        "notebooks-open": ["NAME=mine", "AS=try 1"],
    }
    found = []
    for target, given in names.items():
        done = subprocess.run([*dry, target, *given], cwd=ROOT, capture_output=True, text=True, check=True)
        found.append(shlex.split(done.stdout.splitlines()[-1])[1:])
    assert found == [
        ["run", "my policy.pth", "my drives", "--name", "mine"],
        ["notebooks", "runs/mine", "--as", "try 1"],
    ]


def test_every_command_of_a_page_is_typed_so():
    """A page that shows another command needs it here, or in test_outside_a_clone.py."""
    from rover_lib.cli import main

    typed = " ".join(TYPED) + Path(__file__).with_name("test_outside_a_clone.py").read_text()
    lines = [line for page in PAGES for line in re.findall(r"^    (\S.*)$", page.read_text(), re.M)]
    shown = {
        name for line in lines for name in re.findall(r"(?:^|/|; | )rover ([a-z-]+)", line) if name in main.commands
    }
    assert shown - OF_A_CAR <= set(re.findall(r"rover ([a-z-]+)", typed)) and len(shown) > 12

"""Files of strangers, in the place of ours: a sentence at once, never a wait or a full memory."""

import os
import resource
import signal
from pathlib import Path

import pytest
import torch

from rover_exchange.tub import read_tub
from rover_lib.onboard.car.car import Car, read_car
from rover_lib.onboard.drive.flight_log import read_log
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.stage import read_stage
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint
from rover_lib.workshop.int8.observe import Calibration
from rover_lib.workshop.recordings.episodes import load_recordings

MOST_S, MOST_BYTES = 10, 500_000_000
READERS = {
    "run.json": lambda path: read_stage(path, "run"),
    "car.yml": read_car,
    "flight.log": read_log,
    "episode_data.json": lambda path: load_recordings(path.parent, 8),
    "best_model.pth": load_checkpoint,
    "calibration.pt": Calibration.load,
    "manifest.json": lambda path: read_tub(path.parent, Car()),
}


def without_end(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(1 << 40)


THINGS = {"a pipe": os.mkfifo, "a device": lambda path: path.symlink_to("/dev/zero"), "a terabyte": without_end}


def outcome_of(read, path: Path) -> str:
    """What a reader says of a file, read in a child: its sentence, or what it did instead."""
    out, into = os.pipe()
    if not (child := os.fork()):
        said = "nothing"
        try:
            signal.alarm(MOST_S)
            torch.set_num_threads(1)  # a fork has none of the threads that OpenMP began before, and would wait
            now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (now + MOST_BYTES,) * 2)
            said = f"returned {str(read(path))[:100]}"
        except RoverError as error:
            said = f"said {error}"
        except BaseException as error:
            said = f"raised {type(error).__name__}"
        finally:
            os.write(into, said.encode()[:4000])
            os._exit(0)
    os.close(into)
    with os.fdopen(out) as file:
        said = file.read()
    os.waitpid(child, 0)
    return said or f"went on for {MOST_S} s"


@pytest.mark.parametrize("name", READERS)
def test_a_sentence_at_once(tmp_path, name):
    for thing, make in THINGS.items():
        path = tmp_path / thing / name
        path.parent.mkdir(parents=True)
        make(path)
        said = outcome_of(READERS[name], path)
        assert said.startswith("said "), f"{thing} as {name}: {said}"


def test_a_car_that_refers_to_itself_many_times(tmp_path):
    lines = ["a0: &a0 [x, x]", *(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 12))]
    (tmp_path / "car.yml").write_text("\n".join([*lines, "steering: *a11"]))
    assert outcome_of(read_car, tmp_path / "car.yml").startswith("said ")

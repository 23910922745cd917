"""Files of strangers, in the place of ours: a sentence at once, never a wait or a full memory."""

import os
import resource
import signal
import struct
from pathlib import Path

import pytest
import torch

from rover_exchange.moments import pictures_of
from rover_exchange.tub import read_tub
from rover_lib.onboard.car.car import Car, read_car
from rover_lib.onboard.drive.flight_log import read_log
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.params import read_params
from rover_lib.onboard.recording.episode import find_killed, finish_killed
from rover_lib.onboard.recording.outcome import relabel
from rover_lib.onboard.stage import read_stage
from rover_lib.onboard.view.server import read_token
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint
from rover_lib.workshop.int8.observe import Calibration
from rover_lib.workshop.recordings.episodes import load_recordings

MOST_S, MOST_BYTES = 10, 500_000_000


def finish(path):
    for part in find_killed(path.parents[1]):
        finish_killed(part)


READERS = {
    "run.json": lambda path: read_stage(path, "run"),
    "params.yml": read_params,
    "car.yml": read_car,
    "view.token": read_token,
    "flight.log": read_log,
    "frame_data.csv": lambda path: pictures_of(path.parent),
    "control_data.csv": lambda path: load_recordings(path.parent, 8),
    "episode_data.json": lambda path: relabel(path.parent, "hit"),
    ".episode_1.part/control.rows": finish,
    "best_model.pth": load_checkpoint,
    "config.json": lambda path: load_checkpoint(path.parent),
    "model.safetensors": lambda path: (path.with_name("config.json").write_text("{}"), load_checkpoint(path.parent)),
    "calibration.pt": Calibration.load,
    "manifest.json": lambda path: read_tub(path.parent, Car()),
}


def without_end(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(1 << 40)


THINGS = {
    "a pipe": os.mkfifo,
    "a device": lambda path: path.symlink_to("/dev/zero"),
    "a terabyte of nothing": without_end,
    "a folder": Path.mkdir,
}


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
    wrong = []
    for thing, make in THINGS.items():
        path = tmp_path / thing / name
        path.parent.mkdir(parents=True)
        make(path)
        said = outcome_of(READERS[name], path)
        if not said.startswith("said ") and not (name.endswith(".rows") and said.startswith("returned ")):
            wrong.append(f"{thing} as {name}: {said}")
    assert not wrong, "\n".join(wrong)


def test_a_car_that_refers_to_itself_again_and_again(tmp_path):
    lines = ["a0: &a0 [x, x]", *(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 12))]
    (tmp_path / "car.yml").write_text("\n".join([*lines, "steering: *a11"]))
    assert outcome_of(read_car, tmp_path / "car.yml").startswith("said ")


def test_a_tub_that_names_a_catalog_again_and_again(tmp_path):
    (tmp_path / "catalog_0.catalog").write_text("{}\n" * 100_000)
    (tmp_path / "manifest.json").write_text('{"paths": [' + ", ".join(['"catalog_0.catalog"'] * 10_000) + "]}")
    assert outcome_of(lambda tub: read_tub(tub, Car()), tmp_path).startswith("said ")


def test_a_checkpoint_whose_directory_is_as_large_as_the_file(tmp_path):
    size = 3 << 30
    with (tmp_path / "best_model.pth").open("wb") as file:
        file.write(b"PK\x03\x04")
        file.seek(size)
        file.write(struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, 1, 1, size, 0, 0))
    assert outcome_of(load_checkpoint, tmp_path / "best_model.pth").startswith("said ")

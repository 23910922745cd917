"""Wrong commands: each ends in one sentence that names the thing and what to do, and never in exit code 0."""

import json
import zipfile

import pytest
from click.testing import CliRunner

from rover_lib.cli import main


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with one of everything, by its looks."""
    monkeypatch.chdir(tmp_path)
    for name, entry in {"policy_static.pt": "archive/code/net.py", "damaged.zip": "a/b"}.items():
        with zipfile.ZipFile(name, "w") as z:
            z.writestr(entry, "")
    for name, keys in {"best_model.pth": b"model_state_dict", "calibration.pt": b"samples smooth image_sizes"}.items():
        with zipfile.ZipFile(name, "w") as z:
            z.writestr("archive/data.pkl", keys)
    (tmp_path / "flight.log").write_text('{"schema":1,"kind":"header","columns":[]}\n')
    (tmp_path / "notes.txt").write_text("hello")
    for name in ("noise.bin", "model.safetensors", "x.mp4"):
        (tmp_path / name).write_bytes(b"\0\1\2hello")
    stage = {"schema": 1, "stage": "load", "params": {}, "metrics": {}, "inputs": {}, "env": {}}
    folders = (
        "episodes/episode_1/frames dataset/meta dataset/data/chunk-000 runs/mine pretrained_model old_policy empty"
    )
    for folder in folders.split():
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "episodes/episode_1/episode_data.json").write_text("{}")
    (tmp_path / "dataset/meta/info.json").write_text("{}")
    (tmp_path / "dataset/data/chunk-000/file-000.parquet").write_bytes(b"PAR1")
    for name in ("pretrained_model/config.json", "old_policy/config.json", "old_policy/policy_preprocessor.json"):
        (tmp_path / name).write_text("{}")
    (tmp_path / "runs/mine/load.json").write_text(json.dumps(stage))
    return tmp_path


# The command, the thing that its sentence names, and the remedy in it.
WRONG = [
    # wrong file
    ("run policy_static.pt episodes", "policy_static.pt: this is an artifact already", "deploy it"),
    ("quantize policy_static.pt episodes -o o.pt", "policy_static.pt: this is an artifact already", "deploy it"),
    ("distill policy_static.pt episodes --name a", "policy_static.pt: this is an artifact already", "deploy it"),
    ("run calibration.pt episodes", "calibration.pt: this is the calibration of a run", "best_model.pth"),
    ("run flight.log episodes", "flight.log: this is a flight log", "best_model.pth"),
    ("quantize notes.txt episodes -o o.pt", "notes.txt: this is a document", "that it describes"),
    ("run noise.bin episodes", "noise.bin: neither a trainer's checkpoint nor", "copy it again"),
    (
        "run pretrained_model/config.json episodes",
        "config.json: this is a part of a LeRobot",
        "folder, pretrained_model",
    ),
    ("inspect model.safetensors", "model.safetensors: this is a part of a LeRobot checkpoint", "give its folder, ."),
    (
        "run best_model.pth dataset/meta/info.json",
        "info.json: this is a part of a LeRobotD",
        "give its folder, dataset",
    ),
    (
        "inspect dataset/data/chunk-000/file-000.parquet",
        "this is a part of a LeRobotDataset",
        "give its folder, dataset",
    ),
    (
        "compare policy_static.pt x.mp4 --episodes episodes",
        "x.mp4: this is a part of a LeRobotDataset",
        "its folder, .",
    ),
    ("drive nothing.pt", "nothing.pt: not found", "rover run"),
    ("world trial nothing.pt", "nothing.pt", ";"),
    ("drive old_policy", "old_policy: this is a LeRobot checkpoint", "rover run CHECKPOINT EPISODES"),
    ("export old_policy", "old_policy: this is a LeRobot checkpoint", "such as runs/mine"),
    ("run best_model.pth old_policy", "old_policy: this is a LeRobot checkpoint", "the checkpoint comes first"),
    ("drive best_model.pth", "best_model.pth: this is a trainer's checkpoint", "rover run CHECKPOINT EPISODES"),
    ("drive pretrained_model", "pretrained_model: this is a LeRobot checkpoint", "rover run CHECKPOINT EPISODES"),
    ("doctor best_model.pth", "best_model.pth: this is a trainer's checkpoint", "rover run CHECKPOINT EPISODES"),
    ("benchmark calibration.pt", "calibration.pt: this is the calibration of a run", "policy_<mode>.pt"),
    ("world trial best_model.pth", "best_model.pth: this is a trainer's checkpoint", "rover run CHECKPOINT"),
    ("log policy_static.pt", "policy_static.pt: this is an artifact", "rover drive wrote"),
    ("log notes.txt", "notes.txt: this is a document", "that it describes"),
    ("release pack best_model.pth parts", "best_model.pth: this is a trainer's checkpoint", "rover run"),
    ("inspect damaged.zip", "damaged.zip", ";"),
    # wrong folder
    ("run runs/mine episodes", "runs/mine: this is a run's folder", "load.json names"),
    ("quantize empty episodes -o o.pt", "empty/config.json: not found", "model.safetensors"),
    ("benchmark runs/mine", "runs/mine: this is a run's folder", "policy_<mode>.pt"),
    ("export-dataset runs/mine out", "runs/mine: this is a run's folder", "load.json names"),
    ("export-dataset empty out", "empty: no episode folders in it", "episode_YYYYMMDD_HHMMSS"),
    ("inspect empty", "empty: no episode folders in it", "episode_YYYYMMDD_HHMMSS"),
    ("report episodes", "episodes: this is a folder of recordings", "rover run has made"),
    ("list nowhere", "nowhere: no such folder", "rover run"),
    ("log episodes", "episodes: this is a folder of recordings", "rover inspect"),
    # wrong order
    ("run episodes best_model.pth", "episodes: this is a folder of recordings", "rover run CHECKPOINT EPISODES"),
    ("quantize best_model.pth policy_static.pt -o o.pt", "policy_static.pt: this is an artifact", "episode_*"),
    ("compare best_model.pth policy_static.pt --episodes episodes", "best_model.pth: this is a", "rover run"),
    ("report runs/mine", "runs/mine: no verdict without", "rover run makes them"),
    ("world latency episodes", "episodes: this is a folder of recordings", "rover run has made"),
    (
        "world students runs/mine pretrained_model",
        "pretrained_model: this is a LeRobot checkpoint",
        "rover run has made",
    ),
    # no device
    ("drive policy_static.pt --dry-run --camera 99", "policy_static.pt: a record that no artifact has", "again"),
    ("record out --port ttyNONE --camera 99", "99", ";"),
    ("doctor --receiver --port ttyNONE", "ttyNONE", "is the Arduino plugged in"),
    # an output that would cost something else
    ("quantize best_model.pth episodes -o best_model.pth", "best_model.pth: this is a trainer's", "another name"),
    ("quantize best_model.pth episodes -o episodes", "episodes: this is a folder", "name the file in it"),
    ("quantize best_model.pth episodes -o notes.txt/a/o.pt", "notes.txt: this is a file", "name a file elsewhere"),
    ("quantize best_model.pth episodes -o /dev/null", "/dev/null: this is no ordinary file", "another name"),
    ("benchmark policy_static.pt --output policy_static.pt", "policy_static.pt: this is an artifact", "another name"),
    ("log flight.log -o flight.log", "flight.log: this is a flight log", "another name"),
    ("log flight.log --mcap flight.log", "flight.log: this is a flight log", "another name"),
    ("drive policy_static.pt --log best_model.pth", "best_model.pth: this is a trainer's checkpoint", "another name"),
    ("drive policy_static.pt --json policy_static.pt", "policy_static.pt: this is an artifact", "another name"),
    # what is not there, or not meant
    ("inspect nothing.pt", "nothing.pt: not found", "pretrained_model"),
    ("drive", "ARTIFACT", "--replay EPISODE"),
    ("drive policy_static.pt --latency-ms 100", "--latency-ms", "--world"),
    # no number
    ("drive policy_static.pt --max-seconds nan", "--max-seconds", "nan is not a finite number"),
    ("drive policy_static.pt --record out --record-mb nan", "--record-mb", "nan is not a finite number"),
    ("arm-car --max-seconds inf", "--max-seconds", "inf is not a finite number"),
    ("arm-car --heartbeat-s nan", "--heartbeat-s", "nan is not a finite number"),
    ("finetune params.yml params.yml --name x --weight nan", "--weight", "nan is not a finite number"),
]


def contents(folder):
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


@pytest.mark.parametrize(("command", "thing", "remedy"), WRONG, ids=[command for command, *_ in WRONG])
def test_names_the_thing_and_the_remedy(here, command, thing, remedy):
    before = contents(here)
    result = CliRunner().invoke(main, command.split())
    assert result.exit_code != 0
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    (sentence,) = [line for line in result.output.splitlines() if line.startswith(("rover: ", "Error: "))]
    assert thing in sentence and remedy in result.output, result.output
    assert "Traceback" not in result.output
    assert contents(here) == before  # nothing half-written, and nothing lost

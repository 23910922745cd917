"""Wrong commands: each ends in one sentence that names the thing and what to do, and never in exit code 0."""

import json
import zipfile

import pytest

from tests.helpers.command import rover


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with one of everything, by its looks."""
    monkeypatch.chdir(tmp_path)
    with zipfile.ZipFile("policy_static.pt", "w") as z:
        z.writestr("archive/code/net.py", b"")
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "noise.bin").write_bytes(b"\0\1\2hello")
    (tmp_path / "lfs.pth").write_text("version https://git-lfs")
    stage = {"schema": 1, "stage": "load", "params": {}, "metrics": {}, "inputs": {}, "env": {}}
    for folder in ("episodes/episode_1/frames", "runs/mine", "pretrained_model", "empty"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "episodes/episode_1/episode_data.json").write_text("{}")
    (tmp_path / "pretrained_model/config.json").write_text("{}")
    (tmp_path / "runs/mine/load.json").write_text(json.dumps(stage))
    return tmp_path


# The command, and the thing that its sentence names: a case for each way to be wrong. tests/onboard/test_kinds.py has
# the kinds, and tests/workshop those of the readers.
WRONG = [
    # wrong kind or order
    ("run noise.bin episodes", "noise.bin: an unknown kind of file, not a checkpoint"),
    ("run noise.bin", "EPISODES"),
    ("run lerobot/act_x episodes", "hf download lerobot/act_x --local-dir act_x"),
    ("run pretrained_model lerobot/pusht", "hf download --repo-type dataset lerobot/pusht --local-dir pusht"),
    ("run pretrained_model episodes --name a/b", "use letters, digits, _, - and ."),
    ("playbook fly", "known are benchmark, deploy"),
    ("notebooks runs/mine", "runs/mine: no notebooks in it"),
    ("export noise.bin --card", "noise.bin"),
    ("run --only 04 --name nothing", "nothing"),
    ("run nothing.pth episodes", "nothing.pth: not found"),
    ("run noise.bin episodes -p worlds many", "worlds must be a whole number"),
    ("run --only 04 --name mine --samples 5", "no parameter samples"),
    ("inspect nothing.pt", "nothing.pt: not found"),
    ("inspect notes.txt", "notes.txt: an unknown kind of file, not a checkpoint"),
    ("inspect pretrained_model/config.json", "config.json: JSON or safetensors, not a checkpoint"),
    ("inspect lfs.pth", "git lfs pull"),
    ("report runs/mine", "runs/mine: no verdict without"),
    ("drive pretrained_model", "pretrained_model: this is a LeRobot checkpoint"),
    ("export-dataset empty out", "empty: no episode folders in it"),
    ("distill nothing.pth none --size 320 --name fast", "320x180"),
    # no device
    ("drive policy_static.pt --dry-run --camera 99", "policy_static.pt: unknown record"),
    ("doctor --receiver --port ttyNONE", "ttyNONE"),
    # an output that would cost something else
    ("benchmark policy_static.pt --output runs/mine/load.json", "load.json: this is the report of"),
    ("benchmark policy_static.pt --output notes.txt/o.json", "notes.txt: cannot be written to"),
    # not meant, or no number
    ("drive policy_static.pt --max-seconds nan", "--max-seconds"),
    ("drive policy_static.pt --seed 3", "--seed belongs to --world"),
    ("drive policy_static.pt --world --port ttyUSB0", "--port belongs to a car"),
    ("record nothing --finish", "no such folder"),
]


def contents(folder):
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


@pytest.mark.parametrize(("command", "thing"), WRONG, ids=[command for command, *_ in WRONG])
def test_names_the_thing_and_what_to_do(here, command, thing):
    before = contents(here)
    result = rover(*command.split())
    assert result.exit_code != 0
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    (sentence,) = [line for line in result.output.splitlines() if line.startswith(("rover: ", "Error: "))]
    assert thing in sentence and "Traceback" not in result.output, result.output
    assert sentence.startswith("Error: ") or "; " in sentence  # a remedy
    assert contents(here) == before  # nothing half-written, and nothing lost

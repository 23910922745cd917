"""What a file is, told by its looks; and a command that wants another thing refuses it."""

import json
import os
import zipfile

import pytest

from rover_lib.onboard.drive.flight_log import FlightLog
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.kinds import REMEDIES, WANTED, check_kind, check_output, kinds_of
from rover_lib.onboard.stage import write_stage

PULLED = b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1\n"


def archive(path, **entries):
    with zipfile.ZipFile(path, "w") as z:
        for name, data in entries.items():
            z.writestr(f"archive/{name.replace('_DOT_', '.')}", data)
    return path


@pytest.mark.parametrize(
    ("name", "data", "kind"),
    [
        ("p.tar.gz", b"\x1f\x8b\x08", "packed"),
        ("p.tar", b"p/config.json".ljust(257, b"\0") + b"ustar", "packed"),
        ("model.safetensors", PULLED, "pointer"),
        ("meta/info.json", b"{}", "part"),
        ("000002/training_state/training_step.json", b"{}", "part"),
        ("notes.txt", b"hello", "document"),
    ],
)
def test_parts_archives_and_pointers_are_refused_with_what_to_do(tmp_path, name, data, kind):
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)
    wrong = path if path.suffix != ".json" else path.parent  # a folder that is a part, too
    assert kinds_of(wrong) == (kind,)
    with pytest.raises(RoverError) as refused:
        check_kind(wrong, "checkpoint")
    assert refused.value.remedy == REMEDIES[kind]


@pytest.mark.parametrize(
    ("name", "data", "kind"),
    [
        ("data_DOT_pkl", b"..model_state_dict..", ("checkpoint",)),
        ("data_DOT_pkl", b"samples smooth image_sizes", ("calibration",)),
        ("data_DOT_pkl", b"somebody's tensors", ()),
        ("code/net_DOT_py", b"", ("artifact",)),
        ("config_DOT_json", b"{}", ("packed",)),
        ("photo", b"", ()),
    ],
)
def test_archives(tmp_path, name, data, kind):
    assert kinds_of(archive(tmp_path / "file.pt", **{name: data})) == kind


def test_what_this_project_writes(tmp_path):
    with FlightLog(tmp_path / "flight.log", header={"hz": 30}, max_bytes=1_000_000, keep=1):
        pass
    assert kinds_of(tmp_path / "flight.log") == ("flight log",)
    write_stage(tmp_path / "load.json", "load", params={}, metrics={"many": list(range(100_000))})
    assert kinds_of(tmp_path / "load.json") == ("stage",) and kinds_of(tmp_path) == ("run",)
    (tmp_path / "pretrained_model").mkdir()
    assert kinds_of(tmp_path) == ("run", "pretrained")  # a folder may be several
    for wanted in ("checkpoint", "run"):
        check_kind(tmp_path, wanted)


def test_what_cannot_be_told_is_left_to_the_command(tmp_path):
    (tmp_path / "text").write_text("{")
    (tmp_path / "json").write_text(json.dumps({"a": 1}))
    (tmp_path / "zip").write_bytes(b"PK\x03\x04 damaged")
    os.mkfifo(tmp_path / "fifo")  # reading from it would wait for ever
    for name in ("text", "json", "zip", "fifo", "nothing"):
        assert kinds_of(tmp_path / name) == ()
        check_kind(tmp_path / name, "artifact")


def test_an_output_takes_the_place_of_its_own_kind_only(tmp_path):
    artifact = archive(tmp_path / "policy_static.pt", **{"code/net_DOT_py": b""})
    (tmp_path / "link.pt").symlink_to(artifact)
    (tmp_path / "dangling.pt").symlink_to("nowhere")
    (tmp_path / "notes").write_text("unknown: as with any other program, what was asked for is written")
    for name in ("policy_static.pt", "link.pt", "dangling.pt", "notes", "new.pt", "new/folders/new.pt"):
        check_output(tmp_path / name, "artifact")
    check_output(tmp_path / "/dev/null", "flight log", appended=True)  # nothing is there to lose
    for path in (artifact, tmp_path / "link.pt", tmp_path, tmp_path / "notes" / "new.pt"):
        with pytest.raises(RoverError):
            check_output(path, "checkpoint")


def test_another_kind_is_refused_with_how_to_get_the_wanted_one(tmp_path):
    path = archive(tmp_path / "policy_static.pt", **{"code/net_DOT_py": b""})
    with pytest.raises(RoverError) as refused:
        check_kind(path, "checkpoint")
    assert "this is an artifact" in refused.value.what and refused.value.remedy == WANTED["checkpoint"][1]

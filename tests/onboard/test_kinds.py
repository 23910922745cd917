"""What a file is, told by its looks; and a command that wants another thing refuses it."""

import os
import zipfile

import pytest

from rover_lib.onboard.drive.flight_log import FlightLog
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.kinds import check_kind, check_output, kinds_of
from rover_lib.onboard.stage import write_stage


def archive(path, name, data=b""):
    with zipfile.ZipFile(path, "w") as z:
        z.writestr(f"archive/{name}", data)
    return path


ARCHIVES = {"checkpoint": ("data.pkl", b"..model_state_dict.."), "artifact": ("code/net.py", b"")}


def test_what_this_project_writes(tmp_path):
    for kind, (name, data) in ARCHIVES.items():
        assert kinds_of(archive(tmp_path / kind, name, data)) == (kind,)
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
    (tmp_path / "json").write_text('{"a": 1}')
    (tmp_path / "zip").write_bytes(b"PK\x03\x04 damaged")
    archive(tmp_path / "tensors", "data.pkl", b"somebody's tensors")
    os.mkfifo(tmp_path / "fifo")  # reading from it would wait for ever
    for name in ("json", "zip", "tensors", "fifo"):
        assert kinds_of(tmp_path / name) == ()
        check_kind(tmp_path / name, "artifact")


def test_an_output_takes_the_place_of_its_own_kind_only(tmp_path):
    artifact = archive(tmp_path / "policy_static.pt", "code/net.py")
    (tmp_path / "link.pt").symlink_to(artifact)
    (tmp_path / "notes").write_text("unknown: as with any other program, what was asked for is written")
    for name in ("policy_static.pt", "link.pt", "notes", "new.pt", "new/folders/new.pt"):
        check_output(tmp_path / name, "artifact")
    for stage in ("load", "benchmark"):
        write_stage(tmp_path / stage, stage, params={}, metrics={})
    check_output(tmp_path / "benchmark", "benchmark")
    for path in (artifact, tmp_path / "link.pt", tmp_path, tmp_path / "notes" / "new.pt", tmp_path / "load"):
        with pytest.raises(RoverError):
            check_output(path, "benchmark")

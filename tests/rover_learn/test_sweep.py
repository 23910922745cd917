"""A sweep: what its sheet asks for, and that each run is made once, whoever dies on the way."""

import os
import signal
import sys
from pathlib import Path

import pytest
import yaml
from click.testing import CliRunner

from rover_learn import sweep as sweeping
from rover_learn.sweep import Job, read_sheet
from rover_lib.cli import main
from rover_lib.onboard.errors import ParamsError, RoverError
from rover_lib.onboard.params import params


@pytest.fixture
def sheet(tmp_path):
    """A function that writes a sheet of an empty checkpoint and recordings, with these values changed."""
    (tmp_path / "best_model.pth").touch()
    (tmp_path / "episodes").mkdir()
    content = {
        "checkpoints": [str(tmp_path / "best_model.pth")],
        "episodes": str(tmp_path / "episodes"),
        "notebooks": {"samples": [100, 200]},
        "params": {"calibration.seed": [0, 1, 2]},
    }

    def write(**changes):
        path = tmp_path / "sheet.yml"
        path.write_text(yaml.safe_dump({k: v for k, v in {**content, **changes}.items() if v != "left out"}))
        return path

    return write


def test_every_combination_is_a_run_and_keeps_its_name_while_the_sheet_grows(sheet, tmp_path):
    jobs = read_sheet(sheet(params={"calibration.seed": [0, 1, 2], "quantization.smooth": [0.3, 0.5]}))
    assert len(jobs) == len({job.name for job in jobs}) == 2 * 3 * 2
    assert jobs[0].name.startswith("best_model-samples100-seed0-smooth0.3-")
    assert len(read_sheet(sheet(notebooks={"samples": [100, 100]}))) == 3
    few = {job.name for job in read_sheet(sheet())}
    assert few < {job.name for job in read_sheet(sheet(notebooks={"samples": [100, 200, 300]}))}
    (tmp_path / "best_model.pth").write_text("another policy")
    assert not few & {job.name for job in read_sheet(sheet())}


@pytest.mark.parametrize(
    "changes",
    [
        {"checkpoints": "left out"},
        {"episodes": ["a", "b"]},
        {"checkpoint": "a.pth"},
        {"notebooks": [1]},
        {"params": {"calibration.sed": [0, 1, 2]}},
    ],
)
def test_a_wrong_sheet_is_refused_and_makes_nothing(sheet, changes, tmp_path):
    path = sheet(**changes)
    with pytest.raises(ParamsError):
        read_sheet(path)
    result = CliRunner().invoke(main, ["sweep", str(path), "--out", str(tmp_path / "out")])
    assert (result.exit_code, (tmp_path / "out").exists()) == (1, False)


def test_a_run_has_its_own_values_of_params_yml():
    before = params()["calibration"]
    job = Job("a", "b", {}, {}, {"calibration.seed": 7, "quantization.smooth": 0.3})
    with sweeping._settings_of(job):
        inside = params()
    assert inside["calibration"] == {**before, "seed": 7} and inside["quantization"]["smooth"] == 0.3
    assert params()["calibration"] == before


def test_a_student_is_taught_by_the_options_of_distill():
    job = Job("teacher.pth", "episodes", {"size": "96x54", "decoder_layers": 1}, {"worlds": 0}, {})
    assert job.distill_command()[-6:] == ["--device", "cpu", "--size", "96x54", "--decoder-layers", "1"]


def stub_make(job: Job, folder: Path) -> None:
    """Leave what a run leaves; the first try of seed 1 kills its worker, and seed 2 fails."""
    run, seed = folder / job.name, job.params["calibration.seed"]
    if (run / "run.json").exists():
        return
    run.mkdir(exist_ok=True)
    if seed == 1 and not (run / "died").exists():
        (run / "died").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if seed == 2 and not (folder / "mended").exists():
        raise ValueError("seed 2")
    (run / "run.json").touch()
    with (folder / "log").open("a") as log:
        log.write(f"{job.name}\n")


@pytest.mark.slow
def test_six_runs_on_two_workers_of_which_one_dies(tmp_path, sheet, monkeypatch):
    """All six are there, none was made twice; those that failed are named, and made once they can be."""
    monkeypatch.setattr(sweeping, "make", stub_make)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), *sys.path]))
    jobs, out = read_sheet(sheet()), tmp_path / "out"
    with sweeping.open_cluster(workers=2) as client:
        failed = sweeping.sweep(jobs, out, client)
        assert {*failed} == {job.name for job in jobs if job.params["calibration.seed"] == 2}
        assert set(failed.values()) == {"ValueError: seed 2"}
        (out / "mended").touch()
        assert sweeping.sweep(jobs, out, client) == {}
    assert sorted((out / "log").read_text().splitlines()) == sorted(job.name for job in jobs)


@pytest.mark.slow
def test_no_scheduler_is_refused():
    with pytest.raises(RoverError, match="no Dask scheduler"):
        sweeping.open_cluster("tcp://127.0.0.1:1")

"""A sweep: what its sheet asks for, and that each run is made once, whoever dies on the way."""

import json
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
from rover_lib.onboard.stage import write_stage


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
    jobs = read_sheet(sheet(params={"calibration.seed": [0, 1, 2], "quantization.scheme": ["symmetric", "affine"]}))
    assert len(jobs) == len({job.name for job in jobs}) == 2 * 3 * 2
    assert jobs[0].name.startswith("best_model-samples100-seed0-schemesymmetric-")
    few = {job.name for job in read_sheet(sheet())}
    assert few < {job.name for job in read_sheet(sheet(notebooks={"samples": [100, 200, 300]}))}
    (tmp_path / "best_model.pth").write_text("another policy")
    assert not few & {job.name for job in read_sheet(sheet())}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"checkpoints": "left out"}, "paths of checkpoints"),
        ({"episodes": ["a", "b"]}, "one folder of episodes"),
        ({"checkpoint": "a.pth"}, "no 'checkpoint'"),
        ({"notebooks": {"run_dir": "x"}}, "no 'run_dir'"),
        ({"notebooks": [1]}, "mappings"),
        ({"notebooks": {"samples": [100, 100]}}, "twice"),
        ({"params": {"calibration.sed": [0, 1, 2]}}, "no 'calibration.sed'"),
        ({"students": [{"layers": 1}]}, "--layers"),
        ({"students": [{"size": 320}]}, "width and height"),
    ],
)
def test_a_wrong_sheet_is_refused(sheet, changes, said):
    with pytest.raises(ParamsError, match=said):
        read_sheet(sheet(**changes))


def test_a_command_on_a_wrong_sheet_makes_nothing(sheet, tmp_path):
    result = CliRunner().invoke(main, ["sweep", str(sheet(checkpoints="left out")), "--out", str(tmp_path / "out")])
    assert (result.exit_code, (tmp_path / "out").exists()) == (1, False)
    assert result.output.startswith("rover: ") and result.output.count("\n") == 1


def test_a_run_has_its_own_values_of_params_yml(tmp_path):
    before = params()["calibration"]
    job = Job("a", "b", {}, {}, {"calibration.seed": 7, "quantization.smooth": 0.3})
    with sweeping._settings_of(job, tmp_path):
        inside = params()
    assert inside["calibration"] == {**before, "seed": 7} and inside["quantization"]["smooth"] == 0.3
    assert params()["calibration"] == before and not list(tmp_path.iterdir())


def test_a_student_is_taught_into_its_runs_folder(tmp_path, monkeypatch):
    """The training and the notebooks are left out: what they are given is what this is about."""
    made = []
    monkeypatch.setattr("rover_learn.cli.distill.main", lambda words, **_: made.append(words))
    monkeypatch.setattr("rover_lib.workshop.run.run.run", lambda *words, **options: made.append((words, options)))
    monkeypatch.setattr("rover_lib.workshop.checkpoint.files.find_written", lambda folder: folder / "best_model.pth")
    job = Job("teacher.pth", "episodes", {"size": "96x54", "decoder_layers": 1, "qat": True}, {"worlds": 0}, {})
    sweeping.prepare(job, tmp_path)
    named = ["teacher.pth", "episodes", "--name", job.name, "--device", "cpu"]
    own = ["--size", "96x54", "--decoder-layers", "1", "--qat", "--runs-dir", str(tmp_path)]
    student = tmp_path / job.name / "best_model.pth"
    options = {"runs_dir": tmp_path, "timed": False, "worlds": 0}
    assert made == [[*named, *own], ((student, "episodes", job.name), options)]


def stub_prepare(job: Job, folder: Path) -> None:
    """Leave what a run leaves; the first try of seed 1 kills its worker, and seed 2 fails."""
    run, seed = folder / job.name, job.params["calibration.seed"]
    run.mkdir(exist_ok=True)
    if seed == 1 and not (run / "died").exists():
        (run / "died").touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if seed == 2 and not (folder / "mended").exists():
        raise ValueError("seed 2")
    mode = {"steering_mae_pct": 0.1, "throttle_mae_pct": 0.2, "steering_vs_recorded_pct": 5.0 + seed}
    mode |= {"throttle_vs_recorded_pct": 1.0, "hits": 3, "trials": 4, "size_mb": 12.0}
    ranges = {"steering": [-1, 1], "throttle": [0, 1]}
    write_stage(run / "compare.json", "compare", params={}, metrics={"modes": {"static": mode}, "action_range": ranges})
    made = {"modes": {"static": {"content_hash": job.name}}}
    write_stage(run / "quantize.json", "quantize", params={}, metrics=made)
    with (folder / "log").open("a") as log:
        log.write(f"prepared {job.name}\n")


def stub_benchmark(job: Job, folder: Path) -> None:
    timed = {"artifacts": {"static": {"latency_p50_ms": 10.0 - job.params["calibration.seed"]}}}
    inputs = {"policy_static.pt": job.name}
    write_stage(folder / job.name / "benchmark-here.json", "benchmark", params={}, metrics=timed, inputs=inputs)
    (folder / job.name / "run.json").touch()
    with (folder / "log").open("a") as log:
        log.write(f"timed {job.name}\n")


@pytest.mark.slow
def test_six_runs_on_two_workers_of_which_one_dies(tmp_path, sheet, monkeypatch):
    """All six are there, none was made twice; those that failed are named, and made once they can be."""
    monkeypatch.setattr(sweeping, "prepare", stub_prepare)
    monkeypatch.setattr(sweeping, "benchmark", stub_benchmark)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(Path(__file__).parent), *sys.path]))
    jobs, out = read_sheet(sheet()), tmp_path / "out"
    with sweeping.open_cluster(workers=2) as client:
        failed = sweeping.sweep(jobs, out, client)
        assert {*failed} == {job.name for job in jobs if job.params["calibration.seed"] == 2}
        assert set(failed.values()) == {"ValueError: seed 2"}
        metrics = sweeping.write_report(jobs, out, failed)["metrics"]
        assert (len(metrics["runs"]), len(metrics["failed"]), metrics["missing"]) == (4, 2, 0)
        (out / "mended").touch()
        assert sweeping.sweep(jobs, out, client) == {}
    log = (out / "log").read_text().splitlines()
    for word in ("prepared", "timed"):
        assert sorted(line.split()[1] for line in log if line.startswith(word)) == sorted(job.name for job in jobs)
    rows = sweeping.write_report(jobs, out, {})["metrics"]["runs"]
    assert len(rows) == 6 and {row["error_pct"] for row in rows} == {0.2}
    assert len(sweeping.table(rows)) == 7
    assert json.loads((out / "sweep.json").read_text())["stage"] == "sweep"


@pytest.mark.slow
def test_no_scheduler_is_refused():
    with pytest.raises(RoverError, match="no Dask scheduler"), sweeping.open_cluster("tcp://127.0.0.1:1"):
        pass

"""A sweep: what its sheet asks for, and that each run is made once, whoever dies on the way."""

import json
from dataclasses import replace
from types import SimpleNamespace

import pytest
import yaml
from click.testing import CliRunner
from policies import of_a_cars_size
from recorded import record_drives
from sweep_work import Stub

from rover_learn import sweep as sweeping
from rover_learn.sweep import Job, Sheet, SweepError
from rover_lib.cli import main
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.params import params
from rover_lib.workshop.checkpoint.checkpoint import load_checkpoint


@pytest.fixture
def sheet(tmp_path):
    """A function that writes a sheet of an empty checkpoint and recordings, with these values changed."""
    (tmp_path / "best_model.pth").touch()
    (tmp_path / "episodes").mkdir()
    content = {
        "checkpoints": [str(tmp_path / "best_model.pth")],
        "episodes": str(tmp_path / "episodes"),
        "notebooks": {"samples": [100, 200]},
        "params": {"calibration.seed": [0, 1, 2], "quantization.scheme": ["symmetric", "affine"]},
    }

    def write(**changes):
        path = tmp_path / "sheet.yml"
        path.write_text(yaml.safe_dump({k: v for k, v in {**content, **changes}.items() if v != "left out"}))
        return path

    return write


def test_every_combination_is_a_run(sheet):
    jobs = Sheet.read(sheet(students=[{}, {"size": "320x180"}])).jobs()
    assert len(jobs) == len({job.name for job in jobs}) == 2 * 2 * 3 * 2
    assert {job.notebooks["samples"] for job in jobs} == {100, 200}
    assert jobs[-1].student == {"size": "320x180"}
    assert jobs[0].name.startswith("best_model-samples100-seed0-schemesymmetric-")


def test_names_stay_while_the_sheet_grows(sheet):
    few = {job.name for job in Sheet.read(sheet()).jobs()}
    more = {job.name for job in Sheet.read(sheet(notebooks={"samples": [100, 200, 300]})).jobs()}
    assert few < more


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"checkpoints": "left out"}, "no 'checkpoints' in it"),
        ({"episodes": ["a", "b"]}, "episodes must be one folder"),
        ({"checkpoint": "a.pth"}, "a sheet has no key 'checkpoint'"),
        ({"notebooks": {"sample": 1}}, "no notebook has a parameter 'sample'"),
        ({"notebooks": {"run_dir": "x"}}, "no notebook has a parameter 'run_dir'"),
        ({"notebooks": [1]}, "notebooks must be a mapping"),
        ({"notebooks": {"samples": []}}, "samples has no value"),
        ({"params": {"seed": 1}}, "named by their place"),
        ({"params": {"calibration.sed": [0, 1, 2]}}, "params.yml has no 'calibration.sed'"),
        ({"params": {"calibration.seed.first": 1}}, "params.yml has no 'calibration.seed.first'"),
        ({"params": {"no_section.seed": 1}}, "params.yml has no 'no_section.seed'"),
        ({"checkpoints": 5}, "checkpoints must be paths"),
        ({"checkpoints": ["a.pth", {"b": 1}]}, "checkpoints must be paths"),
        ({"students": [{1: 2, "layers": 3}]}, "no student has '1'"),
        ({"students": {"size": "1x1"}}, "students must be a list of mappings"),
        ({"students": [{"layers": 1}]}, "no student has 'layers'"),
        ({"students": [{"size": 320}]}, "a student's size is WIDTHxHEIGHT"),
        ({"students": [{"qat": "no"}]}, "qat is true or false"),
        ({"students": [{"steps": "few"}]}, "steps is a whole number"),
    ],
)
def test_a_wrong_sheet_is_a_sentence(sheet, changes, said):
    with pytest.raises(SweepError, match=said):
        Sheet.read(sheet(**changes))


def test_a_key_that_is_no_text_is_a_sentence(tmp_path):
    (tmp_path / "sheet.yml").write_text("1: 2\nfoo: 3\n")
    with pytest.raises(SweepError, match="a sheet has no key '1'"):
        Sheet.read(tmp_path / "sheet.yml")


def test_a_sheet_that_is_not_there_is_the_users_to_write(tmp_path):
    with pytest.raises(SweepError, match=r"not found; docs/sweep\.md has a sheet"):
        Sheet.read(tmp_path / "sheet.yml")


def test_a_run_twice_is_refused(sheet):
    with pytest.raises(SweepError, match="twice"):
        Sheet.read(sheet(notebooks={"samples": [100, 100]})).jobs()


def test_a_command_on_a_wrong_sheet_makes_nothing(sheet, tmp_path):
    result = CliRunner().invoke(main, ["sweep", str(sheet(checkpoints="left out")), "--out", str(tmp_path / "out")])
    assert (result.exit_code, (tmp_path / "out").exists()) == (1, False)
    assert result.output.startswith("rover: ") and result.output.count("\n") == 1


@pytest.mark.slow
def test_no_scheduler_is_a_sentence():
    with pytest.raises(SweepError, match="no Dask scheduler answers"), sweeping.on_cluster("tcp://127.0.0.1:1"):
        pass


def test_a_run_has_its_own_values_of_params_yml(tmp_path):
    before = params()["calibration"]
    job = Job("a", "b", {}, {}, {"calibration.seed": 7, "quantization.smooth": 0.3})
    with sweeping._settings_of(job, tmp_path):
        inside = params()
    assert inside["calibration"] == {**before, "seed": 7} and inside["quantization"]["smooth"] == 0.3
    assert params()["calibration"] == before and not list(tmp_path.iterdir())


def test_what_was_made_of_other_files_is_made_again(tmp_path, sheet):
    job = Sheet.read(sheet()).jobs()[0]
    stub = Stub(tmp_path / "log")
    mark = sweeping.fingerprints([job])[job.name]
    for part in ("prepare", "prepare"):
        sweeping.do(part, stub, job, tmp_path, mark)
    assert stub.log.read_text().count("prepared") == 1
    (tmp_path / "best_model.pth").write_text("another")
    other = sweeping.fingerprints([job])[job.name]
    assert other != mark and sweeping.parts_done(job, tmp_path, other) == []
    sweeping.do("prepare", stub, job, tmp_path, other)
    assert stub.log.read_text().count("prepared") == 2
    (tmp_path / job.name / "job.json").write_text("{")
    assert sweeping.parts_done(job, tmp_path, other) == []


def test_files_that_many_runs_have_are_looked_through_once(sheet, monkeypatch):
    jobs = Sheet.read(sheet()).jobs()
    walked = []
    monkeypatch.setattr(sweeping, "_files_in", lambda place: walked.append(place) or str(place).encode())
    marks = sweeping.fingerprints(jobs)
    assert len(jobs) > 1 and list(marks) == [job.name for job in jobs]
    assert len(walked) == len(set(walked)) == len({p for job in jobs for p in (job.checkpoint, job.episodes)})


def test_the_best_are_those_that_no_other_beats():
    row = {"to_recorded_pct": 5.0, "latency_p50_ms": 10.0, "size_mb": 12.0}
    assert not sweeping._beats(row, row)
    assert sweeping._beats(row, {**row, "size_mb": 13.0})
    assert not sweeping._beats({**row, "latency_p50_ms": 11.0}, {**row, "size_mb": 13.0})
    assert not sweeping._beats(row, {**row, "to_recorded_pct": None})


def test_times_are_of_the_artifact_that_is_there(tmp_path, sheet, monkeypatch):
    """A run that is made again keeps the benchmarks of other hosts, which are of what it was before."""
    job = Sheet.read(sheet()).jobs()[0]
    stub, mark = Stub(tmp_path / "log"), sweeping.fingerprints([job])[job.name]
    worker = SimpleNamespace(state=SimpleNamespace(total_resources={"timing": 1}))
    monkeypatch.setattr("distributed.get_worker", lambda: worker)
    for part in ("prepare", "benchmark"):
        sweeping.do(part, stub, job, tmp_path, mark)
    timed = json.loads((tmp_path / job.name / "benchmark-here.json").read_text())
    timed["inputs"], timed["metrics"] = (
        {"policy_static.pt": "another"},
        {"artifacts": {"static": {"latency_p50_ms": 99}}},
    )
    (tmp_path / job.name / "benchmark-a-host.json").write_text(json.dumps(timed))
    (row,) = sweeping.rows([job], tmp_path, {job.name: mark})
    assert row["latency_p50_ms"] == 10


@pytest.mark.slow
def test_twelve_runs_on_two_workers_of_which_one_dies(tmp_path, sheet):
    """All twelve are there, none was made twice; the one that failed is named, and made once it can be."""
    jobs, out = Sheet.read(sheet()).jobs(), tmp_path / "out"
    stub = Stub(tmp_path / "log", dies=1, fails=2)
    stub.log.touch()
    with sweeping.on_this_machine(2) as client:
        failed = sweeping.sweep(jobs, out, client, work=stub)
        assert {name for name in failed} == {job.name for job in jobs if job.params["calibration.seed"] == 2}
        assert set(failed.values()) == {"ValueError: seed 2"}
        content = sweeping.write_report(jobs, out, failed)["metrics"]
        assert (len(content["runs"]), len(content["failed"]), content["missing"]) == (8, 4, 0)
        assert sweeping.sweep(jobs, out, client, together=True, work=replace(stub, fails=-1)) == {}
    said = stub.log.read_text().splitlines()
    assert sum(line.startswith("dies") for line in said) == 4
    for word in ("prepared", "timed"):
        assert sorted(line.split()[1] for line in said if line.startswith(word)) == sorted(job.name for job in jobs)
    content = sweeping.write_report(jobs, out, {})["metrics"]
    assert len(content["runs"]) == 12 and {r["error_pct"] for r in content["runs"]} == {0.2}
    # of every seed the same figures: seed 0 has the least error, seed 2 the least time, and none beats another
    assert all(row["best"] for row in content["runs"])
    assert (out / "sweep.png").stat().st_size > 10_000
    assert len(sweeping.table(content["runs"])) == 13
    assert json.loads((out / "sweep.json").read_text())["stage"] == "sweep"


@pytest.mark.slow
def test_a_student_is_taught_into_its_runs_folder(tmp_path, monkeypatch):
    """The notebooks themselves are left out: what they are given is what this is about."""
    asked = []
    monkeypatch.setattr("rover_lib.workshop.run.run.run", lambda *words, **options: asked.append((words, options)))
    monkeypatch.setenv("ROVER_CACHE", str(tmp_path / "cache"))
    of_a_cars_size(tmp_path / "teacher.pth")
    episodes = record_drives(tmp_path / "episodes")
    student = {"size": "96x54", "decoder_layers": 1, "feedforward": 64, "steps": 4, "samples": 12}
    few = {"distill.judged_frames": 4, "calibration.samples": 8, "quantization.observers": ["minmax"]}
    job = Job(str(tmp_path / "teacher.pth"), str(episodes), student, {"worlds": 0}, few)
    sweeping.Notebooks().prepare(job, tmp_path)
    student_file = tmp_path / job.name / "best_model.pth"
    config = load_checkpoint(student_file).config
    assert (config.image_sizes, config.decoder_layers) == (((54, 96),), 1)
    assert asked == [((student_file, job.episodes, job.name), {"runs_dir": tmp_path, "timed": False, "worlds": 0})]
    with pytest.raises(SweepError, match="WIDTHxHEIGHT"):
        sweeping.Notebooks().prepare(replace(job, student={"size": "96 by 54"}), tmp_path)


def test_a_student_that_only_lerobots_folder_can_hold_is_run_from_there(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr("rover_lib.workshop.run.run.run", lambda checkpoint, *_, **__: asked.append(checkpoint))

    def leave(*_, **__):
        (tmp_path / "taught" / "pretrained_model").mkdir(parents=True)
        return tmp_path / "taught"

    monkeypatch.setattr("rover_learn.distill.distill", leave)
    sweeping.Notebooks().prepare(Job("pretrained_model", "episodes", {"decoder_layers": 1}, {}, {}), tmp_path)
    assert asked == [tmp_path / "taught" / "pretrained_model"]


@pytest.mark.slow
def test_a_cluster_without_a_worker_that_times_is_refused():
    from distributed import LocalCluster

    with (
        LocalCluster(1, processes=False, dashboard_address=None) as cluster,
        pytest.raises(RoverError, match="no worker may time"),
        sweeping.on_cluster(cluster.scheduler_address),
    ):
        pass

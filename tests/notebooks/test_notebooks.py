"""The notebooks as runs, and with each of their parameters turned."""

import ast
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest

from rover_lib.onboard.errors import ParamsError
from rover_lib.onboard.params import params
from rover_lib.onboard.stage import write_stage
from rover_lib.workshop.run import run as runs
from rover_lib.workshop.run import run_report
from rover_lib.workshop.run.run import NOTEBOOKS, parameters_of
from tests.helpers.executed import run_cells
from tests.helpers.recorded import record_drives


def written(folder, parameters='run_dir = "."  # here', work="pass"):
    """Write a small 01_load.ipynb: these parameters, and one more cell."""
    cells = [nbformat.v4.new_code_cell(source) for source in (parameters, work)]
    cells[0].metadata["tags"] = ["parameters"]
    folder.mkdir(exist_ok=True)
    made = nbformat.v4.new_notebook(metadata={"language_info": {"name": "python"}}, cells=cells)
    nbformat.write(made, folder / "01_load.ipynb")


@pytest.fixture
def one_notebook(monkeypatch, tmp_path):
    monkeypatch.setattr(runs, "NAMES", ("01_load",))
    monkeypatch.setattr(runs, "NOTEBOOKS", tmp_path / "notebooks")
    return tmp_path / "notebooks"


@pytest.mark.slow
def test_parameters_act_where_they_stand_and_a_run_may_be_moved(one_notebook, tmp_path):
    parameters = 'run_dir = "../runs/demo"  # here\nworlds = 1  # count\nsamples = 1  # of params.yml'
    work = "import pathlib, sys\npathlib.Path(run_dir, 'made').write_text(f'{worlds} {samples} {sys.executable}')"
    written(one_notebook, parameters, work)
    folder = runs.run("ck", "episodes", "mine", runs_dir=tmp_path / "runs", worlds=7)
    samples = params()["calibration"]["samples"]
    assert (folder / "made").read_text() == f"7 {samples} {runs.sys.executable}"
    assert {p.name for p in folder.iterdir()} == {"made", "01_load.ipynb"}
    first, second = nbformat.read(folder / "01_load.ipynb", as_version=4).cells
    assert first.source == f"run_dir = '.'  # here\nworlds = 7  # count\nsamples = {samples}  # of params.yml"
    assert second.source == work


@pytest.mark.slow
@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("import rover_lib.onboard.errors as e\nraise e.EpisodeError('x: empty')", "^01_load.ipynb, cell 2: x: empty$"),
        ("1 / 0", r"^01_load.ipynb, cell 2: ZeroDivisionError: .*--debug"),
    ],
)  # fmt: skip
def test_a_failing_cell_is_one_sentence_and_no_file(one_notebook, tmp_path, source, words):
    written(one_notebook, work=source)
    with pytest.raises(runs.RoverError, match=words):
        runs.run("ck", "episodes", "mine", runs_dir=tmp_path / "runs")
    assert not list((tmp_path / "runs").iterdir())


def test_what_a_run_was_not_asked_to_know_is_refused_before_anything_runs(one_notebook, tmp_path):
    written(one_notebook)
    with pytest.raises(runs.RoverError, match="wrlds"):
        runs.run("ck", "episodes", runs_dir=tmp_path, wrlds=1)
    with pytest.raises(runs.RoverError, match="plain folder name"):
        runs.run("ck", "episodes", "../up", runs_dir=tmp_path)
    with pytest.raises(runs.RoverError, match="shape"):
        runs.execute("01_load", tmp_path, shape="round")


OF_ARTIFACTS = ("load.json", "run.json", "report.html", "arm.json", "students.json", "06_arm.ipynb", "policy_static.pt")
OF_OTHERS = ("benchmark-pi.json", "best_model.pth", "episodes/frame.jpg", "distill.json")


def contents(folder):
    return {str(p.relative_to(folder)): p.read_text() for p in folder.rglob("*") if p.is_file()}


@pytest.fixture
def old_run(one_notebook, tmp_path, monkeypatch):
    """again(execute): make the run `mine` again, which has a checkpoint and recordings in its folder, as the demo's."""
    written(one_notebook)
    folder = tmp_path / "runs" / "mine"
    for name in (*OF_ARTIFACTS, *OF_OTHERS, "figures/01_old.png"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("old")

    def again(execute, checkpoint="ck"):
        monkeypatch.setattr(runs, "_execute", execute)
        return runs.run(checkpoint, "episodes", "mine", runs_dir=folder.parent)

    return folder, again


def test_a_run_takes_the_place_of_the_last_one_only_when_it_is_whole(old_run):
    """A student's distill.json is of its checkpoint and stays; a teacher's students.json is of its old artifact."""
    made = ("load.json", "01_load.ipynb", "policy_static.pt", "figures/01_new.png")

    def ends_early(source, folder, given, bars):
        assert (folder / "benchmark-pi.json").read_text() == "old"  # for notebook 05
        for name in made:
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text("new")
        raise KeyboardInterrupt

    def ends_at_once(*given):
        raise runs.RoverError("no such checkpoint")

    (folder, again), before = old_run, contents(old_run[0])
    with pytest.raises(KeyboardInterrupt):
        again(ends_early)
    assert contents(folder) == before and contents(folder.parent / ".mine.new")["policy_static.pt"] == "new"
    with pytest.raises(runs.RoverError):  # with another checkpoint it begins anew
        again(ends_at_once, "other")
    assert contents(folder) == before and [p.name for p in folder.parent.iterdir()] == ["mine"]
    with pytest.raises(KeyboardInterrupt):
        again(ends_early)
    assert again(lambda *given: pytest.fail("it began again")) == folder  # the same command goes on there
    assert contents(folder) == dict.fromkeys(made, "new") | dict.fromkeys(OF_OTHERS, "old")
    assert [p.name for p in folder.parent.iterdir()] == ["mine"]


def test_root_learns_at_once_that_it_may_load_no_artifact(old_run, monkeypatch):
    monkeypatch.delenv("ROVER_AS_ROOT")
    monkeypatch.setattr("os.geteuid", lambda: 0)
    with pytest.raises(runs.RoverError, match="root does not load artifacts"):
        old_run[1](lambda *given: pytest.fail("it began"))


# --- turning parameters ---


def test_the_first_notebook_again_loads_what_its_run_was_made_of(tmp_path, monkeypatch):
    write_stage(tmp_path / "load.json", "load", params={"checkpoint": "c.pth", "episodes": "e"}, metrics={}, inputs={})
    given = []
    monkeypatch.setattr(runs, "_execute", lambda source, folder, values, bars: given.append(values))
    runs.execute("01_load", tmp_path, episodes="others")
    assert given == [{"checkpoint": "c.pth", "episodes": "others"}]


@pytest.mark.parametrize("name", runs.NAMES + runs.AFTERWARDS)
def test_each_parameter_of_a_notebook_is_read_there_and_says_what_params_yml_says(name):
    path, read = runs.NOTEBOOKS / f"{name}.ipynb", set()
    for cell in nbformat.read(path, as_version=4).cells:
        if cell.cell_type == "code":
            nodes = ast.walk(ast.parse(cell.source))
            read |= {node.id for node in nodes if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)}
    for parameter, literal, _ in runs.parameters_in(path):
        assert parameter in read
        if place := runs.IN_PARAMS.get(parameter):
            assert ast.literal_eval(literal) == params()[place[0]][place[1]]


@pytest.mark.parametrize("name", runs.NAMES + runs.AFTERWARDS)
def test_what_a_parameter_must_not_be_is_refused_by_its_name(name):
    for parameter in parameters_of(NOTEBOOKS / f"{name}.ipynb") - {"run_dir"}:
        with pytest.raises(ParamsError, match=f"parameter {parameter} must be .*, found -0.5"):
            run_cells(name, ".", **{parameter: -0.5})


TURNED = {
    "02_calibrate": ("calibrate", {"samples": 7, "seed": 3, "smooth": 0.7}),
    "03_quantize": (
        "quantize",
        {"observers": ["minmax"], "float_blocks": ["backbone.stem"], "modes": ["mixed"], "choosing_frames": 2},
    ),
    "04_compare": ("compare", {"held_out_frames": 4, "worlds": 1, "level": "hard"}),
    "05_benchmark": (f"benchmark-{runs.socket.gethostname()}", {"iterations": 3, "threads": 1}),
}


@pytest.fixture(scope="module")
def turned(tiny_file, tmp_path_factory):
    """A run of a tiny policy in which each parameter of notebooks 02 to 05 was turned; 02 has a kernel."""
    folder = tmp_path_factory.mktemp("runs")
    run_cells("01_load", folder, checkpoint=str(tiny_file), episodes=str(record_drives(folder / "episodes")))
    for name, (_, given) in TURNED.items():
        (runs.execute if name == "02_calibrate" else run_cells)(name, folder, **given)
    return folder


def test_each_parameter_that_is_turned_is_seen_in_the_json(turned):
    for name, (_, given) in TURNED.items():  # notebook 05's `rovers`, a folder, is tests/workshop/judge/test_hosts.py's
        assert given.keys() == parameters_of(NOTEBOOKS / f"{name}.ipynb") - {"run_dir", "rovers"}
    calibrated, quantized, compared, timed = (
        json.loads((turned / f"{s}.json").read_text()) for s, _ in TURNED.values()
    )
    assert calibrated["params"] == TURNED["02_calibrate"][1] and calibrated["metrics"]["samples"] == 7
    schemes = {mode: made.get("scheme") for mode, made in quantized["metrics"]["modes"].items()}
    assert schemes.keys() == {"fp32", "static", "mixed"} and schemes["mixed"]["float_blocks"] == ["backbone.stem"]
    for key, value in {"observer": "minmax", "smooth": 0.7}.items():
        assert schemes["static"][key] == schemes["mixed"][key] == value
    assert quantized["params"]["modes"] == ["mixed"]
    assert {p.name for p in turned.glob("policy_*.pt")} == {f"policy_{mode}.pt" for mode in schemes}
    found = compared["metrics"]
    assert (found["frames"], found["fp32"]["trials"], set(found["modes"])) == (4, 1, {"static", "mixed"})
    assert timed["params"]["threads"] == 1 and timed["metrics"]["artifacts"]["static"]["n"] == 3
    assert run_report.write(turned)["metrics"]["modes"]


def words_of_the_page(command):
    """Return the words of the page's only line that begins with the command, and an environment that finds it."""
    page = (NOTEBOOKS.parent / "docs" / "notebooks.md").read_text()
    (line,) = (line.strip() for line in page.splitlines() if line.startswith(f"    {command} "))
    env = {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    return line.split(), {"cwd": NOTEBOOKS.parent, "env": env, "check": True}


@pytest.mark.release  # a minute
def test_papermill_turns_a_parameter_as_the_page_types_it(demo_run, tmp_path):
    shutil.copytree(demo_run, tmp_path / "try1", ignore=shutil.ignore_patterns("episodes", "*.pth"))
    there = {"runs/try1": str(tmp_path / "try1"), "out.ipynb": str(tmp_path / "out.ipynb")}
    words, options = words_of_the_page("papermill")
    words = [there.get(word, word) for word in words]
    subprocess.run([*words, "-p", "held_out_frames", "8"], **options)
    compared = json.loads((tmp_path / "try1" / "compare.json").read_text())
    assert compared["metrics"]["fp32"]["trials"] == 10
    assert (tmp_path / "out.ipynb").is_file()


@pytest.mark.release  # half a minute
def test_nbval_runs_a_notebook_as_the_page_types_it(demo_run):
    words, options = words_of_the_page("pytest")
    assert "--nbval" in words
    subprocess.run(words, **options)

"""The notebooks as files: they call, check and show; what a function could hold is not in them."""

import ast
import json
import re
import shutil
import sys
import time
from types import SimpleNamespace

import nbformat
import pytest
from executed import run_cells

from lab.repository import publish
from lab.repository.publish import NOTEBOOK_LIMIT, RESULTS_OF
from rover_lib.onboard.stage import read_stage, write_stage
from rover_lib.workshop import progress
from rover_lib.workshop.run import run as runs
from rover_lib.workshop.run import run_report, session
from rover_lib.workshop.run.copy_run import copy_run
from rover_lib.workshop.run.run import AFTERWARDS, NAMES, NOTEBOOKS, parameters_of

PATHS = [NOTEBOOKS / f"{name}.ipynb" for name in NAMES + AFTERWARDS]
MOST_LINES = 12


@pytest.fixture(params=PATHS, ids=NAMES + AFTERWARDS)
def path(request):
    return request.param


@pytest.fixture
def notebook(path):
    return nbformat.read(path, as_version=4)


def code(notebook):
    return [c for c in notebook.cells if c.cell_type == "code"]


def test_is_valid_with_stable_ids(notebook):
    nbformat.validate(notebook)
    ids = [c.id for c in notebook.cells]
    assert len(set(ids)) == len(ids) and all(re.fullmatch(r"[a-z-]+", i) for i in ids)


def test_title_is_a_question(notebook):
    title = notebook.cells[0].source.splitlines()[0]
    assert notebook.cells[0].cell_type == "markdown" and re.fullmatch(r"# .+\?", title)


def test_parameters_are_literals_with_a_reason(notebook):
    cells = [c for c in code(notebook) if "parameters" in c.metadata.get("tags", [])]
    assert len(cells) == 1
    for line, statement in zip(cells[0].source.splitlines(), ast.parse(cells[0].source).body, strict=True):
        ast.literal_eval(statement.value)
        assert "  # " in line


def test_cells_call_check_and_show(notebook):
    for cell in code(notebook):
        kinds = {type(n) for n in ast.walk(ast.parse(cell.source))}
        assert not kinds & {ast.FunctionDef, ast.ClassDef, ast.Try, ast.While}, cell.id
        imports = kinds & {ast.Import, ast.ImportFrom}
        lines = [n for n in cell.source.splitlines() if n.strip()]
        assert imports or len(lines) <= MOST_LINES, f"{cell.id} has {len(lines)} lines"


def test_every_notebook_writes_a_figure_and_its_results(notebook, path):
    text = "\n".join(c.source for c in code(notebook))
    assert "plots.save(" in text
    assert bool(re.search(r"write_(stage|load|calibrate|quantize)\(", text)) == (
        path.stem in NAMES
    )  # afterwards the library writes the results


def test_committed_outputs_are_clean(notebook, path):
    text = path.read_text()
    assert len(text) < NOTEBOOK_LIMIT
    assert not re.search(r"(/home/|/root/|/tmp/|/Users/|/work/|[A-Z]:\\\\)", text)
    assert "papermill" not in notebook.metadata and "Warning" not in text
    for cell in code(notebook):
        assert cell.execution_count is None
        assert not [o for o in cell.outputs if o.get("name") == "stderr" or o.output_type == "error"]
        assert all(o.get("execution_count") is None for o in cell.outputs)


def test_all_know_the_run_folder():
    assert all("run_dir" in parameters_of(p) for p in PATHS)
    assert {"checkpoint", "episodes"} <= parameters_of(PATHS[0])


# --- rovers beside this machine ---


def test_rovers_are_drawn(tmp_path):
    """The cells that draw, without those that measure here: the demo executes these."""
    policy = {"latency_p50_ms": 60.0, "latency_p95_ms": 61.0, "latency_p99_ms": 62.0, "n": 16, "mode": "static"}
    series = [{"t_s": t_s, "artifacts": {"policy": policy}} for t_s in (1.0, 2.0)]
    metrics = {"artifacts": {"policy": policy}, "main": "policy", "series": series}
    run_dir, fetched = tmp_path / "demo", tmp_path / "rovers"
    for folder in (run_dir, fetched):
        folder.mkdir()
        write_stage(folder / "benchmark-rover1.json", "benchmark", params={}, metrics=metrics)
    (fetched / "benchmark-rover2.json").write_text("{")
    names = {"run_dir": run_dir, "fetched": fetched}
    cells = {c.id: c.source for c in nbformat.read(PATHS[4], as_version=4).cells}
    for cell in ("imports", "latency", "rovers", "soak"):
        exec(cells[cell], names)
    text = str(names["benchmarks"].table())
    assert re.search(r"rover1 +static, another +60.0 ", text) and "1 file is left out:\nbenchmark-rover2.json: " in text
    assert {p.stem for p in (run_dir / "figures").glob("*.png")} == {"05_latency", "05_soak"}


# --- executing and publishing ---


def written(folder, name, *cells):
    """A small notebook: cells are (id, source) or (id, source, outputs)."""
    made = nbformat.v4.new_notebook(metadata={"language_info": {"name": "python"}})
    for cell_id, source, *outputs in cells:
        cell = nbformat.v4.new_code_cell(source, outputs=outputs[0] if outputs else [], id=cell_id)
        if cell_id == "parameters":
            cell.metadata["tags"] = ["parameters"]
        made.cells.append(cell)
    folder.mkdir(exist_ok=True)
    nbformat.write(made, folder / f"{name}.ipynb")


@pytest.fixture
def one_notebook(monkeypatch, tmp_path):
    for module in (runs, publish):
        monkeypatch.setattr(module, "NAMES", ("01_load",))
    return tmp_path / "notebooks"


@pytest.mark.slow
def test_a_run_fills_parameters_and_leaves_the_executed_notebook(one_notebook, tmp_path):
    written(
        one_notebook,
        "01_load",
        ("parameters", 'run_dir = "."  # here\nworlds = 1  # count'),
        ("work", "import pathlib, sys\npathlib.Path(run_dir, 'made').write_text(f'{worlds} {sys.executable}')"),
    )
    folder = runs.run("ck", "episodes", "mine", runs_dir=tmp_path / "runs", notebooks=one_notebook, worlds=7)
    assert (folder / "made").read_text() == f"7 {sys.executable}"
    assert {p.name for p in folder.iterdir()} == {"made", "01_load.ipynb"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("source", "words"),
    [
        (
            "from rover_lib.onboard.errors import EpisodeError\nraise EpisodeError('x: empty; record again')",
            r"^01_load.ipynb, cell \d: x: empty; record again$",
        ),
        ("1 / 0", r"^01_load.ipynb, cell \d: ZeroDivisionError: division by zero; .*--debug"),
    ],
)
def test_a_failing_cell_is_one_sentence_and_no_file(one_notebook, tmp_path, source, words):
    written(one_notebook, "01_load", ("parameters", 'run_dir = "."  # here'), ("work", source))
    with pytest.raises(runs.NotebookError, match=words):
        runs.run("ck", "episodes", "mine", runs_dir=tmp_path / "runs", notebooks=one_notebook)
    assert not (tmp_path / "runs" / "mine").exists()


def test_what_a_run_was_not_asked_to_know_is_refused(one_notebook, tmp_path):
    written(one_notebook, "01_load", ("parameters", 'run_dir = "."  # here'))
    with pytest.raises(runs.NotebookError, match=r"no notebook has a parameter \['wrlds'\]"):
        runs.run("ck", "episodes", runs_dir=tmp_path, notebooks=one_notebook, wrlds=1)
    with pytest.raises(runs.NotebookError, match="plain folder name"):
        runs.run("ck", "episodes", "../up", runs_dir=tmp_path, notebooks=one_notebook)


OF_ARTIFACTS = ("load.json", "run.json", "report.html", "arm.json", "drive.json", "06_arm.ipynb", "07_drive.ipynb")
OF_ARTIFACTS += ("policy_static.pt", "policy_static.onnx.zip")
OF_OTHERS = ("benchmark-pi.json", "best_model.pth", "episodes/frame.jpg")


@pytest.fixture
def old_run(one_notebook, tmp_path):
    """A run of the name `mine`, with a checkpoint and recordings in its folder, as the demo's."""
    written(one_notebook, "01_load", ("parameters", 'run_dir = "."  # here'))
    folder = tmp_path / "runs" / "mine"
    for name in (*OF_ARTIFACTS, *OF_OTHERS, "figures/01_old.png"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text("old")
    return folder


def contents(folder):
    return {str(p.relative_to(folder)): p.read_text() for p in folder.rglob("*") if p.is_file()}


def run_with(monkeypatch, notebooks, folder, execute):
    monkeypatch.setattr(runs, "_execute", execute)
    return runs.run("ck", "episodes", folder.name, runs_dir=folder.parent, notebooks=notebooks)


def whole(source, folder, given, bars):
    assert (folder / "benchmark-pi.json").read_text() == "old"  # for notebook 05
    write_stage(folder / "load.json", "load", params=given, metrics={})
    (folder / "01_load.ipynb").write_text(f"ran in {folder}")
    (folder / "policy_static.pt").write_text("new")
    (folder / "figures").mkdir()
    (folder / "figures" / "01_new.png").write_text("new")


@pytest.mark.parametrize("error", [runs.NotebookError("no such checkpoint"), KeyboardInterrupt()], ids=repr)
def test_a_run_that_does_not_end_costs_nothing_of_the_last_one(one_notebook, old_run, monkeypatch, error):
    def ends_early(source, folder, given, bars):
        whole(source, folder, given, bars)
        raise error

    before = contents(old_run)
    with pytest.raises(type(error)):
        run_with(monkeypatch, one_notebook, old_run, ends_early)
    assert contents(old_run) == before
    kept = contents(old_run.parent / ".mine.new")
    assert kept["policy_static.pt"] == "new" and sorted(p.name for p in old_run.parent.iterdir())[1:] == ["mine"]
    # the same command goes on there, and with another checkpoint it begins anew
    assert run_with(monkeypatch, one_notebook, old_run, lambda *args: pytest.fail("it began again")) == old_run
    assert contents(old_run)["policy_static.pt"] == "new" and [p.name for p in old_run.parent.iterdir()] == ["mine"]
    with pytest.raises(type(error)):
        run_with(monkeypatch, one_notebook, old_run, ends_early)
    monkeypatch.setattr(runs, "_execute", lambda *args: (_ for _ in ()).throw(error))
    with pytest.raises(type(error)):
        runs.run("other", "episodes", "mine", runs_dir=old_run.parent, notebooks=one_notebook)
    assert [p.name for p in old_run.parent.iterdir()] == ["mine"]


def test_root_learns_at_once_that_it_may_load_no_artifact(one_notebook, old_run, monkeypatch):
    monkeypatch.delenv("ROVER_AS_ROOT")
    monkeypatch.setattr("os.geteuid", lambda: 0)
    with pytest.raises(runs.RoverError, match="root does not load artifacts"):
        run_with(monkeypatch, one_notebook, old_run, lambda *args: pytest.fail("it began"))


def test_a_whole_run_takes_the_place_of_the_last_one(one_notebook, old_run, monkeypatch):
    assert run_with(monkeypatch, one_notebook, old_run, whole) == old_run
    after = contents(old_run)
    made = {"load.json", "01_load.ipynb", "policy_static.pt", "figures/01_new.png"}
    assert set(after) == made | set(OF_OTHERS)  # what belongs to the old artifacts is gone
    assert after["policy_static.pt"] == "new" and all(after[name] == "old" for name in OF_OTHERS)
    assert after["01_load.ipynb"] == f"ran in {old_run}" and f'"run_dir": "{old_run}"' in after["load.json"]
    assert [p.name for p in old_run.parent.iterdir()] == ["mine"]


def test_what_says_how_a_student_was_taught_outlives_a_run_of_it(one_notebook, old_run, monkeypatch):
    """A student's distill.json is of its checkpoint; a teacher's students.json is of its old artifact."""
    for stage in ("distill", "students"):
        write_stage(old_run / f"{stage}.json", stage, params={}, metrics={})
    run_with(monkeypatch, one_notebook, old_run, whole)
    assert (old_run / "distill.json").exists() and not (old_run / "students.json").exists()


def test_what_is_removed_of_the_last_run_is_never_put_back(one_notebook, old_run, monkeypatch):
    """A kill while it is removed left a part of it, which the next run put back into the whole new one."""
    rmtree = shutil.rmtree

    def removing(path, **options):
        assert not old_run.with_name(".mine.old").exists()
        rmtree(path, **options)

    monkeypatch.setattr(shutil, "rmtree", removing)
    run_with(monkeypatch, one_notebook, old_run, whole)


def stream(text, name="stdout"):
    return nbformat.v4.new_output("stream", name=name, text=text)


def test_publishing_takes_outputs_without_counts_and_noise(one_notebook, tmp_path):
    written(one_notebook, "01_load", ("parameters", "a = 1  # one"), ("work", "print(a)\na"))
    shown = nbformat.v4.new_output("execute_result", data={"text/plain": "1"}, execution_count=3)
    ran = ("work", "print(a)\na", [stream("1\n"), stream("noise", "stderr"), shown])
    written(tmp_path / "run", "01_load", ("parameters", "a = 1  # one"), ("injected", "a = 2"), ran)
    (path,) = publish.publish(tmp_path / "run", one_notebook)
    parameters, work = nbformat.read(path, as_version=4).cells
    assert parameters.source == "a = 1  # one"
    assert [o.output_type for o in work.outputs] == ["stream", "execute_result"]
    assert work.outputs[1].execution_count is None


def test_publishing_is_of_the_notebooks_that_are_named(one_notebook, tmp_path):
    for name in ("01_load", "06_arm"):
        written(one_notebook, name, ("work", "print(1)"))
        written(tmp_path / "run", name, ("work", "print(1)", [stream("1\n")]))
    assert [p.stem for p in publish.publish(tmp_path / "run", one_notebook, ("06_arm",))] == ["06_arm"]
    assert not nbformat.read(one_notebook / "01_load.ipynb", as_version=4).cells[0].outputs


def test_publishing_refuses_paths_and_changed_cells(one_notebook, tmp_path):
    written(one_notebook, "01_load", ("work", "print(1)"))
    before = (one_notebook / "01_load.ipynb").read_text()
    written(tmp_path / "run", "01_load", ("work", "print(1)", [stream(f"{tmp_path}/run/x")]))
    with pytest.raises(runs.NotebookError, match="print names"):
        publish.publish(tmp_path / "run", one_notebook)
    written(tmp_path / "run", "01_load", ("work", "print(2)", [stream("2")]))
    with pytest.raises(runs.NotebookError, match="not what was executed"):
        publish.publish(tmp_path / "run", one_notebook)
    assert (one_notebook / "01_load.ipynb").read_text() == before


def test_publishing_leaves_the_json_behind_the_outputs(one_notebook, tmp_path):
    written(one_notebook, "01_load", ("work", "print(1)"))
    written(tmp_path / "mine", "01_load", ("work", "print(1)", [stream("1\n")]))
    inputs = {f"frame_{i:06d}.jpg": "0" * 64 for i in range(1000)}
    given = {"checkpoint": tmp_path / "mine" / "best_model.pth"}
    write_stage(tmp_path / "mine" / "load.json", "load", params=given, metrics={"mae": [1 / 3]}, inputs=inputs)
    (tmp_path / "mine" / "other.json").write_text("{}")
    _, path = publish.publish(tmp_path / "mine", one_notebook, ("01_load",))
    assert path == tmp_path / "results" / "mine" / "load.json"
    assert [p.name for p in path.parent.iterdir()] == ["load.json"]
    content = read_stage(path, "load")
    assert content["params"] == {"checkpoint": "best_model.pth"} and content["metrics"] == {"mae": [0.333333]}
    assert list(content["inputs"]) == ["1000 files"]
    write_stage(tmp_path / "mine" / "load.json", "load", params={}, metrics={"note": f"see {tmp_path}/x"})
    with pytest.raises(runs.NotebookError, match="shows a path of this machine"):
        publish.publish(tmp_path / "mine", one_notebook, ("01_load",))
    assert read_stage(path, "load") == content


def test_committed_results_are_small_and_show_no_path():
    assert set(RESULTS_OF) == {*NAMES, *AFTERWARDS}
    texts = [p.read_text() for p in (NOTEBOOKS.parent / "results").rglob("*.json")]
    assert not [t for t in texts if publish.ABSOLUTE.search(t)]
    assert sum(len(t) for t in texts) < 1_000_000


def test_what_was_opened_must_not_have_changed(tiny, tiny_file, tmp_path, monkeypatch):
    with pytest.raises(runs.RoverError, match="stage 'load'"):
        session.open_run(tmp_path)
    report = {"sha256": "another", "macs_by_block": {"head": 1}}
    given = {"checkpoint": str(tiny_file), "episodes": "episodes"}
    write_stage(tmp_path / "load.json", "load", params=given, metrics={"checkpoint": report, "split": {}}, inputs={})
    layout = SimpleNamespace(words=lambda: {})
    recordings, parts = SimpleNamespace(root="episodes", layout=layout), SimpleNamespace(episodes={})
    monkeypatch.setattr(session, "load", lambda *paths: session.Opened(tiny, recordings, parts))
    with pytest.raises(runs.RoverError, match="is not what notebook 01 loaded"):
        session.open_run(tmp_path)
    report["sha256"] = tiny.sha256
    write_stage(tmp_path / "load.json", "load", params=given, metrics={"checkpoint": report, "split": {}}, inputs={})
    assert session.open_run(tmp_path).checkpoint is tiny
    parts.episodes["held_out"] = ["another"]
    with pytest.raises(runs.RoverError, match="other episodes"):
        session.open_run(tmp_path)


def test_nobody_watches_a_test(monkeypatch):
    monkeypatch.delenv("JPY_SESSION_NAME", raising=False)
    monkeypatch.setenv(runs.TTY_VARIABLE, "")
    assert progress.notebook_bar() is progress.silent


# --- turning parameters ---

TURNED = {
    "02_calibrate": ("calibrate", {"samples": 7, "seed": 3, "smooth": 0.7}),
    "03_quantize": (
        "quantize",
        {
            "scheme": "affine", "observer": "percentile", "percentile": 99.5, "float_blocks": ["backbone.stem"],
            "modes": ["mixed"], "choosing_frames": 2,
        },
    ),
    "04_compare": ("compare", {"held_out_frames": 4, "worlds": 1}),
    "05_benchmark": (f"benchmark-{runs.socket.gethostname()}", {"iterations": 3, "threads": 1}),
}  # fmt: skip


@pytest.fixture(scope="module")
def turned(demo_run, tmp_path_factory):
    """A copy of the demo's run in which each parameter of notebooks 02 to 05 was turned; 02 has a kernel."""
    runs_dir = tmp_path_factory.mktemp("runs")
    (runs_dir / "demo").symlink_to(demo_run)
    folder = copy_run("demo", "copy", runs_dir)
    for name, (_, given) in TURNED.items():
        (runs.execute if name == "02_calibrate" else run_cells)(name, folder, **given)
    return folder


def test_none_of_their_parameters_is_left_out():
    """Notebook 05's `rovers`, a folder, is test_rovers_are_drawn's."""
    for name, (_, given) in TURNED.items():
        assert given.keys() == parameters_of(NOTEBOOKS / f"{name}.ipynb") - {"run_dir", "rovers"}


def test_each_parameter_that_is_turned_is_seen_in_the_json(turned):
    found = {stage: json.loads((turned / f"{stage}.json").read_text()) for stage, _ in TURNED.values()}
    assert found["calibrate"]["params"] == {"samples": 7, "seed": 3, "smooth": 0.7}
    assert found["calibrate"]["metrics"]["samples"] == 7
    schemes = {mode: made.get("scheme") for mode, made in found["quantize"]["metrics"]["modes"].items()}
    assert schemes.keys() == {"fp32", "static", "mixed"} and schemes["mixed"]["float_blocks"] == ["backbone.stem"]
    for key, value in {"kind": "affine", "observer": "percentile", "percentile": 99.5, "smooth": 0.7}.items():
        assert schemes["static"][key] == schemes["mixed"][key] == value
    assert found["quantize"]["params"]["scheme"] == "affine" and found["quantize"]["params"]["modes"] == ["mixed"]
    assert {p.name for p in turned.glob("policy_*.pt")} == {f"policy_{mode}.pt" for mode in schemes}
    compared = found["compare"]["metrics"]
    assert (compared["frames"], compared["fp32"]["trials"]) == (4, 1) and compared["modes"].keys() == {
        "static",
        "mixed",
    }
    timed = found[TURNED["05_benchmark"][0]]
    assert timed["params"]["threads"] == 1 and timed["metrics"]["artifacts"]["static"]["n"] == 3
    assert run_report.write(turned)["metrics"]["modes"]


def test_the_batch_of_the_docs_runs(demo_run, tmp_path, monkeypatch, capsys):
    """As it stands in docs/notebooks.md, up to executing: `turned` executes the same notebooks in such a copy."""
    (code,) = re.findall(
        r"^```python\n(.*?)^```", (NOTEBOOKS.parent / "docs" / "notebooks.md").read_text(), re.M | re.S
    )

    def execute(name, folder, **given):
        assert given.keys() <= parameters_of(NOTEBOOKS / f"{name}.ipynb")
        return folder / f"{name}.ipynb"

    monkeypatch.setattr(runs, "execute", execute)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "demo").symlink_to(demo_run)
    monkeypatch.chdir(tmp_path)
    exec(code, {})
    assert len(re.findall(r"^\{.*\} \d+\.\d\d \d+\.\d\d % off$", capsys.readouterr().out, re.M)) == 3


def test_an_unknown_parameter_is_refused_before_anything_runs(tmp_path):
    began = time.monotonic()
    with pytest.raises(runs.NotebookError, match=r"03_quantize.ipynb has no parameter shape; known are .*'scheme'"):
        runs.execute("03_quantize", tmp_path, shape="affine")
    assert time.monotonic() - began < 2

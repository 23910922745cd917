"""A run is opened as a copy: what is executed again there leaves the run as it was, and parameters act."""

import ast
from functools import partial

import nbformat
import papermill
import pytest

from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.params import params
from rover_lib.workshop.run import run as runs
from rover_lib.workshop.run.copy_run import copy_run


def test_a_copy_has_what_the_run_made_and_leaves_the_run_alone(tmp_path):
    made = ("01_load.ipynb", "policy_static.pt", "benchmark-pi.json", "figures/01_faults.png")
    for name in (*made, "best_model.pth"):
        (tmp_path / "demo" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "demo" / name).write_text("whole")
    copy = copy_run("demo", "try1", tmp_path)
    assert {str(p.relative_to(copy)) for p in copy.rglob("*.*")} == set(made)
    (copy / "policy_static.pt").write_text("turned")
    assert copy_run("demo", "try1", tmp_path) == copy  # opened again, not made anew
    assert [(f / "policy_static.pt").read_text() for f in (copy, tmp_path / "demo")] == ["turned", "whole"]
    (tmp_path / "taken").mkdir()
    for name, other in (("dmo", ""), ("demo", "demo"), ("demo", "taken")):
        with pytest.raises(RoverError):
            copy_run(name, other, tmp_path)


@pytest.mark.parametrize("name", runs.NAMES + runs.AFTERWARDS)
def test_one_cell_sets_each_parameter_of_a_copy_and_others_read_it(name, tmp_path, monkeypatch):
    """A cell that papermill adds below it would take back what a person turns in JupyterLab, silently."""
    monkeypatch.setattr(papermill, "execute_notebook", partial(papermill.execute_notebook, prepare_only=True))
    (tmp_path / "demo").mkdir()
    (tmp_path / "demo" / "01_load.ipynb").touch()
    known = {}
    for parameter, literal, _ in runs.parameters_in(runs.NOTEBOOKS / f"{name}.ipynb"):
        known[parameter] = ast.literal_eval(literal)
        if place := runs.IN_PARAMS.get(parameter):  # what is committed is params.yml's
            assert known[parameter] == params()[place[0]][place[1]]
    turned = {parameter: f"a turned {parameter}" for parameter in known if parameter != "run_dir"}
    runs.execute(name, tmp_path / "demo", **turned)
    notebook = nbformat.read(copy_run("demo", "try1", tmp_path) / f"{name}.ipynb", as_version=4)
    found, read = {}, set()
    for cell in (ast.parse(cell.source) for cell in notebook.cells if cell.cell_type == "code"):
        for line in cell.body:
            if isinstance(line, ast.Assign) and isinstance(line.value, ast.Constant):
                found.setdefault(line.targets[0].id, []).append(line.value.value)
        read |= {node.id for node in ast.walk(cell) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Load)}
    assert [found[parameter] for parameter in known] == [[turned.get(parameter, ".")] for parameter in known]
    assert read >= known.keys()

"""A run is opened as a copy: what is executed again there leaves the run as it was."""

import ast

import nbformat
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

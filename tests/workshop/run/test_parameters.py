"""Parameters that papermill injects: none that is unknown, and none beside the files of another run."""

import re
import sys
from types import SimpleNamespace

import pytest

from rover_lib.onboard.errors import ParamsError
from rover_lib.workshop.run.parameters import check_parameters
from rover_lib.workshop.run.run import AFTERWARDS, NAMES, NOTEBOOKS, parameters_in


def passed(monkeypatch, name, **values):
    """Be in the kernel of a notebook to which papermill has passed values, and return all of its parameters."""
    own = "\n".join(f"{key} = {literal}" for key, literal, _ in parameters_in(NOTEBOOKS / f"{name}.ipynb"))
    injected = "\n".join(["# Parameters", *(f"{key} = {value!r}" for key, value in values.items()), ""])
    cells = ["", "import sys", own, *([injected] if values else [])]
    shell = SimpleNamespace(user_ns={"In": cells})
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))
    given: dict = {}
    exec(own, given)
    del given["__builtins__"]
    return given | {key: value for key, value in values.items() if key in given}


def files(given):
    return {key: given[key] for key in ("run_dir", "checkpoint", "episodes") if given.get(key)}


@pytest.mark.parametrize("name", NAMES + AFTERWARDS)
def test_what_is_passed_must_be_known_and_bring_its_own_files(monkeypatch, name):
    check_parameters(**files(passed(monkeypatch, name)))
    with pytest.raises(ParamsError, match="no parameter checkpont; known are run_dir"):
        check_parameters(**files(passed(monkeypatch, name, checkpont="x", run_dir="mine")))
    others = {key: value for key, value in passed(monkeypatch, name).items() if "../runs/" in str(value)}
    for missing in others:
        here = {key: "mine" for key in others if key != missing} or {"worlds": 3, "samples": 3}
        here = {key: value for key, value in here.items() if key in passed(monkeypatch, name)}
        if not here:
            continue  # its only parameter
        with pytest.raises(ParamsError, match=f"{missing} would be another run's") as e:
            check_parameters(**files(passed(monkeypatch, name, **here)))
        needed = re.findall("[a-z_]+", str(e.value).rpartition("pass ")[2].removesuffix(" too"))
        check_parameters(**files(passed(monkeypatch, name, **here, **dict.fromkeys({*needed} - {"and"}, "mine"))))


def test_what_was_edited_by_hand_is_of_one_run(monkeypatch):
    given = passed(monkeypatch, "01_load")
    assert "demo" in given["run_dir"]
    for edited in ("run_dir", "checkpoint", "episodes"):
        with pytest.raises(ParamsError, match="is still the notebook's default"):
            check_parameters(**files(given) | {edited: "mine"})
    check_parameters(**dict.fromkeys(files(given), "mine"))

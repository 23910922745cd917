"""The two wheels where nothing else of the project is: the rover's in its runtime alone, the workstation's anywhere."""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from rover_lib.onboard import cli as onboard
from rover_lib.onboard.stage import read_stage
from rover_lib.workshop.wheelhouse import REQUIREMENTS, make
from tests.helpers.installed import ELSEWHERE, ROOT, Installed, borrow, required, with_needs

pytestmark = pytest.mark.slow
SCRIPT = "import json; from rover_lib.onboard.params import params; print(json.dumps(params()))"


@pytest.fixture(scope="module")
def rover(tmp_path_factory) -> Installed:
    """One without torch."""
    folder = tmp_path_factory.mktemp("rover")
    return Installed(folder, make(folder / "wheels", only_rover=True).wheel, required("onnxruntime"))


def test_onboard_alone_is_there_with_the_rovers_commands_and_params(rover):
    ours = rover.packages / "rover_lib"
    assert {p.name for p in ours.iterdir()} - {"__pycache__"} == {"__init__.py", "LICENSE", "onboard"}
    done = rover.run("rover", "--help")
    assert done.returncode == 0, done.stderr
    commands = re.findall(r"^  ([a-z-]+) ", done.stdout.partition("Commands:")[2], re.MULTILINE)
    assert commands == sorted(onboard.main.commands) and "drive" in commands
    assert rover.run("rover", "world", "--help").returncode == 2  # a workstation's
    done = rover.run("rover", "view")  # without aiohttp
    assert done.returncode == 1 and done.stderr.startswith("rover: ") and len(done.stderr.splitlines()) == 1
    assert set(json.loads(rover.run("python", "-c", SCRIPT).stdout)) == {"drive", "flight_log", "gates", "view"}

    top, others = rover.packages, {"torch_engine", "server"}  # it lacks what these need
    files = [p.relative_to(top) for p in (top / "rover_lib" / "onboard").rglob("*.py") if p.stem not in others]
    names = [".".join(p.with_suffix("").parts).removesuffix(".__init__") for p in files]
    done = rover.run("python", "-c", f"import importlib; [importlib.import_module(name) for name in {names}]")
    assert done.returncode == 0 and len(names) > 20, done.stderr


def test_a_rover_runs_what_onnx_runtime_runs(rover, onnx_static, artifacts, tmp_path):
    timed, left = ("rover", "benchmark", "--warmup", "1", "--iterations", "2"), tmp_path / "benchmark.json"
    done = rover.run(*timed, "--output", left, onnx_static)  # loaded, so its parity vectors are right
    assert done.returncode == 0, done.stderr
    where = read_stage(left, "benchmark")["env"]
    assert where["torch"] is None and where["onnxruntime"]
    done = rover.run(*timed, artifacts["static"])
    assert done.returncode == 1 and "needs torch" in done.stderr and len(done.stderr.splitlines()) == 1, done.stderr
    lines = rover.run("rover", "--version").stdout.splitlines()
    assert re.fullmatch(r"rover \d+\.\d+\.\d+\+[0-9a-f]{12}", lines[0]) and lines[1].startswith("Python 3.")
    assert lines[2] == "engine qnnpack: torch is not installed"
    assert re.fullmatch(r"engine onnxruntime: onnxruntime \d+\.\d+\.\d+", lines[3])


def lines_of(name: str) -> list[str]:
    """The lines between <!-- name --> and <!-- end --> in docs/install.md."""
    page = (ROOT / "docs" / "install.md").read_text()
    blocks = re.findall(rf"<!-- {name} -->\n(.*?)<!-- end -->", page, re.S)
    return [line.partition(" #")[0].strip() for block in blocks for line in block.splitlines() if line.strip()]


def test_the_small_way(tmp_path, onnx_static):
    """docs/install.md's lines: our wheel is built as pip would, and what it needs of others is linked."""
    command = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", tmp_path]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    made, own, *shown = lines_of("look")
    assert made == "python3 -m venv look" and own == "look/bin/pip install '.[look]'"
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    needs = project["dependencies"] + extras["view"] + extras["look"]
    names = with_needs([re.match(r"[\w.-]+", need)[0] for need in needs if not need.startswith("rover-policy")])
    assert "torch" not in names
    look = Installed(tmp_path, next(tmp_path.glob("*.whl")), names)
    assert not [name for name in ("lab", "tests") if (look.packages / name).exists()]
    about = (next(look.packages.glob("rover_policy-*.dist-info")) / "METADATA").read_text()
    assert "License-Expression: Apache-2.0" in about
    assert {"look", "torch", "view", "workshop"} <= set(re.findall(r"^Provides-Extra: (\w+)$", about, re.M))
    assert look.run("python", "-m", "rover_lib.cli", "--help").returncode == 0
    assert {"calibration", "drive"} <= set(json.loads(look.run("python", "-c", SCRIPT).stdout))
    shutil.copy(onnx_static, tmp_path / "policy_static.onnx.zip")
    for line in shown:
        process = look.start("rover", *line.removeprefix("look/bin/rover ").split(), "--web-port", 0)
        try:
            assert process.stdout.readline().startswith("http://127.0.0.1:"), process.stderr.read()
        finally:
            process.terminate()
            process.communicate()


def test_the_way_by_hand(tmp_path, artifacts):
    """docs/install.md's lines as they stand there, but for what needs root, a car, another machine or minutes."""
    env = ELSEWHERE | {"PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    (tmp_path / ".venv").symlink_to(sys.prefix)
    (tmp_path / "policy_static.pt").symlink_to(artifacts["static"])
    outputs = {}
    for line in lines_of(r"by hand: \w+"):
        if line.startswith("sudo ") or " drive " in line:  # there may be an Arduino on this machine
            continue
        if line.startswith("scp "):
            for path in (tmp_path / "wheels").glob("rover_policy-*.whl"):
                path.rename(tmp_path / path.name)
        elif "--require-hashes" in line:
            assert line.endswith(f"-r {REQUIREMENTS['torch'].name}")
            borrow(next((tmp_path / "rover" / "lib").glob("python3*/site-packages")), required("torch"))
        else:
            own = {"PYTHONPATH": str(ROOT)} if "wheelhouse" in line else {}
            done = subprocess.run(line, shell=True, cwd=tmp_path, env=env | own, capture_output=True, text=True)
            outputs[line] = done
    *made, version, doctor = outputs.values()
    assert not [done.stderr for done in made if done.returncode]
    assert version.stdout.startswith("rover ") and version.returncode == 0
    assert re.search(r"^ok +artifact ", doctor.stdout, re.M), doctor.stdout

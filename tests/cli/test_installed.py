"""The two wheels where nothing else of the project is: the rover's in its runtime alone, the workstation's anywhere."""

import importlib.metadata
import json
import os
import re
import subprocess
import sys
import venv
import zipfile
from pathlib import Path

import pytest

from rover_lib.onboard import cli as onboard
from rover_lib.onboard.stage import read_stage
from rover_lib.workshop.wheelhouse import REQUIREMENTS, make

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parents[2]


def borrow(packages: Path, engine: str = "torch") -> None:
    """What a Pi with that engine has, of this environment, linked: installing torch takes minutes."""
    for name in re.findall(r"^([\w.-]+)==", REQUIREMENTS[engine].read_text(), re.MULTILINE):
        try:
            files = importlib.metadata.distribution(name).files or []
        except importlib.metadata.PackageNotFoundError:  # only another Python needs it
            continue
        for top in {f.parts[0] for f in files} - {"..", "__pycache__"}:
            there, here = Path(str(importlib.metadata.distribution(name).locate_file(top))), packages / top
            if there.exists() and not here.exists():
                here.symlink_to(there)


class Installed:
    """A virtual environment with one wheel of ours, and of others those that a Pi with that engine has."""

    def __init__(self, folder: Path, wheel: Path, engine: str = "torch"):
        self.folder = folder
        venv.create(folder / "venv", with_pip=False, symlinks=True)
        self.bin = folder / "venv" / "bin"
        self.packages = next((folder / "venv" / "lib").glob("python3*/site-packages"))
        borrow(self.packages, engine)
        pip = [sys.executable, "-m", "pip", "--python", self.bin / "python", "install", "--no-deps", "--no-index"]
        subprocess.run([*pip, "--quiet", "--disable-pip-version-check", wheel], check=True)

    def run(self, *command: object) -> subprocess.CompletedProcess:
        # Neither this checkout nor this environment is to be seen.
        env = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL_ENV", "COV"))}
        words = [str(self.bin / str(command[0])), *map(str, command[1:])]
        return subprocess.run(words, capture_output=True, text=True, cwd=self.folder, env=env)


@pytest.fixture(scope="module")
def rover(tmp_path_factory) -> Installed:
    folder = tmp_path_factory.mktemp("rover")
    return Installed(folder, make(folder / "wheels", only_rover=True).wheel)


@pytest.fixture(scope="module")
def rover_without_torch(tmp_path_factory) -> Installed:
    folder = tmp_path_factory.mktemp("onnxruntime")
    return Installed(folder, make(folder / "wheels", only_rover=True).wheel, "onnxruntime")


def test_onboard_alone_is_there(rover):
    ours = rover.packages / "rover_lib"
    assert {p.name for p in ours.iterdir()} - {"__pycache__"} == {"__init__.py", "LICENSE", "onboard"}
    assert rover.run("python", "-c", "import rover_lib.workshop").returncode != 0


def test_help_lists_the_rovers_commands_alone(rover):
    done = rover.run("rover", "--help")
    assert done.returncode == 0, done.stderr
    commands = re.findall(r"^  ([a-z-]+) ", done.stdout.partition("Commands:")[2], re.MULTILINE)
    assert commands == sorted(onboard.main.commands) and "drive" in commands
    for name in commands:
        assert rover.run("rover", name, "--help").returncode == 0
    assert rover.run("rover", "world", "--help").returncode == 2  # a workstation's


def test_inspects_an_artifact(rover, artifacts):
    done = rover.run("rover", "inspect", artifacts["static"], "--json")
    assert done.returncode == 0 and json.loads(done.stdout)["artifact"]["mode"] == "static", done.stderr


@pytest.mark.parametrize(
    ("which", "others"),
    [
        ("rover", {"onnx_engine", "hailo_engine", "server"}),
        ("rover_without_torch", {"torch_engine", "hailo_engine", "server"}),
    ],
)
def test_all_of_it_can_be_imported_but_the_engines_that_it_lacks(which, others, request):
    installed = request.getfixturevalue(which)
    top = installed.packages
    files = [p.relative_to(top) for p in (top / "rover_lib" / "onboard").rglob("*.py") if p.stem not in others]
    names = [".".join(p.with_suffix("").parts).removesuffix(".__init__") for p in files]
    done = installed.run("python", "-c", f"import importlib; [importlib.import_module(name) for name in {names}]")
    assert done.returncode == 0 and len(names) > 20, done.stderr


def test_a_rover_without_torch_runs_what_onnx_runtime_runs_and_says_what_it_lacks(
    rover_without_torch, onnx_static, artifacts, tmp_path
):
    assert rover_without_torch.run("python", "-c", "import torch").returncode != 0
    timed, left = ("rover", "benchmark", "--warmup", "1", "--iterations", "2"), tmp_path / "benchmark.json"
    done = rover_without_torch.run(*timed, "--output", left, onnx_static)  # loaded, so its parity vectors are right
    assert done.returncode == 0, done.stderr
    where = read_stage(left, "benchmark")["env"]
    assert where["torch"] is None and where["onnxruntime"]
    done = rover_without_torch.run(*timed, artifacts["static"])
    assert done.returncode == 1 and "needs torch" in done.stderr and len(done.stderr.splitlines()) == 1, done.stderr


def test_bad_input_is_one_sentence(rover, tiny_file):
    for command in (["log", "nothing.log"], ["inspect", tiny_file], ["release", "stage", "nothing.pt"], ["view"]):
        done = rover.run("rover", *command)
        assert done.returncode == 1 and done.stdout == "", done.stdout
        assert done.stderr.startswith("rover: ") and len(done.stderr.splitlines()) == 1, done.stderr


def test_the_rovers_params_are_what_the_rover_reads(rover):
    script = "import json; from rover_lib.onboard.params import params; print(json.dumps(params()))"
    assert set(json.loads(rover.run("python", "-c", script).stdout)) == {"drive", "flight_log", "gates", "view"}


def test_a_workstations_wheel_finds_its_params_out_of_a_checkout(tmp_path):
    command = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", tmp_path]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as z:
        z.extractall(tmp_path / "installed")
    assert not (tmp_path / "installed" / "lab").exists() and not (tmp_path / "installed" / "tests").exists()
    script = """
import json, sys
sys.path.insert(0, sys.argv[1])
import rover_lib.cli
from rover_lib.onboard.params import params
print(json.dumps([rover_lib.cli.__file__, params()]))
"""
    command = [sys.executable, "-I", "-c", script, tmp_path / "installed"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, check=True)
    file, params = json.loads(done.stdout)
    assert Path(file).is_relative_to(tmp_path)
    assert {"calibration", "quantization", "benchmark", "drive", "flight_log"} <= set(params)
    assert {"steering_mae_pct", "original"} <= set(params["gates"])


def test_says_its_version_pythons_and_the_engines(rover, rover_without_torch):
    lines = rover.run("rover", "--version").stdout.splitlines()
    assert re.fullmatch(r"rover \d+\.\d+\.\d+\+[0-9a-f]{12}", lines[0]) and lines[1].startswith("Python 3.")
    assert re.fullmatch(r"engine qnnpack: torch 2\.8\.0.*", lines[2])
    lines = rover_without_torch.run("rover", "--version").stdout.splitlines()
    assert lines[2] == "engine qnnpack: torch is not installed"
    assert re.fullmatch(r"engine onnxruntime: onnxruntime \d+\.\d+\.\d+", lines[3])


def test_the_way_by_hand(tmp_path, artifacts):
    """docs/install.md's lines as they stand there, but for what needs root, a car, another machine or minutes."""
    page = (ROOT / "docs" / "install.md").read_text()
    blocks = re.findall(r"<!-- by hand: \w+ -->\n(.*?)<!-- end -->", page, re.S)
    lines = [line.strip() for block in blocks for line in block.splitlines() if line.strip()]
    assert len(lines) <= 10
    env = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "VIRTUAL_ENV", "COV"))}
    env["PATH"] = f"{Path(sys.executable).parent}:{env['PATH']}"
    (tmp_path / ".venv").symlink_to(sys.prefix)
    (tmp_path / "policy_static.pt").symlink_to(artifacts["static"])
    outputs = {}
    for line in lines:
        if line.startswith("sudo ") or " drive " in line:  # there may be an Arduino on this machine
            continue
        if line.startswith("scp "):
            for path in (tmp_path / "wheels").glob("rover_policy-*.whl"):
                path.rename(tmp_path / path.name)
        elif "--require-hashes" in line:
            assert line.endswith(f"-r {REQUIREMENTS['torch'].name}")
            borrow(next((tmp_path / "rover" / "lib").glob("python3*/site-packages")))
        else:
            own = {"PYTHONPATH": str(ROOT)} if "wheelhouse" in line else {}
            done = subprocess.run(line, shell=True, cwd=tmp_path, env=env | own, capture_output=True, text=True)
            outputs[line] = done
    *made, version, doctor = outputs.values()
    assert not [done.stderr for done in made if done.returncode]
    assert version.stdout.startswith("rover ") and version.returncode == 0
    assert re.search(r"^ok +artifact ", doctor.stdout, re.M), doctor.stdout
    assert re.fullmatch(r"rover/bin/rover drive policy_static\.pt .*", lines[-1])

"""The main job from a wheel, where no clone is: commands as the ones before printed them, with a space in each name.

`make test` does it with this environment's packages beside the wheel, on a tiny policy; a release in an environment of
its own, from the recordings on. $ROVER_FRESH names one that is there, with the wheel and its extra `workshop`.
"""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from contextlib import suppress
from pathlib import Path

import pytest

from tests.helpers.installed import ELSEWHERE, ROOT, Installed, with_needs
from tests.helpers.recorded import record_drives

pytestmark = pytest.mark.slow
FEW = "--worlds 2 --samples 6 --iterations 2 -p choosing_frames 2 -p held_out_frames 4 -p modes '[static]'"


class Shell:
    """A user's shell in a folder that has nothing of the project; `bin` is on PATH, as in an active environment."""

    def __init__(self, folder: Path, bin_: Path):
        self.folder = folder
        self.env = ELSEWHERE | {"PATH": f"{bin_}:/usr/bin:/bin", "ROVER_AS_ROOT": "1", "HOME": str(folder)}
        self.env |= {"ROVER_CACHE": str(folder / "cache"), "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"}

    def type(self, line: str, code: int = 0) -> str:
        done = subprocess.run(line, shell=True, cwd=self.folder, env=self.env, capture_output=True, text=True)
        assert done.returncode == code, (line, done.stdout, done.stderr)
        return done.stdout + done.stderr

    def starts(self, line: str, sign: str) -> None:
        """Assert that a command that serves a page says so, and end it."""
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        process = subprocess.Popen(f"exec {line}", shell=True, cwd=self.folder, env=self.env, **pipes)
        try:
            assert any(re.search(sign, text) for text in process.stdout), line
        finally:
            process.terminate()
            with suppress(subprocess.TimeoutExpired):
                process.communicate(timeout=30)
            process.kill()  # JupyterLab forgets a signal that comes before its loop runs
            process.communicate()


def wheel(folder: Path) -> Path:
    command = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", folder]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    return next(folder.glob("*.whl"))


def next_lines(output: str) -> list[str]:
    return re.findall(r"^ {2}(\S.*)$", output.partition("\nNext:\n")[2], re.M)


def judge_and_type_next(shell: Shell, run: str) -> None:
    """Make a run, type what its verdict says to type next, and what a car's policy would have been told."""
    output = shell.type(f"{run} --runs-dir 'my runs' {FEW}")
    assert "Verdict: " in output
    shown = shell.folder / "my runs" / "mine"
    assert (shown / "05_benchmark.ipynb").is_file() and not (shell.folder / "notebooks").exists()
    for line in next_lines(output):
        if line.startswith("rover notebooks"):
            shell.starts(line, r"http://localhost:\d+/lab/tree/01_load\.ipynb")
            assert (shell.folder / "my runs" / "mine-copy" / "04_compare.ipynb").is_file()
        elif not line.startswith("rover record"):  # there may be an Arduino on this machine
            shell.type(line)
    artifact = shown / "policy_static.pt"
    told = json.dumps({"rover_artifact": str(artifact.relative_to(shell.folder))})
    assert "playbook: " in shell.type(f"rover playbook deploy -e {shlex.quote(told)} --syntax-check")
    shell.type("rover report 'my runs/mine'")
    assert (shell.folder / "my runs/mine/run.json").is_file()


def test_a_wheel_makes_a_run_in_an_empty_folder(tmp_path, tiny_file):
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    needs = [*extras["dependencies"], *extras["optional-dependencies"]["workshop"]]
    names = with_needs(list({re.match(r"[\w.-]+", need)[0] for need in needs}))
    installed = Installed(tmp_path, wheel(tmp_path), names)
    (installed.bin.parent / "share").symlink_to(Path(sys.prefix, "share"))  # JupyterLab's pages
    (installed.bin / "ansible-playbook").symlink_to(Path(sys.executable).with_name("ansible-playbook"))
    (folder := tmp_path / "an empty folder").mkdir()
    shutil.copy(tiny_file, folder / "my policy.pth")
    record_drives(folder / "my drives", drives=4, frames=40)
    judge_and_type_next(Shell(folder, installed.bin), "rover run 'my policy.pth' 'my drives'")


@pytest.mark.release
def test_in_an_environment_of_its_own_from_recordings_on(tmp_path):
    fresh = Path(os.environ.get("ROVER_FRESH") or tmp_path / "fresh")
    if not fresh.exists():
        uv, python = Path(sys.executable).with_name("uv"), fresh / "bin" / "python"
        subprocess.run([uv, "venv", "--quiet", "--python", sys.executable, fresh], check=True)
        install = [uv, "pip", "install", "--quiet", "--python", python, f"{wheel(tmp_path)}[workshop]"]
        subprocess.run(install, check=True)
    (folder := tmp_path / "an empty folder").mkdir()
    record_drives(folder / "my drives", drives=4, frames=40)
    shell = Shell(folder, fresh.resolve() / "bin")
    output = shell.type("rover export-dataset 'my drives' 'my dataset' --size 128x72")
    train = re.search(r"^next: (.*)$", output, re.M)[1].replace("best_model.pth", "'my policy.pth'")
    assert train == "rover train 'my dataset' 'my policy.pth'"
    shell.type(f"{train} --steps 8")  # which learns nothing, so that it prints no next command
    judge_and_type_next(shell, "rover run 'my policy.pth' 'my dataset' --name mine")
    assert "my policy.onnx" in shell.type("rover export 'my policy.pth' --onnx")
    shell.type("rover export 'my runs/mine' --onnx")
    shell.starts("rover view 'my runs/mine/policy_static.onnx.zip' --web-port 0", r"http://127\.0\.0\.1:\d+/")
    assert "rover_policy-" in shell.type("rover release wheelhouse 'my wheels' --only-rover")
    few = "--runs-dir 'my runs' --steps 4 --batch 2 --device cpu"
    shell.type(f"rover distill 'my policy.pth' 'my drives' --name fast --size 64x36 {few}")
    shell.type(f"rover finetune 'my policy.pth' 'my drives' 'my dataset' --name better {few}")
    assert "recorded: my world" in shell.type("rover world record 'my world' --count 1")
    shell.starts("rover demo --web-port 0", r"http://127\.0\.0\.1:\d+/")

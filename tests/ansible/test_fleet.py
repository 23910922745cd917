"""deploy.yml, rollback.yml and status.yml on three rovers that are folders of this machine, and one that is not there.

What systemd and the service would say comes from a script in their place; models, files and commands are real.
`make test` runs one of the deployments, and `make check-release` the others. `python -m lab pi` arms one car.
"""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from rover_lib.onboard.artifact.manifest import content_hash
from rover_lib.onboard.care.release import Releases
from rover_lib.onboard.stage import sha256_of
from rover_lib.workshop.judge.advice import Names, list_next
from tests.helpers.command import programs

ROOT = Path(__file__).parents[2]
NAMES = ("canary", "second", "third")
BINARY = Path(sys.executable).parent
SYSTEMCTL = """
echo "$*" >> {folder}/asked
case $1 in
  show) cat {folder}/state ;;
  start) [ ! -e {folder}/parity-fails ] ;;
esac
"""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(os.geteuid() != 0, reason="needs root: the playbooks give files to root"),
]


class Fleet:
    def __init__(self, folder: Path):
        self.folder, rover = folder, folder / "home" / "venv" / "bin" / "rover"
        rover.parent.mkdir(parents=True)
        rover.symlink_to(BINARY / "rover")
        programs(folder, {"bin/systemctl": SYSTEMCTL.format(folder=folder), "bin/journalctl": "echo rover: no"})
        self.service("inactive")
        self.lines = {name: f"{name} rover_models={folder}/{name}/models" for name in NAMES}

    def service(self, active: str, text: str = "") -> None:
        (self.folder / "state").write_text(f"LoadState=loaded\nActiveState={active}\nStatusText={text}\n")

    def releases(self, name: str) -> Releases:
        return Releases(self.folder / name / "models", check=lambda name: None)

    def give(self, artifact: Path, *names: str) -> None:
        """Let these rovers use that artifact, as after a deployment."""
        for name in names:
            releases = self.releases(name)
            releases.switch(releases.stage(artifact).name)

    def play(self, book: str, *options: str, **variables: object) -> subprocess.CompletedProcess:
        book = shlex.join(
            [str(BINARY / "ansible-playbook"), "-i", "inventory.ini", f"{ROOT}/ansible/{book}.yml", *options]
        )
        return self.type(book, self.folder, **variables)

    def type(self, line: str, folder: Path, **variables: object) -> subprocess.CompletedProcess:
        """Type a line in a folder, in which the inventory lies."""
        shared = ["[rovers:vars]", "ansible_connection=local", "ansible_become=false"]
        (folder / "inventory.ini").write_text("\n".join(["[rovers]", *self.lines.values(), *shared]) + "\n")
        own = {"ansible_python_interpreter": sys.executable, "rover_home": str(self.folder / "home")}
        given = json.dumps({**own, "rover_ready_s": 2, **variables})
        env = {k: v for k, v in os.environ.items() if not k.startswith(("ANSIBLE", "COV"))}
        env |= {"PATH": f"{self.folder}/bin:{BINARY}:{os.environ['PATH']}", "ANSIBLE_NOCOLOR": "1"}
        env["ANSIBLE_HOME"] = str(self.folder / "ansible")
        line = f"{line} -e {shlex.quote(given)}"
        return subprocess.run(line, shell=True, cwd=folder, capture_output=True, text=True, env=env)

    def deploy(self, artifact: Path, *options: str, **variables: object) -> subprocess.CompletedProcess:
        return self.play("deploy", *options, rover_artifact=str(artifact), **variables)


@pytest.fixture
def fleet(tmp_path) -> Fleet:
    return Fleet(tmp_path)


def test_next_as_it_is_printed_deploys(fleet, artifacts):
    """Typed in a folder outside of a clone; Ansible splits name=value at spaces."""
    folder, run = fleet.folder / "a folder", Path("my runs", "it's mine")
    (folder / run).mkdir(parents=True)
    shutil.copy(artifacts["static"], folder / run)
    judged: dict = {"failed": [], "refused": {"mode": "m"}, "deploy": "static"}
    steps = list_next(judged, "static", {"compare": {"fp32": {"trials": None}}}, Names(str(run), "a.pth", "b"))
    deploy, benchmark, drive = (step["command"] for step in steps)
    done = fleet.type(deploy, folder)
    assert done.stdout.count(": deployed") == len(NAMES), done.stdout + done.stderr
    assert fleet.releases("third").current == content_hash(artifacts["static"])
    for line in (benchmark, drive.replace("rover1", "third")):
        done = fleet.type(f"{line} --list-tasks", folder)
        assert done.returncode == 0 and "play #1" in done.stdout, done.stderr


def row_of(table: subprocess.CompletedProcess, name: str) -> str:
    """A rover's line in what status.yml shows."""
    return next(line for line in table.stdout.splitlines() if f'"{name} ' in line)


def test_deployed_to_all_and_told_by_status(fleet, artifacts):
    """One got other bytes before, one is out of reach, one had it; then one's disk gives others, and one has none."""
    fleet.lines["second"] = "second ansible_connection=ssh ansible_host=127.0.0.1 ansible_port=9"
    fleet.give(artifacts["static"], "third")
    arriving = fleet.folder / "canary" / "models" / "incoming" / sha256_of(artifacts["static"])
    arriving.parent.mkdir(parents=True)
    arriving.write_bytes(artifacts["static"].read_bytes()[:-1] + b"?")  # of a deployment that was cut off
    done = fleet.deploy(artifacts["static"])
    assert done.returncode != 0 and "second: unreachable: " in done.stdout
    assert "canary: deployed" in done.stdout and "third: had it already" in done.stdout, done.stdout
    assert re.search(r"^third .* changed=0 ", done.stdout, re.M), done.stdout
    good = content_hash(artifacts["static"])
    for name in ("canary", "third"):
        status = fleet.releases(name).status()
        assert status["healthy"] and status["current"] == good
        assert status["releases"][0]["origin"].endswith(f":{artifacts['static']}")
        assert not (fleet.folder / name / "models" / "incoming").exists()
    policy = fleet.releases("third").path_of("current")
    policy.write_bytes(policy.read_bytes()[:-1] + b"x")
    fleet.lines["fourth"] = f"fourth rover_models={fleet.folder}/fourth/models"
    table = fleet.play("status")
    row = row_of(table, "canary")
    assert "yes" in row and good[:12] in row and "static" in row
    assert "does not answer" in row_of(table, "second")
    assert "NO" in row_of(table, "third") and "none" in row_of(table, "fourth")


@pytest.mark.release
def test_the_model_before_stays_when_the_canary_fails_drives_or_does_not_get_ready(fleet, artifacts):
    fleet.give(artifacts["static"], *NAMES)
    old = {content_hash(artifacts["static"])}
    done = fleet.deploy(artifacts["fp32"])
    assert "canary: failed: " in done.stdout and "allow it: mode" in done.stdout, done.stdout
    (fleet.folder / "parity-fails").touch()
    done = fleet.deploy(artifacts["mixed"])
    assert "canary: failed: " in done.stdout and "third: untouched: canary failed before" in done.stdout, done.stdout
    (fleet.folder / "parity-fails").unlink()
    for service in (("active", "driving: steering +0.10"), ("activating", "loading")):
        fleet.service(*service)
        assert fleet.deploy(artifacts["mixed"]).returncode != 0
        assert {fleet.releases(n).current for n in NAMES} == old, service

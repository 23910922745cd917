"""deploy.yml, rollback.yml and status.yml on three rovers that are folders of this machine, and one that is not there.

What systemd and the service would say comes from a script in their place; models, files and commands are real.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from rover_lib.onboard.artifact import content_hash
from rover_lib.onboard.release import Releases

ROOT = Path(__file__).parents[2]
NAMES = ("canary", "second", "third")
BINARY = Path(sys.executable).parent
SYSTEMCTL = """#!/bin/sh
echo "$*" >> {folder}/asked
case $1 in
  show) cat {folder}/state ;;
  start) [ ! -e {folder}/parity-fails ] ;;
esac
"""
LOSING = """#!/bin/sh
{rover} "$@"
code=$?
case "$*" in
  *{name}/models*{at}*) touch {mark} ;;
esac
exit $code
"""

# Nobody else may, and a playbook that gives its files to another is not the one that rovers get.
pytestmark = pytest.mark.skipif(os.geteuid() != 0, reason="needs root: the playbooks give files to root")


class Fleet:
    def __init__(self, folder: Path):
        self.folder = folder
        (folder / "bin").mkdir()
        (folder / "home" / "venv" / "bin").mkdir(parents=True)
        (folder / "home" / "venv" / "bin" / "rover").symlink_to(BINARY / "rover")
        for name, text in (
            ("systemctl", SYSTEMCTL.format(folder=folder)),
            ("journalctl", "#!/bin/sh\necho rover: no\n"),
        ):
            (folder / "bin" / name).write_text(text)
            (folder / "bin" / name).chmod(0o755)
        self.service("inactive")
        self.environment = {"ANSIBLE_CONNECTION_PLUGINS": str(Path(__file__).parent / "connections")}
        self.lines = {name: f"{name} rover_models={folder}/{name}/models" for name in NAMES}

    def service(self, active: str, text: str = "") -> None:
        (self.folder / "state").write_text(f"LoadState=loaded\nActiveState={active}\nStatusText={text}\n")

    def unreachable(self, name: str) -> None:
        self.lines[name] = f"{name} ansible_connection=ssh ansible_host=127.0.0.1 ansible_port=9"

    def lost(self, name: str, at: str) -> None:
        """It is out of reach for good, once a file of that name is to travel, or after that rover command."""
        mark, rover = self.folder / "out-of-reach", self.folder / "home" / "venv" / "bin" / "rover"
        mark.unlink(missing_ok=True)
        self.environment |= {"LOST_AT": at, "LOST": str(mark)}
        rover.unlink()
        rover.write_text(LOSING.format(name=name, at=at, mark=mark, rover=BINARY / "rover"))
        rover.chmod(0o755)
        self.lines[name] = f"{name} rover_models={self.folder}/{name}/models ansible_connection=lost"

    def releases(self, name: str) -> Releases:
        return Releases(self.folder / name / "models", check=lambda name: None)

    def play(self, book: str, *options: str, **variables: object) -> subprocess.CompletedProcess:
        inventory = [
            "[rovers]",
            *self.lines.values(),
            "[rovers:vars]",
            "ansible_connection=local",
            "ansible_become=false",
        ]
        (self.folder / "inventory.ini").write_text("\n".join(inventory) + "\n")
        given = {
            "ansible_python_interpreter": sys.executable,
            "rover_home": str(self.folder / "home"),
            "rover_command": str(BINARY / "rover"),
            "rover_packed": str(self.folder / "packed"),
            "rover_ready_s": 2,
            **variables,
        }
        command = [BINARY / "ansible-playbook", "-i", self.folder / "inventory.ini", ROOT / "ansible" / f"{book}.yml"]
        env = {
            **{k: v for k, v in os.environ.items() if not k.startswith(("ANSIBLE", "COV"))},
            "PATH": f"{self.folder}/bin:{BINARY}:{os.environ['PATH']}",
            "ANSIBLE_HOME": str(self.folder / "ansible"),
            "ANSIBLE_NOCOLOR": "1",
            **self.environment,
        }
        command += [*options, "-e", json.dumps(given)]
        return subprocess.run(list(map(str, command)), capture_output=True, text=True, env=env)

    def deploy(self, artifact: Path, *options: str, **variables: object) -> subprocess.CompletedProcess:
        return self.play("deploy", *options, rover_artifact=str(artifact), **variables)


def recap(done: subprocess.CompletedProcess) -> dict[str, dict[str, int]]:
    """Ansible's last lines, by host."""
    rows = done.stdout.partition("PLAY RECAP")[2].splitlines()[1:]
    pairs = {row.partition(":")[0].strip(): row.partition(":")[2].split() for row in rows if ":" in row}
    return {name: {k: int(v) for k, v in (x.split("=") for x in row)} for name, row in pairs.items()}


@pytest.fixture
def fleet(tmp_path) -> Fleet:
    return Fleet(tmp_path)


def test_three_rovers_a_second_time_and_back(fleet, artifacts):
    done = fleet.deploy(artifacts["static"])
    assert done.returncode == 0, done.stdout + done.stderr
    first = content_hash(artifacts["static"])
    for name in NAMES:
        assert fleet.releases(name).status()["current"] == first
        assert f"{name}: deployed" in done.stdout
        assert not (fleet.folder / name / "incoming").exists()
    again = fleet.deploy(artifacts["static"])
    assert again.returncode == 0 and "canary: had it already" in again.stdout, again.stdout
    assert {name: row["changed"] for name, row in recap(again).items()} == dict.fromkeys(NAMES, 0)

    second = content_hash(artifacts["mixed"])
    assert fleet.deploy(artifacts["mixed"], "--check").returncode == 0
    assert fleet.releases("third").current == first
    assert fleet.deploy(artifacts["mixed"]).returncode == 0
    assert fleet.releases("third").current == second
    back = fleet.play("rollback", "--limit", "third")
    assert back.returncode == 0, back.stdout
    assert [fleet.releases(n).current for n in NAMES] == [second, second, first]
    nothing = fleet.play("rollback", "--limit", "third")
    assert nothing.returncode != 0 and "there is no release to roll back to" in nothing.stdout


def test_a_broken_rover_stops_the_rest_and_all_are_reported(fleet, artifacts):
    (fleet.folder / "second").mkdir()
    (fleet.folder / "second" / "models").write_text("a disk that is broken")
    done = fleet.deploy(artifacts["static"], rover_batches=[1, 1, 1])
    assert done.returncode != 0
    assert "canary: deployed" in done.stdout and "third: untouched: second failed before" in done.stdout, done.stdout
    assert "second: failed: " in done.stdout
    assert fleet.releases("canary").status()["healthy"]
    assert not (fleet.folder / "third").exists()
    (fleet.folder / "second" / "models").unlink()
    assert fleet.deploy(artifacts["static"], rover_batches=[1, 1, 1]).returncode == 0
    assert all(fleet.releases(n).status()["healthy"] for n in NAMES)


def test_a_canary_that_fails_leaves_all_others_alone(fleet, artifacts):
    assert fleet.deploy(artifacts["static"]).returncode == 0
    (fleet.folder / "parity-fails").touch()
    done = fleet.deploy(artifacts["mixed"])
    assert done.returncode != 0
    assert "canary: failed: " in done.stdout, done.stdout
    assert "second: untouched: canary failed before" in done.stdout and "third: untouched" in done.stdout
    assert {fleet.releases(n).current for n in NAMES} == {content_hash(artifacts["static"])}
    assert all(fleet.releases(n).status()["healthy"] for n in NAMES)


def test_one_that_does_not_answer_is_reported_and_holds_up_no_other(fleet, artifacts):
    fleet.unreachable("second")
    done = fleet.deploy(artifacts["static"])
    assert done.returncode != 0
    assert "canary: deployed" in done.stdout and "third: deployed" in done.stdout, done.stdout
    assert "second: unreachable: " in done.stdout
    table = fleet.play("status")
    assert table.returncode == 0, table.stdout
    rows = {n: next(line for line in table.stdout.splitlines() if f'"{n} ' in line) for n in NAMES}
    assert "does not answer" in rows["second"]
    for name in ("canary", "third"):
        assert "yes" in rows[name] and content_hash(artifacts["static"])[:12] in rows[name] and "static" in rows[name]


@pytest.mark.parametrize("at", ["part-0000", "stage", "prune"])
def test_one_that_is_lost_while_it_is_deployed_to_is_reported_and_stops_the_rest(fleet, artifacts, at):
    fleet.lost("second", at)
    done = fleet.deploy(artifacts["static"], rover_batches=[1, 1, 1])
    assert done.returncode != 0
    assert (fleet.folder / "out-of-reach").exists(), done.stdout
    assert "canary: deployed" in done.stdout and "third: untouched: second failed before" in done.stdout, done.stdout
    assert "second: failed: it does not answer any more" in done.stdout, done.stdout
    assert not (fleet.folder / "third").exists()
    (fleet.folder / "out-of-reach").unlink()
    fleet.lost("second", "never")
    assert fleet.deploy(artifacts["static"], rover_batches=[1, 1, 1]).returncode == 0
    assert all(fleet.releases(n).status()["healthy"] for n in NAMES)


def test_status_says_what_is_wrong(fleet, artifacts):
    assert fleet.deploy(artifacts["static"], "--limit", "canary").returncode == 0
    policy = fleet.releases("canary").policy
    policy.write_bytes(policy.read_bytes()[:-1] + b"x")
    table = fleet.play("status").stdout
    assert "NO" in next(line for line in table.splitlines() if '"canary ' in line), table
    assert "policy.pt is not what policy.pt.sha256 says" in table
    assert "none" in next(line for line in table.splitlines() if '"third ' in line)


def test_a_car_that_drives_is_left_alone_unless_that_is_wanted(fleet, artifacts):
    assert fleet.deploy(artifacts["static"]).returncode == 0
    fleet.service("active", "driving: steering +0.10")
    done = fleet.deploy(artifacts["mixed"])
    assert done.returncode != 0 and "canary is driving: wait until it is disarmed" in done.stdout.replace("\n", " ")
    assert fleet.releases("canary").current == content_hash(artifacts["static"])
    assert fleet.play("rollback", "--limit", "canary").returncode != 0


def test_a_service_that_does_not_get_ready_with_it_has_the_model_before(fleet, artifacts):
    assert fleet.deploy(artifacts["static"], "--limit", "canary").returncode == 0
    fleet.service("activating", "loading")  # and stays so
    done = fleet.deploy(artifacts["mixed"], "--limit", "canary")
    assert done.returncode != 0, done.stdout
    assert fleet.releases("canary").current == content_hash(artifacts["static"])


def test_parts_that_were_damaged_on_the_way_are_sent_again(fleet, artifacts):
    assert fleet.deploy(artifacts["static"], "--limit", "canary").returncode == 0
    packed = json.loads((fleet.folder / "packed" / "release.json").read_text())
    incoming = fleet.folder / "third" / "incoming" / packed["sha256"]
    incoming.mkdir(parents=True)
    for part in (fleet.folder / "packed").glob("part-*"):
        (incoming / part.name).write_bytes(part.read_bytes()[:-1] + b"?")  # flipped on the way
    done = fleet.deploy(artifacts["static"], "--limit", "third")
    assert done.returncode == 0, done.stdout
    assert fleet.releases("third").status()["healthy"]

"""deploy.yml, rollback.yml and status.yml on three rovers that are folders of this machine, and one that is not there.

What systemd and the service would say comes from a script in their place; models, files and commands are real.

Each task on each rover is a process or two: a deployment to three takes 13 seconds on two quiet cores. So what came
before a test is put in place without a playbook, a playbook's run proves all that it can, and `make test` runs one of
these tests; the others are for `make check-release`.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from rover_lib.onboard.artifact.manifest import content_hash
from rover_lib.onboard.care.release import Releases, pack

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
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(os.geteuid() != 0, reason="needs root: the playbooks give files to root"),
]


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
        # The laptop's key, which these rovers know
        key = folder / "laptop"
        subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "", "-f", key], check=True)
        (folder / "signers").write_text(f'rover namespaces="rover-policy" {key.with_suffix(".pub").read_text()}')
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
        return Releases(self.folder / name / "models", check=lambda name: None, signers=self.folder / "signers")

    def given(self, artifact: Path, *names: str) -> None:
        """These rovers use that artifact, as after a deployment."""
        for name in names:
            releases = self.releases(name)
            releases.switch(releases.stage(artifact, unsigned=True).name, unsigned=True)

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
            "rover_signing_key": str(self.folder / "laptop"),
            "rover_signers": str(self.folder / "signers"),
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


def row_of(table: subprocess.CompletedProcess, name: str) -> str:
    """A rover's line in what status.yml shows."""
    assert table.returncode == 0, table.stdout
    return next(line for line in table.stdout.splitlines() if f'"{name} ' in line)


@pytest.fixture
def fleet(tmp_path) -> Fleet:
    return Fleet(tmp_path)


def test_deployed_to_all_and_told_by_status(fleet, artifacts):
    """From nothing, with one out of reach; then one's disk gives other bytes, and one was never deployed to."""
    fleet.unreachable("second")
    done = fleet.deploy(artifacts["static"])
    assert done.returncode != 0
    assert "canary: deployed" in done.stdout and "third: deployed" in done.stdout, done.stdout
    assert "second: unreachable: " in done.stdout
    good = content_hash(artifacts["static"])
    for name in ("canary", "third"):
        status = fleet.releases(name).status()
        assert status["healthy"] and status["current"] == good and status["releases"][0]["signed"]
        assert not (fleet.folder / name / "models" / "incoming").exists()
    policy = fleet.releases("third").policy
    policy.write_bytes(policy.read_bytes()[:-1] + b"x")
    fleet.lines["fourth"] = f"fourth rover_models={fleet.folder}/fourth/models"
    table = fleet.play("status")
    row = row_of(table, "canary")
    assert "yes" in row and good[:12] in row and "static" in row
    assert "does not answer" in row_of(table, "second")
    assert "NO" in row_of(table, "third") and "none" in row_of(table, "fourth")
    assert "policy.pt is not what policy.pt.sha256 says" in table.stdout


@pytest.mark.release
def test_three_rovers_a_second_time_and_back(fleet, artifacts):
    fleet.given(artifacts["static"], *NAMES)
    first, second = content_hash(artifacts["static"]), content_hash(artifacts["mixed"])
    assert fleet.deploy(artifacts["mixed"], "--check").returncode == 0
    assert fleet.releases("third").current == first
    done = fleet.deploy(artifacts["mixed"])
    assert done.returncode == 0, done.stdout + done.stderr
    for name in NAMES:
        assert fleet.releases(name).status()["current"] == second
        assert f"{name}: deployed" in done.stdout
        assert not (fleet.folder / name / "models" / "incoming").exists()
    again = fleet.deploy(artifacts["mixed"])
    assert again.returncode == 0 and "canary: had it already" in again.stdout, again.stdout
    assert {name: row["changed"] for name, row in recap(again).items()} == dict.fromkeys(NAMES, 0)
    back = fleet.play("rollback", "--limit", "third")
    assert back.returncode == 0, back.stdout
    assert [fleet.releases(n).current for n in NAMES] == [second, second, first]
    nothing = fleet.play("rollback", "--limit", "third")
    assert nothing.returncode != 0 and "there is no release to roll back to" in nothing.stdout


@pytest.mark.release
def test_a_rover_that_is_broken_or_lost_stops_the_rest_and_the_next_deployment_heals(fleet, artifacts):
    """Broken, then lost three times, each later in the deployment than before, which goes on where it was."""
    one_by_one = {"rover_batches": [1, 1, 1]}
    (fleet.folder / "second").mkdir()
    (fleet.folder / "second" / "models").write_text("a disk that is broken")
    done = fleet.deploy(artifacts["static"], **one_by_one)
    assert done.returncode != 0
    assert "canary: deployed" in done.stdout and "third: untouched: second failed before" in done.stdout, done.stdout
    assert "second: failed: " in done.stdout
    assert fleet.releases("canary").status()["healthy"]
    assert not (fleet.folder / "third").exists()
    shutil.rmtree(fleet.folder / "second")  # a new card, with nothing on it
    for at in ("policy.pt", "stage", "prune"):
        fleet.lost("second", at)
        done = fleet.deploy(artifacts["static"], **one_by_one)
        assert done.returncode != 0
        assert (fleet.folder / "out-of-reach").exists(), done.stdout
        assert "canary: had it already" in done.stdout, done.stdout
        assert "third: untouched: second failed before" in done.stdout, done.stdout
        assert "second: failed: it does not answer any more" in done.stdout, done.stdout
        assert not (fleet.folder / "third").exists()
    fleet.lost("second", "never")
    assert fleet.deploy(artifacts["static"], **one_by_one).returncode == 0
    assert all(fleet.releases(n).status()["healthy"] for n in NAMES)


@pytest.mark.release
def test_a_canary_that_fails_leaves_all_others_alone(fleet, artifacts):
    fleet.given(artifacts["static"], *NAMES)
    (fleet.folder / "parity-fails").touch()
    done = fleet.deploy(artifacts["mixed"])
    assert done.returncode != 0
    assert "canary: failed: " in done.stdout, done.stdout
    assert "second: untouched: canary failed before" in done.stdout and "third: untouched" in done.stdout
    assert {fleet.releases(n).current for n in NAMES} == {content_hash(artifacts["static"])}
    assert all(fleet.releases(n).status()["healthy"] for n in NAMES)


@pytest.mark.release
def test_a_car_that_drives_is_left_alone_unless_that_is_wanted(fleet, artifacts):
    fleet.given(artifacts["static"], *NAMES)
    fleet.service("active", "driving: steering +0.10")
    done = fleet.deploy(artifacts["mixed"])
    assert done.returncode != 0 and "canary is driving: wait until it is disarmed" in done.stdout.replace("\n", " ")
    assert fleet.releases("canary").current == content_hash(artifacts["static"])
    assert fleet.play("rollback", "--limit", "canary").returncode != 0


@pytest.mark.release
def test_a_service_that_does_not_get_ready_with_it_has_the_model_before(fleet, artifacts):
    fleet.given(artifacts["static"], "canary")
    fleet.service("activating", "loading")  # and stays so
    done = fleet.deploy(artifacts["mixed"], "--limit", "canary")
    assert done.returncode != 0, done.stdout
    assert fleet.releases("canary").current == content_hash(artifacts["static"])


@pytest.mark.release
def test_what_was_damaged_on_the_way_is_sent_again(fleet, artifacts):
    packed = pack(artifacts["static"], fleet.folder / "packed")
    incoming = fleet.folder / "third" / "models" / "incoming" / packed["sha256"]
    incoming.mkdir(parents=True)
    content = (fleet.folder / "packed" / "policy.pt").read_bytes()
    (incoming / "policy.pt").write_bytes(content[:-1] + b"?")  # flipped on the way
    done = fleet.deploy(artifacts["static"], "--limit", "third")
    assert done.returncode == 0, done.stdout
    assert fleet.releases("third").status()["healthy"]


def test_a_fleet_is_not_armed_at_once(fleet):
    done = fleet.play("drive", rover_arm=True)
    assert done.returncode != 0
    assert "rover_arm arms one car, and these are canary, second, third: choose one with --limit" in done.stdout
    assert not (fleet.folder / "asked").exists()  # before anything was asked of systemd


DRIVING = """#!/bin/sh
echo "$*" >> {folder}/rover
case "$*" in
  "arm-car --heartbeat")
    [ $(grep -c heartbeat$ {folder}/rover) -gt 1 ] && echo "disarmed: 600 s" || echo "driving: armed" ;;
esac
"""


@pytest.mark.release
def test_the_model_that_was_checked_is_armed_and_the_laptop_is_heard(fleet, artifacts):
    fleet.given(artifacts["static"], "canary")
    fleet.service("active", "disarmed: waiting for a human to arm it")
    rover = fleet.folder / "home" / "venv" / "bin" / "rover"
    rover.unlink()
    rover.write_text(DRIVING.format(folder=fleet.folder))
    rover.chmod(0o755)
    done = fleet.play("drive", "--limit", "canary", rover_arm=True, rover_fetched=str(fleet.folder))
    assert done.returncode == 0, done.stdout
    doctor, *asked = (fleet.folder / "rover").read_text().splitlines()
    model = content_hash(artifacts["static"])
    assert doctor.startswith("doctor ")
    assert asked == [f"arm-car --yes --model={model} --max-seconds=600 --heartbeat-s=10", *["arm-car --heartbeat"] * 2]
    assert "stop" in (fleet.folder / "asked").read_text().splitlines()[-1]

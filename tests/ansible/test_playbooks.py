"""The playbooks as far as one machine can tell: arguments, units. Nothing outside a temporary folder."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path

import jinja2
import pytest
import yaml
from click.testing import CliRunner

from rover_lib.cli import main
from rover_lib.onboard.drive.watch import PRIORITY
from tests.helpers.command import programs

pytestmark = pytest.mark.slow  # Ansible takes a second to start

ROOT = Path(__file__).parents[2]
ANSIBLE = ROOT / "ansible"
ROLE = ANSIBLE / "roles" / "rover"
DEFAULTS = yaml.safe_load((ROLE / "defaults" / "main.yml").read_text())
DRIVE, CHECK, BENCHMARK, VIEW = (f"rover-{name}.service" for name in ("drive", "check@", "benchmark", "view"))
EXPOSURE = {DRIVE: 20, CHECK: 20, BENCHMARK: 20, VIEW: 25}


def run(*command: object, tmp: Path) -> subprocess.CompletedProcess:
    """Run a program of this Python's environment with a bare environment."""
    program, *arguments = map(str, command)
    env = {"PATH": f"{Path(sys.executable).parent}:/usr/bin:/bin", "HOME": str(Path.home()), "LANG": "C.UTF-8"}
    env |= {"ANSIBLE_HOME": str(tmp), "ANSIBLE_LOCAL_TEMP": f"{tmp}/local", "ANSIBLE_NOCOLOR": "1", "PWD": str(tmp)}
    command = [str(Path(sys.executable).with_name(program)), *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, env=env)


def play_each(tmp_path: Path, cases: list[tuple[str, dict, str]], *options: str) -> None:
    """Assert what the role does with what is given: (task file, variables, words with which it refuses that or "").

    Each case is a machine of one play. facts: what it says of itself. bin: where it finds its commands first.
    """
    hosts = {f"host{i}": {"file": file, **given} for i, (file, given, _) in enumerate(cases)}
    local = {"ansible_connection": "local", "ansible_python_interpreter": sys.executable}
    (tmp_path / "hosts.yml").write_text(json.dumps({"all": {"hosts": hosts, "vars": local}}))
    (tmp_path / "roles").mkdir()
    (tmp_path / "roles" / "rover").symlink_to(ROLE)
    uses = []
    for file in sorted({file for file, *_ in cases}):
        role = {"name": "rover", "tasks_from": file}
        use = {"name": "Use", "when": f"file == '{file}'", "ansible.builtin.include_role": role}
        if file == "main":
            use["vars"] = {"ansible_facts": {key: f"{{{{ facts.{key} }}}}" for key in PI}}
        uses.append(use)
    path = f"{{{{ bin | default('/bin') }}}}:{Path(sys.executable).parent}:/usr/bin:/bin"
    book = {"name": "Test", "hosts": "all", "gather_facts": False, "tasks": uses, "environment": {"PATH": path}}
    (tmp_path / "play.yml").write_text(yaml.safe_dump([book]))
    found = run("ansible-playbook", "-i", tmp_path / "hosts.yml", tmp_path / "play.yml", *options, tmp=tmp_path)
    said = re.findall(r"^(?:fatal|failed): \[(\w+).*?\](.*?)(?=^\w+: \[|^(?:TASK|PLAY) )", found.stdout, re.M | re.S)
    for host, (_, given, words) in zip(hosts, cases, strict=True):
        text = " ".join(" ".join(text for name, text in said if name == host).split())
        assert words in text, (given, found.stdout)
        assert re.search(rf"^{host} .*failed={bool(words):d} ", found.stdout, re.M), (given, found.stdout)
        if "--check" in options:
            assert re.search(rf"^{host} .*changed=0 ", found.stdout, re.M), (given, found.stdout)


# Arguments


def test_the_defaults_are_those_of_the_specs():
    specs = yaml.safe_load((ROLE / "meta" / "argument_specs.yml").read_text())["argument_specs"]
    options = {name: option for s in specs.values() for name, option in s["options"].items()}
    assert {n: o["default"] for n, o in options.items() if not o.get("required")} == DEFAULTS
    assert (DEFAULTS["rover_start_at_boot"], DEFAULTS["rover_while_driving"]) == (False, "refuse")


def test_a_users_path_begins_where_it_is_typed():
    """Ansible looks beside the playbook: `-e rover_car=car.yml` was not found from the folder above."""
    tasks = "".join(path.read_text() for path in (ROLE / "tasks").glob("*.yml"))
    for name in ("rover_artifact", "rover_car", "rover_firmware", "rover_params"):
        assert f"[lookup('ansible.builtin.env', 'PWD'), {name} | expanduser] | path_join" in tasks, name
        assert not re.search(rf"src: \"{{{{ {name} ", tasks)


PI = {
    "architecture": "aarch64", "os_family": "Debian", "distribution": "Debian", "distribution_version": "12.9",
    "distribution_major_version": "12", "python_version": "3.11.2", "memtotal_mb": 7900,
    "mounts": [{"mount": "/", "size_available": 20_000_000_000}],
    "date_time": {"epoch": str(int(time.time())), "iso8601": "now"},
}  # fmt: skip


def test_wrong_arguments_and_machines_are_refused_before_anything_is_done(tmp_path):
    full = {"mounts": [{"mount": "/", "size_available": 900_000_000}]}
    trixie = {"distribution_version": "13.1", "distribution_major_version": "13", "python_version": "3.13.5"}
    machines = [
        (trixie, ""),
        ({"architecture": "armv7l"}, "armv7l"),
        ({"python_version": "3.14.0"}, "Python 3.14.0"),
        (full, "900 MB free"),
        ({"memtotal_mb": 430}, "430 MB of memory"),
        ({"date_time": {"epoch": "1483228800", "iso8601": "2017-01-01T00:00:00Z"}}, "2017-01-01"),
    ]
    cases = [("main", {"facts": PI | facts, "rover_home": str(tmp_path / "none")}, words) for facts, words in machines]
    (tmp_path / "venv").mkdir()
    cases.append(("main", {"facts": PI | full, "rover_home": str(tmp_path)}, ""))  # a card that is full because of us
    values = [
        ("artifact", {"rover_artifact": "nowhere.pt"}),
        ("deploy", {"rover_while_driving": "yes please"}),
        ("drive", {"rover_arm": "maybe"}),
        ("service", {"rover_camera": "/dev/video0\nExecStartPre=+/bin/true"}),
        ("service", {"rover_memory_mb": 0}),  # systemd ignores such a limit: there would be none
        ("system", {"rover_port": '/dev/rover-arduino", RUN+="/bin/true'}),
        ("system", {"rover_usb_ids": ['2341:0043", RUN+="/bin/true']}),
    ]
    cases += [(file, given, "nowhere.pt" if file == "artifact" else next(iter(given))) for file, given in values]
    cases.append(("drive", {"rover_arm": True}, "choose one with --limit"))  # each of these is one of many hosts
    play_each(tmp_path, cases, "--check")  # so that this machine stays as it is in any case


# What must not be stopped or lost


def test_a_car_that_drives_is_not_stopped_unless_that_is_asked_for(tmp_path):
    """Only systemd is asked, and a car may also be armed while the model before is proven."""
    driving, disarmed = "driving: steering +0.10", "disarmed: waiting for a human to arm it"
    rows = [
        ("not_driving", driving, "refuse", "is driving"),
        ("not_driving", driving, "stop", ""),
        ("not_driving", disarmed, "refuse", ""),
        ("rollback", disarmed, "refuse", "is driving"),
        ("rollback", disarmed, "stop", ""),
        ("rollback", disarmed, "stop", '"msg": "no model: deploy one"'),  # what the program says, as the reason
    ]
    cases = []
    for i, (file, text, asked, words) in enumerate(rows):
        folder = tmp_path / str(i)
        says = f"printf 'LoadState=loaded\\nActiveState=active\\nStatusText='; cat {folder}/text"
        rover = f"printf driving > {folder}/text" if i < 5 else "echo 'no model: deploy one' >&2; exit 1"
        programs(folder, {"bin/systemctl": f'echo "$@" >> {folder}/calls\n{says}', "venv/bin/rover": rover})
        (folder / "text").write_text(text)
        given = {"bin": str(folder / "bin"), "rover_home": str(folder), "rover_models": str(folder / "no models")}
        cases.append((file, given | {"rover_while_driving": asked, "rover_ready_s": 2}, words))
    play_each(tmp_path, cases)
    restarted = ["restart rover-drive.service" in (tmp_path / str(i) / "calls").read_text() for i in range(6)]
    assert restarted == [False, False, False, False, True, False]


def test_an_episode_comes_home_and_leaves_the_rover_unless_another_would_be_lost(tmp_path):
    """A Pi without internet and battery may live through the same second twice."""
    name = ".episode_20251007_144013.part"
    rows = [
        ("--remove-files", None, ""),  # like an option of tar
        (name, b"of yesterday", "already, with other content"),
        (name, b"of today", ""),  # a run that was cut off before it removed what it had fetched
    ]
    cases, rovers, homes = [], [], []
    for i, (episode, there, words) in enumerate(rows):
        rovers.append(tmp_path / f"rover{i}" / episode)
        homes.append(tmp_path / f"home{i}" / f"host{i}" / "episodes" / episode)
        for folder, picture in ({rovers[i]: b"of today"} | ({homes[i]: there} if there else {})).items():
            (folder / "frames").mkdir(parents=True)
            (folder / "frames" / "frame_000001.jpg").write_bytes(picture)
        given = {"rover_episode": str(rovers[i]), "rover_fetched": str(tmp_path / f"home{i}")}
        cases.append(("episode", given, words))
    play_each(tmp_path, cases)
    assert [rover.is_dir() for rover in rovers] == [False, True, False]
    came = [[p.read_bytes() for p in home.parent.rglob("*.jpg")] for home in homes]
    assert came == [[b"of today"], [b"of yesterday"], [b"of today"]]


# The units, as they are on a rover


def render(name: str, **given: object) -> str:
    """Fill a template as Ansible does, with the defaults but for what is given."""
    loader = jinja2.FileSystemLoader(ROLE / "templates")
    jinja = jinja2.Environment(loader=loader, trim_blocks=True, autoescape=False)
    jinja.filters["bool"] = lambda value: str(value).lower() in ("true", "yes", "1")  # Ansible's own
    return jinja.get_template(f"{name}.j2").render({**DEFAULTS, "ansible_managed": "Ansible", **given})


@pytest.fixture
def units(tmp_path) -> Path:
    """The units with the defaults, and a rover_home that has something to execute."""
    if not shutil.which("systemd-analyze"):
        pytest.skip("no systemd-analyze: apt install systemd")
    (tmp_path / "venv" / "bin").mkdir(parents=True)
    (tmp_path / "venv" / "bin" / "rover").symlink_to("/bin/true")
    for name in EXPOSURE:
        (tmp_path / name).write_text(render(name, rover_home=tmp_path))
    return tmp_path


def command(unit: str) -> list[str]:
    return shlex.split(re.search("^ExecStart=(.*)", unit, re.M)[1])[1:]


@pytest.mark.parametrize(
    "given",
    [{}, {"rover_record": True, "rover_threads": 2, "rover_gamepad": True, "rover_camera": "csi:1"},
     {"rover_view_interface": "wlan0"}],
)  # fmt: skip
def test_systemd_understands_the_units_and_finds_them_closed_enough(units, given):
    for name, threshold in EXPOSURE.items():
        (units / name).write_text(render(name, rover_home=units, **given))
        for how in (["verify", "--recursive-errors=no"], ["security", "--offline=true", f"--threshold={threshold}"]):
            done = subprocess.run(["systemd-analyze", *how, units / name], capture_output=True, text=True)
            assert done.returncode == 0, done.stderr + done.stdout[-3000:]


def test_no_unit_lets_root_load_an_artifact_and_no_playbook_runs_one_itself(units):
    for name in EXPOSURE:
        text = (units / name).read_text()
        assert "\nUser=rover" in text and "\nUnsetEnvironment=ROVER_AS_ROOT\n" in text and "ROVER_AS_ROOT=" not in text
    tasks = "".join(p.read_text() for p in (ROLE / "tasks").glob("*.yml"))
    assert "current/policy.pt" not in tasks and "--sandboxed, verify]" in tasks
    drive = (ROLE / "tasks" / "drive.yml").read_text()  # armed is what was checked, and only while the laptop is heard
    steps = "register: rover_meant", "verify]", "--model={{ rover_meant.stat", "--heartbeat-s={{ rover", "--heartbeat]"
    assert (places := [drive.index(step) for step in steps]) == sorted(places)


def test_the_units_say_what_the_command_line_takes(units):
    drive, check, view = (command((units / name).read_text()) for name in (DRIVE, CHECK, VIEW))
    for words in (drive, view):
        assert CliRunner().invoke(main, [*words, "--help"]).exit_code == 0
        known = {o for p in main.commands[words[0]].params for o in p.opts}
        assert {word for word in words if word.startswith("--")} <= known
    assert drive[:2] == ["drive", "--service"] and f"LimitRTPRIO={PRIORITY}\n" in (units / DRIVE).read_text()
    assert check[:-1] == ["release", "--models", "/var/lib/rover/models", "verify"]
    assert drive[drive.index("--view") + 1] == view[view.index("--feed") + 1]


def test_a_benchmark_takes_as_many_minutes_as_are_asked_for(tmp_path):
    """`-e minutes=10`, through the role's default, as a benchmark of a rover gets it."""
    assert command(render(BENCHMARK))[-2:] == ["--iterations", "1000"]
    unit = {"src": str(ROLE / "templates" / "rover-benchmark.service.j2"), "dest": str(tmp_path / "unit")}
    play = {"hosts": "localhost", "gather_facts": False, "vars_files": [str(ROLE / "defaults" / "main.yml")]}
    (tmp_path / "play.yml").write_text(json.dumps([play | {"tasks": [{"ansible.builtin.template": unit}]}]))
    done = run(
        "ansible-playbook", "-i", "localhost,", "-c", "local", tmp_path / "play.yml", "-e", "minutes=10", tmp=tmp_path
    )
    assert done.returncode == 0, done.stdout
    words = command((tmp_path / "unit").read_text())
    assert words[-2:] == ["--minutes", "10.0"]
    benchmark = main.commands["benchmark"].make_context(
        "benchmark", [str(ROLE / "README.md"), *words[2:]], resilient_parsing=True
    )
    assert benchmark.params["minutes"] == 10


def test_a_value_in_a_unit_is_one_word_of_its_command():
    words = command(render(DRIVE, rover_camera='/dev/video0 --hz 1\nUser="root"', rover_models="/%h $HOME"))
    assert words[words.index("--camera") + 1] == '/dev/video0 --hz 1\\nUser="root"'
    assert words[2] == "/%%h $$HOME/current/policy.pt"  # which systemd reads as one % and one $


def test_the_service_may_open_what_its_camera_and_its_human_need_and_no_more():
    for camera, gamepad in (("csi:1,shutter=8000", False), ("/dev/video0", True)):
        lines = render(DRIVE, rover_camera=camera, rover_gamepad=gamepad).splitlines()
        assert [f"DeviceAllow=char-{d} rw" in lines for d in ("media", "dma_heap")] == [not gamepad] * 2
        assert ("DeviceAllow=char-input r" in lines) == gamepad == ("SupplementaryGroups=video dialout input" in lines)


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root: the playbook gives files to root")
def test_an_old_boot_loader_is_flashed_at_its_own_speed(tmp_path):
    avrdude = f'echo "$@" >> {tmp_path}/asked\ncase "$*" in *115200*) exit 1 ;; esac'
    systemctl = "[ $1 != is-active ] && printf 'LoadState=loaded\\nActiveState=inactive'"
    programs(tmp_path, {"bin/avrdude": avrdude, "bin/systemctl": systemctl})
    (tmp_path / "rover.hex").touch()
    env = {**os.environ, "PATH": f"{tmp_path}/bin:{os.environ['PATH']}"}
    words = ["-C", ROOT / "firmware", f"--old-file={tmp_path}/rover.hex", f"BUILD={tmp_path}", "PORT=/dev/none"]
    subprocess.run(["make", *words, "flash"], env=env, check=True, capture_output=True)
    given = {"bin": f"{tmp_path}/bin", "rover_home": str(tmp_path), "rover_port": "/dev/none"}
    play_each(tmp_path, [("firmware", given | {"rover_firmware": f"{tmp_path}/rover.hex"}, "")])
    speeds = re.findall(r"-b (\d+)", (tmp_path / "asked").read_text())
    assert speeds == ["115200", "57600"] * 2

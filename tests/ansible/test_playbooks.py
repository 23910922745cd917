"""The playbooks as far as one machine can tell: syntax, lint, arguments, units. Nothing outside a temporary folder."""

import importlib.util
import json
import os
import platform
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
from pty_board import board_of, obedient

from rover_lib.onboard.car.car import Car, yaml_of
from rover_lib.onboard.drive.watch import PRIORITY

pytestmark = pytest.mark.slow  # Ansible takes a second to start

ROOT = Path(__file__).parents[2]
ANSIBLE = ROOT / "ansible"
ROLE = ANSIBLE / "roles" / "rover"
PLAYBOOKS = ["provision", "deploy", "rollback", "status", "benchmark", "drive"]
SPECS = yaml.safe_load((ROLE / "meta" / "argument_specs.yml").read_text())["argument_specs"]
UNITS = ["rover-drive.service", "rover-check@.service", "rover-benchmark.service"]
VIEW = "rover-view.service"
DEFAULTS = yaml.safe_load((ROLE / "defaults" / "main.yml").read_text())


def program(name: str) -> str:
    """Beside this Python, as pip puts it."""
    path = Path(sys.executable).with_name(name)
    assert path.exists(), f"no {name}: pip install -e '.[dev]'"
    return str(path)


def run(*command: object, cwd: Path = ROOT, tmp: Path | None = None) -> subprocess.CompletedProcess:
    """A command with a bare environment, in which a program in tmp/bin comes first."""
    home = {"ANSIBLE_HOME": str(tmp), "ANSIBLE_LOCAL_TEMP": f"{tmp}/local"} if tmp else {}
    env = {
        "PATH": f"{tmp}/bin:{Path(sys.executable).parent}:/usr/bin:/bin",
        "HOME": str(Path.home()),
        "LANG": "C.UTF-8",
        **home,
    }
    return subprocess.run(
        list(map(str, command)), cwd=cwd, capture_output=True, text=True, env={**env, "ANSIBLE_NOCOLOR": "1"}
    )


def play(tmp_path: Path, tasks: list[dict], *options: object, **variables: object) -> subprocess.CompletedProcess:
    """Tasks of the role on this machine, without becoming root. options: of ansible-playbook.

    A host whose variable `bin` names a folder finds its commands there first.
    """
    book = {"name": "Test", "hosts": "all", "connection": "local", "gather_facts": False, "tasks": tasks}
    book["environment"] = {
        "PATH": f"{{{{ bin | default('{tmp_path}/bin') }}}}:{Path(sys.executable).parent}:/usr/bin:/bin"
    }
    (tmp_path / "play.yml").write_text(yaml.safe_dump([book]))
    (tmp_path / "roles").mkdir(exist_ok=True)
    if not (tmp_path / "roles" / "rover").exists():
        (tmp_path / "roles" / "rover").symlink_to(ROLE)
    given = json.dumps({"ansible_python_interpreter": sys.executable, **variables})
    inventory = [] if "-i" in options else ["-i", "localhost,"]
    return run(program("ansible-playbook"), *inventory, tmp_path / "play.yml", *options, "-e", given, tmp=tmp_path)


def entry(name: str) -> dict:
    return {"name": "Use the role", "ansible.builtin.include_role": {"name": "rover", "tasks_from": name}}


def play_each(tmp_path: Path, cases: list[tuple[str, dict, str]], *options: object, facts: bool = False) -> None:
    """Assert what the role does with what is given: (task file, variables, sentence with which it refuses that or "").

    Each case is a machine of one play, as ansible-playbook takes seconds to start. HOST in a sentence is its name.
    facts: what is given as `facts` is what the machine says of itself.
    """
    hosts = {f"host{i}": {"file": file, **given} for i, (file, given, _) in enumerate(cases)}
    local = {"ansible_connection": "local", "ansible_python_interpreter": sys.executable}
    (tmp_path / "hosts.yml").write_text(json.dumps({"all": {"hosts": hosts, "vars": local}}))
    own = {"vars": {"ansible_facts": {name: f"{{{{ facts.{name} }}}}" for name in pi()}}} if facts else {}
    uses = [entry(file) | {"when": f"file == '{file}'"} | own for file in sorted({file for file, *_ in cases})]
    found = play(tmp_path, uses, "-i", tmp_path / "hosts.yml", *options)
    said = re.findall(r"^(?:fatal|failed): \[(\w+).*?\](.*?)(?=^\w+: \[|^(?:TASK|PLAY) )", found.stdout, re.M | re.S)
    for host, (_, given, sentence) in zip(hosts, cases, strict=True):
        words = " ".join(text for name, text in said if name == host).split()
        assert sentence.replace("HOST", host) in " ".join(words), (given, found.stdout)
        assert re.search(rf"^{host} .*failed={bool(sentence):d} ", found.stdout, re.M), (given, found.stdout)
        if "--check" in options:
            assert re.search(rf"^{host} .*changed=0 ", found.stdout, re.M), (given, found.stdout)


def test_syntax(tmp_path):
    books = [ANSIBLE / f"{name}.yml" for name in PLAYBOOKS]
    found = run(program("ansible-playbook"), "-i", "inventory.ini", "--syntax-check", *books, tmp=tmp_path)
    assert found.returncode == 0 and found.stdout.count("playbook: ") == len(books), found.stderr


def test_lint_finds_nothing(tmp_path):
    found = run(program("ansible-lint"), "--offline", "--profile=production", "--strict", "-q", ANSIBLE, tmp=tmp_path)
    assert found.returncode == 0, found.stdout + found.stderr


def test_the_lint_would_find_something(tmp_path):
    (tmp_path / "bad.yml").write_text("- hosts: all\n  tasks:\n    - shell: ls\n")
    found = run(program("ansible-lint"), "--offline", "--profile=production", "bad.yml", cwd=tmp_path, tmp=tmp_path)
    assert found.returncode == 2 and "fqcn" in found.stdout


# Arguments


def test_the_readme_has_the_variables_of_today():
    spec = importlib.util.spec_from_file_location("variables", ANSIBLE / "variables.py")
    variables = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(variables)
    readme = (ANSIBLE / "README.md").read_text()
    assert variables.filled(readme) == readme, "python ansible/variables.py"
    assert variables.table().count("\n| `rover_") == len({name for s in SPECS.values() for name in s["options"]}) > 25


def test_each_default_is_said_once_more_and_the_same():
    options = {name: option for s in SPECS.values() for name, option in s["options"].items()}
    assert {n: o["default"] for n, o in options.items() if not o.get("required")} == DEFAULTS


def test_each_task_file_has_its_arguments_and_uses_no_others():
    files = {p.stem: p.read_text() for p in (ROLE / "tasks").glob("*.yml")}
    parts = {"bring_home", "episode", "not_driving", "restart"}  # of others
    assert set(files) - parts == set(SPECS)
    known = {name for s in SPECS.values() for name in s["options"]}
    for name in set(files) - parts:
        used = set(re.findall(r"\brover_[a-z_]+", files[name])) & known
        assert used <= set(SPECS[name]["options"]), name
    for name in known:
        text = "".join(files.values()) + "".join(p.read_text() for p in ANSIBLE.glob("*.yml"))
        text += "".join(p.read_text() for p in (ROLE / "templates").glob("*.j2"))
        assert re.search(rf"\b{name}\b", text), f"{name} is used nowhere"


def test_wrong_arguments_and_values_that_no_unit_can_have_are_refused_before_anything_is_done(tmp_path):
    cases = [
        ("pack", {}, "missing required arguments: rover_artifact"),
        ("deploy", {"rover_keep": "many"}, "argument 'rover_keep' is of type str and we were unable to convert to int"),
        ("deploy", {"rover_while_driving": "yes please"}, "value of rover_while_driving must be one of: refuse, stop"),
        ("deploy", {"rover_allow": ["torch"]}, "value of rover_allow must be one or more of: mode, chunk, camera"),
        ("service", {"rover_start_at_boot": "perhaps"}, "'rover_start_at_boot' is of type str and we were unable to"),
        ("benchmark", {"rover_soak_minutes": "long"}, "'rover_soak_minutes' is of type str and we were unable to"),
        ("drive", {"rover_arm": "maybe"}, "'rover_arm' is of type str and we were unable to convert to bool"),
    ]
    values = [
        ("service", {"rover_camera": "/dev/video0\nExecStartPre=+/bin/true"}),
        ("service", {"rover_camera": "csi --throttle-limit 1"}),
        ("service", {"rover_models": "/var/lib/rover\nUser=root"}),
        ("service", {"rover_home": "opt"}),
        ("service", {"rover_hz": "30\nUser=root"}),
        ("service", {"rover_memory_mb": "1500M\nUser=root"}),
        ("service", {"rover_memory_mb": 0}),  # systemd ignores such a limit: there would be none
        ("service", {"rover_ready_s": 0}),  # and takes this for no limit
        ("service", {"rover_hz": "nan"}),
        ("service", {"rover_seconds": -600}),
        ("service", {"rover_threads": -1}),
        ("view", {"rover_view_port": 65536}),
        ("system", {"rover_journal_mb": 0}),
        ("deploy", {"rover_keep": 0}),
        ("deploy", {"rover_models": ""}),
        ("system", {"rover_port": '/dev/rover-arduino", RUN+="/bin/true'}),
        ("system", {"rover_usb_ids": ['2341:0043", RUN+="/bin/true']}),
    ]
    cases += [(file, given, next(iter(given))) for file, given in values]
    play_each(tmp_path, cases, "--check")  # so that this machine stays as it is in any case


def test_the_other_checks_of_a_machine_pass_here(tmp_path):
    if not re.search(r'VERSION_ID="1[23]"', Path("/etc/os-release").read_text()):
        pytest.skip("this machine is no Debian 12 or 13, and the checks rightly refuse it")
    here = {"rover_architecture": platform.machine(), "rover_home": str(tmp_path)}
    found = play(tmp_path, [{"name": "Look", "ansible.builtin.include_role": {"name": "rover"}}], **here)
    assert found.returncode == 0 and "changed=0" in found.stdout, found.stdout


def test_an_artifact_that_is_not_there_or_not_fit_does_not_travel(tmp_path, artifacts):
    key = tmp_path / "laptop"
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", "", "-f", key], check=True)
    common, cases = {"rover_signing_key": str(key), "rover_command": program("rover")}, []
    fp32 = str(artifacts["fp32"])
    rows = [("nowhere.pt", [], "nowhere.pt: not found"), (fp32, [], "its mode is fp32"), (fp32, ["mode"], "")]
    for i, (artifact, allow, sentence) in enumerate(rows):
        own = {"rover_artifact": artifact, "rover_allow": allow, "rover_packed": str(tmp_path / f"packed{i}")}
        cases.append(("pack", common | own, sentence))
    play_each(tmp_path, cases)
    assert [p.name for p in tmp_path.glob("packed*")] == ["packed2"]
    assert {"release.json", "policy.pt.sig"} < {p.name for p in (tmp_path / "packed2").iterdir()}


DRIVING = "HOST is driving: wait until it is disarmed"


def stand_in(folder: Path, text: str, rover: str = "") -> dict:
    """The variables of a machine with a systemctl that says what is in folder/text of an active service and notes its
    calls in folder/calls; and with a rover command with this body, or none.
    """
    says = f"printf 'LoadState=loaded\\nActiveState=active\\nStatusText='; cat {folder}/text"
    programs = {"bin/systemctl": f'echo "$@" >> {folder}/calls\n{says}'} | ({"venv/bin/rover": rover} if rover else {})
    for name, body in programs.items():
        (folder / name).parent.mkdir(parents=True)
        (folder / name).write_text(f"#!/bin/sh\n{body}\n")
        (folder / name).chmod(0o755)
    (folder / "text").write_text(text)
    return {"bin": str(folder / "bin"), "rover_home": str(folder), "rover_models": str(folder / "no models")}


def test_a_car_that_drives_is_not_stopped_unless_that_is_asked_for(tmp_path):
    """It is asked of systemd, and no release is opened: there is no rover command that could. A car may also be armed
    while the model before is proven.
    """
    disarmed = "disarmed: waiting for a human to arm it"
    arms = f"printf driving > {tmp_path}"
    rows = [
        ("not_driving", "driving: steering +0.10", "", "refuse", DRIVING),
        ("not_driving", "driving: steering +0.10", "", "stop", ""),
        ("not_driving", disarmed, "", "refuse", ""),
        ("rollback", disarmed, f"{arms}/3/text", "refuse", DRIVING),
        ("rollback", disarmed, f"{arms}/4/text", "stop", ""),
    ]
    cases = [
        (file, stand_in(tmp_path / str(i), text, rover) | {"rover_while_driving": asked, "rover_ready_s": 2}, sentence)
        for i, (file, text, rover, asked, sentence) in enumerate(rows)
    ]
    play_each(tmp_path, cases)
    restarted = ["restart rover-drive.service" in (tmp_path / str(i) / "calls").read_text() for i in range(5)]
    assert restarted == [False, False, False, False, True]


VAR_TMP = Path("/var/tmp")


def left_in_var_tmp(before: set[Path]) -> set[Path]:
    """What is new there and stays: what another run of these tests makes meanwhile goes when that has ended."""
    left, until_s = set(VAR_TMP.iterdir()) - before, time.monotonic() + 60
    while left and time.monotonic() < until_s:
        time.sleep(0.2)
        left &= set(VAR_TMP.iterdir())
    return left


def test_an_episode_comes_home_and_leaves_the_rover_unless_another_would_be_lost(tmp_path):
    """A Pi without internet and battery may live through the same second twice."""
    name = ".episode_20251007_144013.part"
    rows = [
        ("--remove-files", None, ""),  # like an option of tar
        (name, b"of yesterday", f"{name} is here already, with other content"),
        (name, b"of today", ""),  # a run that was cut off before it removed what it had fetched
        (name, "no folder", "no folder"),  # it does not come home
    ]
    cases, rovers, homes, before = [], [], [], set(VAR_TMP.iterdir())
    for i, (episode, there, sentence) in enumerate(rows):
        rovers.append(tmp_path / f"rover{i}" / episode)
        homes.append(tmp_path / f"home{i}" / f"host{i}" / "episodes" / episode)
        content = {rovers[i]: b"of today"} | ({homes[i]: there} if isinstance(there, bytes) else {})
        for folder, picture in content.items():
            (folder / "frames").mkdir(parents=True)
            (folder / "frames" / "frame_000001.jpg").write_bytes(picture)
        if there == "no folder":
            (tmp_path / "no folder").touch()
        home = str(tmp_path / ("no folder" if there == "no folder" else f"home{i}"))
        cases.append(("episode", {"rover_episode": str(rovers[i]), "rover_fetched": home}, sentence))
    play_each(tmp_path, cases)
    assert [rover.is_dir() for rover in rovers] == [False, True, False, True]
    came = [[p.read_bytes() for p in home.parent.rglob("*.jpg")] for home in homes]
    assert came == [[b"of today"], [b"of yesterday"], [b"of today"], []]
    assert [[p.name for p in home.parent.iterdir()] for home in homes[:3]] == [[row[0]] for row in rows[:3]]
    assert not left_in_var_tmp(before)


# Preflight: what a machine says of itself, and what is said of it then


PI = {
    "architecture": "aarch64", "os_family": "Debian", "distribution": "Debian", "distribution_version": "12.9",
    "distribution_major_version": "12", "python_version": "3.11.2", "memtotal_mb": 7900,
    "mounts": [{"mount": "/", "size_available": 20_000_000_000}],
}  # fmt: skip


def pi(**facts: object) -> dict:
    return {**PI, "date_time": {"epoch": str(int(time.time())), "iso8601": "now"}, **facts}


def test_a_machine_that_cannot_be_a_rover_is_told_why(tmp_path):
    full = {"mounts": [{"mount": "/", "size_available": 900_000_000}]}
    trixie = {"distribution_version": "13.1", "distribution_major_version": "13", "python_version": "3.13.5"}
    cases = [
        ({}, ""),
        (trixie, ""),
        ({"architecture": "armv7l"}, "HOST is armv7l, a rover is aarch64: flash the 64-bit Raspberry Pi OS"),
        ({"distribution_version": "11.8", "distribution_major_version": "11"}, "HOST runs Debian 11.8: flash"),
        ({"os_family": "RedHat", "distribution": "Fedora"}, "HOST runs Fedora 12.9: flash Raspberry Pi OS"),
        ({"python_version": "3.9.2"}, "HOST has Python 3.9.2, the engines have wheels for 3.11 to 3.13"),
        ({"python_version": "3.14.0"}, "HOST has Python 3.14.0, the engines have wheels for 3.11 to 3.13"),
        (full, "HOST has 900 MB free on /, 2500 are needed"),
        ({"memtotal_mb": 430}, "HOST has 430 MB of memory, the policy needs 358"),
        ({"date_time": {"epoch": "1483228800", "iso8601": "2017-01-01T00:00:00Z"}}, "thinks that it is 2017-01-01"),
    ]
    nowhere, ours = ({"rover_home": str(tmp_path / home)} for home in ("nothing installed", "installed"))
    (tmp_path / "installed" / "venv").mkdir(parents=True)
    rows = [("main", {"facts": pi(**facts)} | nowhere, sentence) for facts, sentence in cases]
    rows.append(("main", {"facts": pi(**full)} | ours, ""))  # a card that is full because of us
    play_each(tmp_path, rows, "--check", facts=True)


# A run that was cut off before its handlers


def test_what_an_earlier_run_left_to_do_is_done_by_the_next_and_once(tmp_path):
    handlers = [row["name"] for row in yaml.safe_load((ROLE / "handlers" / "main.yml").read_text())]
    begin = next(t for t in yaml.safe_load((ROLE / "tasks" / "system.yml").read_text()) if "notify" in t)
    end = yaml.safe_load((ANSIBLE / "provision.yml").read_text())[0]["post_tasks"]
    tasks = json.loads(json.dumps([begin, begin, *end, begin]).replace("/run/", f"{tmp_path}/"))
    flush = {"name": "Flush", "ansible.builtin.meta": "flush_handlers"}
    book = {"name": "Test", "hosts": "localhost", "connection": "local", "gather_facts": False}
    book["tasks"] = [task for given in tasks for task in (given, flush)]
    book["handlers"] = [{"name": name, "ansible.builtin.debug": {"msg": name}} for name in handlers]
    (tmp_path / "play.yml").write_text(json.dumps([book]).replace('"root"', f'"{Path.home().owner()}"'))
    found = run(program("ansible-playbook"), "-i", "localhost,", tmp_path / "play.yml", tmp=tmp_path)
    ran = re.findall(r"^RUNNING HANDLER \[(.*?)\]", found.stdout, re.MULTILINE)
    later = {"Name the Arduino", "Restart the view"}  # another handler, or view.yml's last task, does that
    assert sorted(ran) == sorted(set(handlers) - later), found.stdout + found.stderr
    assert " changed=1 " in found.stdout and (tmp_path / "rover-provisioning").exists(), found.stdout


# The units, as they are on a rover


def rendered(name: str, **given: object) -> str:
    """A template as Ansible fills it, with the defaults but for what is given."""
    loader = jinja2.FileSystemLoader(ROLE / "templates")
    jinja = jinja2.Environment(loader=loader, trim_blocks=True, autoescape=False)
    jinja.filters["bool"] = lambda value: str(value).lower() in ("true", "yes", "1")  # Ansible's own
    return jinja.get_template(f"{name}.j2").render({**DEFAULTS, "ansible_managed": "Ansible", **given})


@pytest.fixture
def units(tmp_path) -> Path:
    """The service's units with the defaults, and a rover_home that has something to execute."""
    (tmp_path / "venv" / "bin").mkdir(parents=True)
    (tmp_path / "venv" / "bin" / "rover").symlink_to("/bin/true")
    for name in [*UNITS, VIEW]:
        (tmp_path / name).write_text(rendered(name, rover_home=tmp_path))
    return tmp_path


def analyze(*arguments: object) -> subprocess.CompletedProcess:
    """systemd's own judgement; a workstation may run without systemd, .ci/run installs it."""
    if not shutil.which("systemd-analyze"):
        pytest.skip("no systemd-analyze: apt install systemd")
    return run("systemd-analyze", *arguments)


@pytest.mark.parametrize("name", [*UNITS, VIEW])
def test_systemd_understands_the_units(units, name):
    found = analyze("verify", "--man=no", "--recursive-errors=no", units / name)
    assert found.returncode == 0 and str(units) not in found.stderr, found.stderr


def test_systemd_would_not_understand_nonsense(units):
    unit = units / "rover-drive.service"
    unit.write_text(unit.read_text().replace("WatchdogSec=2", "WatchdogSec=soon"))
    assert "rover-drive.service" in analyze("verify", "--man=no", "--recursive-errors=no", unit).stderr


@pytest.mark.parametrize("name", UNITS)
def test_the_sandbox_is_closed_enough(units, name):
    found = analyze("security", "--offline=true", "--threshold=20", "--no-pager", units / name)
    assert found.returncode == 0, found.stdout[-3000:]


@pytest.mark.parametrize("name", UNITS)
def test_no_unit_lets_root_load_an_artifact(units, name):
    text = (units / name).read_text()
    assert "\nUser=rover\n" in text and "\nUnsetEnvironment=ROVER_AS_ROOT\n" in text
    assert (text.count("ROVER_AS_ROOT=") == 0 and "policy.pt" in text) or "verify --confined" in text


def test_no_playbook_runs_an_artifact_itself():
    """Root would: only a unit does, as rover and in the sandbox."""
    tasks = "".join(p.read_text() for p in (ROLE / "tasks").glob("*.yml"))
    for command in ("benchmark", "doctor", "verify"):
        for line in [line for line in tasks.splitlines() if f'rover", {command}' in line or f", {command}," in line]:
            assert "policy.pt" not in line, line
    assert "'benchmark'" not in tasks and "--sandboxed, verify]" in tasks


def test_both_units_have_the_same_sandbox(units):
    """What passes its parity vectors in one must not fail in the other."""

    def settings(name: str) -> set[str]:
        return {line for line in (units / name).read_text().splitlines() if re.match(r"[A-Z]\w+=", line)}

    assert {"DeviceAllow=/dev/vcio rw", "DeviceAllow=/dev/vcio_gencmd rw"} <= settings("rover-drive.service")
    differ = settings("rover-drive.service") ^ settings("rover-check@.service")
    kinds = {line.partition("=")[0] for line in differ}
    assert kinds <= {
        *(
            "Description", "Type", "ExecStart", "ExecStartPre", "RuntimeDirectory", "NotifyAccess",
            "ConditionPathExists", "StartLimitIntervalSec",
        ),
        *("StartLimitBurst", "StateDirectory", "StateDirectoryMode", "WatchdogSec", "WatchdogSignal", "Restart"),
        *("RestartSec", "KillMode", "TimeoutStopSec", "OOMPolicy", "WantedBy"),
        *("LimitRTPRIO", "RestrictRealtime", "SupplementaryGroups", "DeviceAllow", "PrivateDevices"),
    }, kinds  # fmt: skip


def test_a_service_that_records_does_so_in_its_own_folder_and_may_finish(units):
    recording = rendered("rover-drive.service", rover_home=units, rover_record="true", rover_threads=2)
    (units / "rover-drive.service").write_text(recording)
    found = analyze("verify", "--man=no", "--recursive-errors=no", units / "rover-drive.service")
    assert found.returncode == 0 and str(units) not in found.stderr, found.stderr
    line = next(x for x in recording.splitlines() if x.startswith("ExecStart="))
    assert line.endswith(" --threads 2 --record /var/lib/rover-drive/episodes --record-mb 2000")
    assert "StateDirectory=rover-drive\n" in recording and "TimeoutStopSec=90\n" in recording
    assert "--record" not in rendered("rover-drive.service")


def test_the_service_may_have_the_priority_that_it_asks_for():
    """The kernel refuses one above the limit, and the loop would run at ordinary priority without a sound."""
    assert f"LimitRTPRIO={PRIORITY}\n" in rendered("rover-drive.service")


def test_the_service_says_what_the_command_line_takes(units):
    from click.testing import CliRunner

    from rover_lib.cli import main

    line = next(x for x in (units / "rover-drive.service").read_text().splitlines() if x.startswith("ExecStart="))
    arguments = shlex.split(line)[1:]
    assert arguments[:2] == ["drive", "--service"]
    found = CliRunner().invoke(main, [*arguments, "--help"])
    assert found.exit_code == 0, found.output
    drive = main.commands["drive"]
    assert {a for a in arguments if a.startswith("--")} <= {o for p in drive.params for o in p.opts}
    check = next(x for x in (units / "rover-check@.service").read_text().splitlines() if x.startswith("ExecStart="))
    assert shlex.split(check)[1:] == ["release", "--models", "/var/lib/rover/models", "verify", "--confined", "%i"]


def test_the_view_is_closed_enough_and_more_open_only_where_the_owner_names_a_network(units):
    """It serves pages, which no other unit does; so its exposure is above theirs."""
    for interface, allowed in (("", True), ("wlan0", False)):
        (units / VIEW).write_text(rendered(VIEW, rover_home=units, rover_view_interface=interface))
        text = (units / VIEW).read_text()
        assert ("IPAddressDeny=any\nIPAddressAllow=localhost\n" in text) is allowed
        assert text.endswith("WantedBy=multi-user.target") and text.count('--interface "wlan0"') == (not allowed)
        assert analyze("verify", "--man=no", "--recursive-errors=no", units / VIEW).returncode == 0
        found = analyze("security", "--offline=true", "--threshold=25", "--no-pager", units / VIEW)
        assert found.returncode == 0, found.stdout[-3000:]


def test_the_view_is_nobody_who_drives_and_the_drive_is_as_closed_as_before(units):
    view, drive = ((units / name).read_text() for name in (VIEW, "rover-drive.service"))
    assert "\nUser=rover-view\nGroup=rover-view\n" in view and "SupplementaryGroups" not in view
    assert "\nPrivateDevices=yes\n" in view and "DeviceAllow" not in view and "rover-drive" not in view
    for line in ("User=rover", "PrivateNetwork=yes", "IPAddressDeny=any", "RestrictAddressFamilies=AF_UNIX"):
        assert f"\n{line}\n" in drive
    feeds = [
        words[words.index(option) + 1]
        for words, option in (
            (commands(units / VIEW)["ExecStart"], "--feed"),
            (commands(units / "rover-drive.service")["ExecStart"], "--view"),
        )
    ]
    assert feeds[0] == feeds[1] == "/run/rover-view/feed" and "RuntimeDirectory=rover-view\n" in view


def test_the_views_unit_says_what_the_command_line_takes(units):
    from rover_lib.onboard.cli import main

    words = shlex.split(rendered(VIEW, rover_view_interface="wlan0").partition("ExecStart=")[2].splitlines()[0])[1:]
    assert words[0] == "view"
    known = {o for p in main.commands["view"].params for o in p.opts}
    assert {a for a in words if a.startswith("--")} <= known and "--interface" in words


HOSTILE = [
    "/dev/video0 --throttle-limit 1", "/dev/video0\nExecStartPre=+/bin/touch /etc/mine", "/dev/video0\\",
    "%h/video %n %%", "$HOME ${PATH} $$", "\"/dev/video0\" '--record' /", "; /bin/true", "\t\u00fc",
]  # fmt: skip


@pytest.mark.parametrize("value", HOSTILE)
def test_a_value_in_the_unit_is_one_word_of_its_command(units, value):
    """As systemd itself reads it; until then a camera could carry options, and a newline a command for root."""
    given = {"rover_camera": value, "rover_port": value, "rover_home": units, "rover_threads": 2, "rover_record": True}
    unit = units / "rover-drive.service"
    plain = {"rover_camera": "CAMERA", "rover_port": "PORT"}
    unit.write_text(rendered(unit.name, **given | plain))
    expected = [value if word in ("CAMERA", "PORT") else word for word in commands(unit)["ExecStart"]]
    before = commands(unit)["ExecStartPre"]
    unit.write_text(rendered(unit.name, **given))
    assert commands(unit) == {"ExecStart": expected, "ExecStartPre": before}


@pytest.mark.parametrize(("camera", "more"), [("csi", True), ("csi:1,shutter=8000", True), ("/dev/video0", False)])
def test_the_service_of_a_pi_camera_may_use_what_libcamera_needs(camera, more):
    unit = rendered("rover-drive.service", rover_camera=camera)
    assert f"--camera {camera} " in unit.replace('"', "")
    assert [f"DeviceAllow=char-{d} rw" in unit for d in ("video4linux", "media", "dma_heap")] == [True, more, more]


@pytest.mark.parametrize(("firmware", "flashes"), [("4.1.1-gamepad", False), ("4.1.1", True)])
def test_a_board_is_not_flashed_again_for_want_of_a_gamepad(tmp_path, firmware, flashes):
    tasks = yaml.safe_load((ROLE / "tasks" / "firmware.yml").read_text())
    (asks,) = [task["ansible.builtin.command"]["argv"] for task in tasks if "Ask the Arduino" in task["name"]]
    (tmp_path / "car.yml").write_text(yaml_of(Car(human="gamepad")))
    with board_of(answer=obedient, hello=f"<H 4 {firmware} 7 0 e {Car().id}") as board:
        env = {**os.environ, "ROVER_CAR": str(tmp_path / "car.yml")}
        done = subprocess.run([sys.executable, *asks[1:-1], board.port], env=env, capture_output=True, text=True)
    assert bool(done.returncode) == flashes, done.stderr


@pytest.mark.parametrize("gamepad", [False, True])
def test_the_service_may_read_a_gamepad_where_there_is_one(gamepad):
    lines = rendered("rover-drive.service", rover_gamepad=gamepad).splitlines()
    assert ("DeviceAllow=char-input r" in lines) == gamepad
    assert f"SupplementaryGroups=video dialout{' input' * gamepad}" in lines


@pytest.mark.parametrize("name", ["rover-drive.service", "rover-check@.service"])
@pytest.mark.parametrize("value", [v for v in HOSTILE if v.isprintable()])
def test_models_may_be_in_any_folder(units, name, value):
    unit, models = units / name, f"/var/lib/{value}"
    unit.write_text(rendered(name, rover_models=models, rover_home=units))
    words = commands(unit)["ExecStart"]
    assert {models, f"{models}/current/policy.pt"} & set(words)
    assert words[0] == f"{units}/venv/bin/rover"


def commands(unit: Path) -> dict[str, list[str]]:
    """The command lines of a unit, by kind, in words: systemd's own reading, which it prints while it verifies."""
    if not shutil.which("systemd-analyze"):
        pytest.skip("no systemd-analyze: apt install systemd")
    verify = ["systemd-analyze", "verify", "--man=no", "--recursive-errors=no", unit]
    done = subprocess.run(verify, capture_output=True, text=True, env={**os.environ, "SYSTEMD_LOG_LEVEL": "debug"})
    found = re.findall(r"-> (Exec\w+):\n\s+Command Line: (.*)", done.stdout)
    words = {kind: re.findall(r'"(?:[^"\\]|\\.)*"|\S+', line) for kind, line in found}
    assert len(words) == len(found), found
    return {kind: [unquoted(word) for word in line] for kind, line in words.items()}


def unquoted(word: str) -> str:
    """A word as systemd prints it: in C's way if it needs that; $$ is a $ once it is started."""
    text = re.sub(r"\\([$`])", r"\1", word.strip('"') if word[0] != '"' else word[1:-1])
    text = text.encode("latin-1", "backslashreplace").decode("unicode_escape") if "\\" in text else text
    return text.replace("$$", "$")


def test_the_car_does_not_start_by_itself():
    assert DEFAULTS["rover_start_at_boot"] is False and DEFAULTS["rover_arm"] is False
    assert DEFAULTS["rover_while_driving"] == "refuse"

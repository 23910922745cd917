"""What `make pi-fast` makes of what it sees, without a Pi."""

import os
import sys
from types import SimpleNamespace

import pytest

from balloon_world.simulated_arduino import PinEvent
from lab import debian
from lab.params import lab_params
from lab.pi import container, container_run, cut_plays, emulation, playbooks
from lab.pi.container_run import run_container
from lab.pi.emulation import EmulationError
from lab.pi.pulses import moving, stopped
from lab.pi.report import PiReport
from lab.pi.service_proofs import environment, hashed, unit_for
from rover_lib.onboard.stage import read_stage

OUTPUT = """
TASK [Do] ****
ok: [rover1]

PLAY RECAP *********************************************************************
rover1                     : ok=42   changed=20   unreachable=0    failed=0    skipped=7    rescued=0    ignored=0   
rover2                     : ok=2    changed=0    unreachable=1    failed=0    skipped=0    rescued=0    ignored=0   

"""  # noqa: W291, as Ansible says it


# Playbooks


def test_a_recap_is_read_by_host():
    found = playbooks.recap(OUTPUT)
    assert list(found) == ["rover1", "rover2"]
    assert (found["rover1"]["changed"], found["rover1"]["skipped"], found["rover2"]["unreachable"]) == (20, 7, 1)


def test_without_a_recap_nothing_worked():
    assert playbooks.recap("ERROR! the playbook could not be found") == {}
    assert not playbooks.Play("status", 0, 1.0, {}, "").ok
    assert playbooks.Play("status", 0, 1.0, playbooks.recap(OUTPUT), OUTPUT).ok
    assert not playbooks.Play("status", 2, 1.0, playbooks.recap(OUTPUT), OUTPUT).ok


def test_a_play_has_what_is_reported():
    play = playbooks.Play("provision", 0, 12.34, playbooks.recap(OUTPUT), OUTPUT)
    assert play.changed == 20 and len(play.recap_lines) == 2 and play.recap_lines[0].startswith("rover1 ")
    assert play.end.endswith("ok: [rover1]")
    assert play.row()["seconds"] == 12.3


def test_the_inventory_is_the_users_with_other_rovers(tmp_path):
    hosts = [SimpleNamespace(name=f"rover{n}", port=2220 + n, key=tmp_path / "key") for n in (1, 2)]
    text = playbooks.inventory(hosts)
    assert "rover1.local" not in text and "rover2 ansible_host=127.0.0.1 ansible_port=2222" in text
    assert "ansible_pipelining=true" in text and "ControlPersist" in text  # as in inventory.ini
    assert text.index("rover1 ") < text.index("rover2 ") < text.index("[rovers:vars]")


LOSES = """
- hosts: rovers
  connection: local
  gather_facts: false
  tasks:
    - {name: First, ansible.builtin.command: {cmd: touch FOLDER/first, creates: FOLDER/first}, notify: Tell systemd}
    - {name: Nothing, ansible.builtin.meta: noop}
    - {name: Second, ansible.builtin.command: {cmd: touch FOLDER/second, creates: FOLDER/second}}
  handlers:
    - {name: Tell systemd, ansible.builtin.command: touch FOLDER/told}
"""


@pytest.mark.slow  # four plays
def test_what_a_killed_play_leaves_undone_is_found(tmp_path, monkeypatch):
    (tmp_path / "ansible").mkdir()
    (tmp_path / "ansible" / "provision.yml").write_text(LOSES.replace("FOLDER", str(tmp_path)))
    (tmp_path / "handlers.yml").write_text("[{name: Tell systemd}, {name: Restart the view}]")
    monkeypatch.setattr(playbooks, "REPOSITORY", tmp_path)
    monkeypatch.setattr(cut_plays, "HANDLERS", tmp_path / "handlers.yml")

    def show(*command):
        return SimpleNamespace(stdout=f"NeedDaemonReload={'yes' if 'view' in command[-1] else 'no'}\n")

    pi = SimpleNamespace(name="rover1", port=22, key=tmp_path / "key", inside=show)
    found = cut_plays.provision_in_pieces(pi, folder=tmp_path, variables={"ansible_python_interpreter": sys.executable})
    assert found["cut_after"] == ["First", "Second"] and found["changed_after"] == 0
    assert found["undone"] == ["Tell systemd"] and not (tmp_path / "told").exists()
    assert found["stale"] == ["rover-view.service"]


# Another machine's settings


def test_pip_finds_packages_elsewhere_as_it_does_here():
    told = "global.index-url='index:here/simple'\n:env:.find-links='/here'\nglobal.extra-index-url="
    told += "'file:///here index:there/simple'\n:env:.default-timeout='180'\ninstall.user='yes'\n"
    assert container.pip_settings(told).splitlines() == [
        "[global]",
        "cert = /etc/ssl/certs/ca-certificates.crt",
        "index-url = index:here/simple",
        "extra-index-url = index:there/simple",
        "default-timeout = 180",
    ]
    assert "proxy = proxy:3128" in container.pip_settings("", "proxy:3128")


# Beginning


def test_no_artifacts(tmp_path):
    with pytest.raises(EmulationError, match=r"no policy_static.pt and no policy_mixed.pt to deploy; make demo leaves"):
        run_container(tmp_path / "pi-fast.json", tmp_path)
    with pytest.raises(
        EmulationError, match=r"no policy_static.onnx.zip and no policy_fp32.onnx.zip to deploy; rover exp"
    ):
        run_container(tmp_path / "pi-fast.json", tmp_path, engine="onnxruntime")
    assert not (tmp_path / "pi-fast.json").exists()


def test_without_root_it_says_what_it_needs(monkeypatch):
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr(debian, "which", lambda name: None)
    with pytest.raises(EmulationError, match=r"needs root \(and of the Debian packages .*systemd-container.*use sudo"):
        emulation.require()
    monkeypatch.setattr(debian, "which", lambda name: f"/usr/bin/{name}")
    with pytest.raises(EmulationError, match=r"which needs root: use sudo"):
        emulation.require()


def test_as_root_what_is_missing_is_installed(monkeypatch):
    asked = []
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setattr(debian, "which", lambda name: None if name == "ssh" else f"/usr/bin/{name}")
    monkeypatch.setattr(emulation, "install_packages", lambda packages, what: asked.append((packages, what)))
    emulation.require()
    assert asked == [(["openssh-client"], "an emulated Pi")]


# What is installed


def test_what_nobody_vouches_for_is_found(tmp_path):
    site = tmp_path / "opt" / "rover" / "venv" / "lib" / "python3.11" / "site-packages"
    torch = next(iter(hashed(playbooks.REPOSITORY / "requirements_pi.txt")["torch"]))
    versions = {"torch": torch, "numpy": "0.1", "lerobot": "0.4.4", "rover_policy": "0.1", "pip": "23"}
    for name, version in versions.items():
        (site / f"{name}-{version}.dist-info").mkdir(parents=True)
        (site / f"{name}-{version}.dist-info" / "METADATA").write_text(f"Name: {name}\nVersion: {version}\n")
    found = environment(tmp_path)
    assert found["unhashed"] == ["lerobot", "numpy"] and found["lerobot"]
    assert found["missing"] == ["opencv-python-headless", "pyserial"]
    assert {p["name"]: p["from"] for p in found["packages"]}["torch"] == "requirements_pi.txt, by hash"
    assert found["others"] == []
    without = environment(tmp_path, "onnxruntime")
    assert "torch" in without["unhashed"] and without["others"] == ["torch"] and "onnxruntime" in without["missing"]


def test_a_pin_without_a_hash_is_none(tmp_path):
    (tmp_path / "r.txt").write_text("a-b==1.0 \\\n    --hash=sha256:00\nc==2.0\nA_B==1.1 ; python_version > '3' \\\n"
                                    "    --hash=sha256:11\n")  # fmt: skip
    assert hashed(tmp_path / "r.txt") == {"a-b": {"1.0", "1.1"}}


# The sandbox


def test_the_probes_run_in_all_of_the_services_sandbox():
    unit = "[Unit]\nConditionPathExists=/x\n[Service]\nType=notify\nExecStart=/a\nExecStartPre=/b\nUser=rover\n"
    unit += "WatchdogSec=2\nRestart=on-failure\nProtectSystem=strict\nSystemCallFilter=@system-service\n"
    unit += "StateDirectory=rover-drive\n"
    lines = unit_for(unit, "/probe '{\"a\": 1}' 5%$x").splitlines()
    assert lines == [
        "[Unit]",
        "[Service]",
        "Type=oneshot",
        "ExecStart=/probe '{\"a\": 1}' 5%%$$x",
        "User=rover",
        "ProtectSystem=strict",
        "SystemCallFilter=@system-service",
        "StateDirectory=rover-drive",
    ]


# The pins


def pulses(*throttle: tuple[float, float]) -> list[PinEvent]:
    return [PinEvent(at, "pulse", "throttle", us, 1016.0) for at, us in throttle]


def test_when_the_car_stopped():
    assert stopped(pulses((1.0, 120.0), (2.0, 300.0), (3.0, 304.0), (3.4, 120.0)), 3.1)["after_ms"] == 300.0
    assert stopped(pulses((2.0, 300.0), (3.2, 120.0), (5.0, 300.0)), 3.1)["after_ms"] is None
    assert stopped([], 3.1)["after_ms"] is None
    assert moving(pulses((1.0, 300.0), (2.0, 124.0), (3.0, 125.0))) == [1.0, 3.0]


# The report


def test_a_promise_that_is_broken_is_said_and_written(tmp_path):
    report = PiReport(container_run.STAGE, tmp_path / "pi-fast.json", inputs={"a.pt": "00"})
    report.gate("provision a second time", "changed=0", 0, True)
    report.gate("start limit", "5 tries", {"tries": 7}, False)
    report.write()
    content = read_stage(tmp_path / "pi-fast.json", "pi-fast")
    assert content["metrics"]["wrong"] == ["start limit: wanted 5 tries, found {'tries': 7}"]
    assert [g["holds"] for g in content["metrics"]["gates"]] == [True, False]
    assert content["params"] == lab_params()["pi_fast"] and content["inputs"] == {"a.pt": "00"}


def test_a_step_that_fails_is_in_the_report_at_once(tmp_path):
    said = []
    report = PiReport(container_run.STAGE, tmp_path / "pi-fast.json", said.append)
    with report.step("boot"):
        pass
    with pytest.raises(EmulationError), report.step("deploy"):
        raise EmulationError("no")
    steps = read_stage(tmp_path / "pi-fast.json", "pi-fast")["metrics"]["steps"]
    assert [(s["step"], s["ok"]) for s in steps] == [("boot", True), ("deploy", False)]
    assert said[0] == "boot ..." and said[-1].endswith("deploy: failed")

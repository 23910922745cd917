"""What the view's rows on an emulated Pi make of what they see, without a Pi: `make pi-fast` has one."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from lab.pi import container, view_proofs
from lab.pi.emulation import free_port
from lab.pi.view_proofs import FILES, TOKEN, VIEW_UNIT, VIEW_USER, spoilt, view_gone

ROOT = Path(__file__).parents[3]


class StandIn:
    """A Pi whose systemctl says what it is told to, and whose journal is empty. state: of the view's unit."""

    def __init__(self, root: Path, state: str = "loaded"):
        self.name, self.root, self.state = "rover1", root, state
        (root / "etc/rover").mkdir(parents=True)
        (root / "etc/passwd").write_text("root:x:0:0:root:/root:/bin/sh\n")

    def inside(self, *command: object, check: bool = True) -> SimpleNamespace:
        found = self.state if VIEW_UNIT in command else "loaded"
        names = next((str(c).partition("=")[2] for c in command if str(c).startswith("--property=")), "")
        values = {"LoadState": found, "ActiveState": "active", "NRestarts": "0", "UnitFileState": "enabled"}
        return SimpleNamespace(stdout="".join(f"{name}={values.get(name, '')}\n" for name in names.split(",")))


@pytest.mark.parametrize("guarded", [True, False])
def test_a_door_that_is_open_is_seen(monkeypatch, guarded):
    monkeypatch.setattr(view_proofs, "status", lambda port, path: 403 if guarded and path != "/?token=abc" else 200)
    monkeypatch.setattr(view_proofs, "listening", lambda port: [view_proofs.LOOPBACK if guarded else "00000000"])
    assert [row.holds for row in view_proofs._doors(1, "abc")] == [guarded] * 2


def test_a_drive_that_this_machine_spoilt_is_no_fault_of_the_view():
    by_us = '{"event": "the view is gone"}\n{"event": "ended: stopped from the view (127.0.0.1)"}\n'
    assert not spoilt(by_us) and view_proofs._after_the_drive(by_us).holds
    busy = '{"event": "ended: the Arduino has not answered for 187 ms, the link is behind"}\n'
    assert len(spoilt(busy + by_us)) == 1 and not view_proofs._after_the_drive(busy).holds
    assert not spoilt('{"event": "ended: the camera is gone"}') and not view_proofs._after_the_drive(by_us * 2).holds


def test_what_is_left_of_a_view_is_found(tmp_path):
    pi = StandIn(tmp_path, "not-found")
    port = free_port()
    assert all(row.holds for row in view_gone(pi, port))
    for path in (*FILES, "/opt/rover/venv/lib/python3.11/site-packages/aiohttp"):
        (tmp_path / path.lstrip("/")).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path.lstrip("/")).mkdir()
        gone = view_gone(pi, port)[0]
        assert not gone.holds and len(gone.found) == 1, gone
        (tmp_path / path.lstrip("/")).rmdir()
    (tmp_path / "etc/passwd").write_text(f"{VIEW_USER}:x:997:997::/nonexistent:/usr/sbin/nologin\n")
    assert view_gone(pi, port)[0].found == [f"user {VIEW_USER}"]
    pi.state = "loaded"
    assert [row.holds for row in view_gone(pi, port)] == [False, False, True, True]


def test_the_rows_name_what_the_role_installs():
    tasks = (ROOT / "ansible/roles/rover/tasks/view.yml").read_text()
    assert f"dest: {TOKEN}\n" in tasks and f"name: {VIEW_USER}\n" in tasks and f"name: {VIEW_UNIT}\n" in tasks
    assert VIEW_UNIT.removesuffix(".service") in container.TRANSLATED  # its unit forbids what the emulator does
    for path in FILES:
        assert path in tasks.replace("{{ rover_home }}", "/opt/rover") or path.startswith("/run/"), path

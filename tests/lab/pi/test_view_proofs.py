"""What the view's rows on an emulated Pi make of what they see, without a Pi: `make pi-fast` has one."""

import asyncio
import contextlib
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest
from aiohttp import web

from balloon_world.simulated_arduino import PinEvent
from lab.pi import container, view_proofs
from lab.pi.emulation import EmulationError
from lab.pi.view_proofs import (
    FILES,
    TOKEN,
    VIEW_UNIT,
    VIEW_USER,
    listening,
    page_token,
    spoilt,
    status,
    throttles,
    view_again,
    view_gone,
)
from rover_lib.onboard.view.server import Address, View

ROOT = Path(__file__).parents[3]
SECRET = "a" * 24
HERE = "  sl  local_address rem_address   st tx_queue rx_queue tr tm->when retrnsmt   uid\n"


class StandIn:
    """A Pi whose systemctl says what it is told to, and whose journal is empty. state: of the view's unit."""

    def __init__(self, root: Path, state: str = "loaded"):
        self.name, self.root, self.state = "rover1", root, state
        self.asked: list[tuple] = []
        (root / "etc/rover").mkdir(parents=True)
        (root / "etc/passwd").write_text("root:x:0:0:root:/root:/bin/sh\n")

    def inside(self, *command: object, check: bool = True) -> SimpleNamespace:
        self.asked.append(command)
        found = self.state if VIEW_UNIT in command else "loaded"
        names = next((str(c).partition("=")[2] for c in command if str(c).startswith("--property=")), "")
        values = {"LoadState": found, "ActiveState": "active", "NRestarts": "0", "UnitFileState": "enabled"}
        return SimpleNamespace(stdout="".join(f"{name}={values.get(name, '')}\n" for name in names.split(",")))


@web.middleware
async def everybody(self, request, handler):
    """A guard that lets everybody in."""
    return await handler(request)


@contextlib.contextmanager
def served(token: str = SECRET):
    """A real view's port."""
    ready, ended, ports = threading.Event(), asyncio.Event(), []

    async def run() -> None:
        async with contextlib.AsyncExitStack() as stack:
            url = await View(Address(0), token).open(stack)
            ports.append(int(url.split(":")[2].split("/")[0]))
            ready.set()
            await ended.wait()

    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_until_complete, args=(run(),))
    thread.start()
    try:
        assert ready.wait(10)
        yield ports[0]
    finally:
        loop.call_soon_threadsafe(ended.set)
        thread.join(10)


def test_where_a_port_is_listened_to_is_the_kernels_table(tmp_path):
    four, six = tmp_path / "tcp", tmp_path / "tcp6"
    four.write_text(HERE + "   0: 0100007F:2116 00000000:0000 0A 0 0 0\n   1: 00000000:0016 00000000:0000 0A 0 0 0\n"
                    "   2: 0100007F:2116 0100007F:C001 01 0 0 0\n")  # fmt: skip
    six.write_text(HERE + f"   0: {'0' * 32}:2116 {'0' * 32}:0000 0A 0 0 0\n")
    assert listening(8470, (str(four),)) == ["0100007F"]
    assert listening(8470, (str(four), str(six))) == ["0100007F", "0" * 32]
    assert listening(22, (str(four), str(six))) == ["00000000"] and listening(1, (str(four),)) == []


def test_the_doors_of_a_view_are_shut_and_one_that_is_open_is_seen(monkeypatch):
    with served() as port:
        rows = view_proofs._doors(port, SECRET)
        assert [row.holds for row in rows] == [True] * 3, rows
        assert not view_proofs._doors(port, "b" * 24)[1].holds  # not its token
    monkeypatch.setattr(View, "_guard", everybody)
    with served() as port:
        shut = view_proofs._doors(port, SECRET)[0]
        assert not shut.holds and shut.found["no token"] == 200, shut
    assert status(port, "/") == 0 and [row.holds for row in view_proofs._doors(port, SECRET)] == [False] * 3


def test_a_throttle_that_stays_as_it_is_is_told_once():
    events = [PinEvent(at, "pulse", "throttle", us, 1016.0) for at, us in ((1.0, 120.0), (2.0, 300.0), (5.0, 120.0))]
    events += [PinEvent(3.5, "pulse", "steering", 1500.0, 20000.0), PinEvent(3.6, "line", "", 0.0, 0.0)]
    assert throttles(events, 3.0, 4.0) == [300.0] and throttles(events, 3.0, 5.0) == [300.0, 120.0]
    assert throttles(events, 0.5, 0.9) == [] and throttles(events, 6.0, 7.0) == [120.0]


def test_a_drive_that_this_machine_spoilt_is_no_fault_of_the_view():
    by_us = '{"event": "the view is gone"}\n{"event": "ended: stopped from the view (127.0.0.1)"}\n'
    assert not spoilt(by_us) and view_proofs._after_the_drive(by_us).holds
    busy = '{"event": "ended: the Arduino has not answered for 187 ms, the link is behind"}\n'
    assert len(spoilt(busy + by_us)) == 1 and not view_proofs._after_the_drive(busy).holds
    assert not spoilt('{"event": "ended: the camera is gone"}') and not view_proofs._after_the_drive(by_us * 2).holds


def test_the_token_of_a_rover_without_a_view_is_an_error(tmp_path):
    pi = StandIn(tmp_path)
    with pytest.raises(EmulationError, match=f"rover1: no {TOKEN}"):
        page_token(pi)
    (tmp_path / TOKEN.lstrip("/")).write_text(f"{SECRET}\n")
    assert page_token(pi) == SECRET


def test_it_is_served_again_after_a_boot_or_the_row_says_so(tmp_path, monkeypatch):
    pi = StandIn(tmp_path)
    (tmp_path / TOKEN.lstrip("/")).write_text(SECRET)
    with served() as port:
        assert [row.holds for row in view_again(pi, port)] == [True]
    monkeypatch.setattr(view_proofs, "START_S", 0.0)
    assert [row.holds for row in view_again(pi, port)] == [False]


def test_what_is_left_of_a_view_is_found(tmp_path):
    pi = StandIn(tmp_path, "not-found")
    with served() as port:
        pass
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

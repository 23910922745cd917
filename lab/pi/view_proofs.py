"""Prove the view's service beside the real drive service, on an emulated Pi that was provisioned with rover_view.

    rows = view_beside_a_drive(pi, pins, port, stop_s=2.0)     # who may look, what is seen, what a stop and a kill do
    rows += view_gone(pi, port)                                 # after it was provisioned without rover_view again

Each row says what was wanted and what was found; container_run.py makes a gate of each. One line of the unit is not
proven here: MemoryDenyWriteExecute=, under which no emulator of programs works (container.TRANSLATED).
"""

import contextlib
import http.client
import os
import re
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from balloon_world.simulated_arduino import PinEvent
from lab.driving.page import Page
from lab.driving.pins import STOPPED_THROTTLE_US
from lab.pi.container import Container
from lab.pi.emulation import EmulationError, wait_for
from lab.pi.pulses import READ_S, Pins, stopped
from lab.pi.report import Row
from lab.pi.service_proofs import READY_S, STATE, VENV, arm, show
from rover_lib.onboard.drive.feed import DRIVING, WAITING
from rover_lib.onboard.drive.service import UNIT

VIEW_UNIT, VIEW_USER = "rover-view.service", "rover-view"
TOKEN = "/etc/rover/view.token"
FILES = (f"/etc/systemd/system/{VIEW_UNIT}", TOKEN, "/opt/rover/requirements_pi_view.txt", "/run/rover-view")
START_S = 180.0  # how long its program may take to start, emulated on a busy machine
SEEN_S = 30.0  # how long it may take until a page shows what has happened
WITHOUT_S = 3.0  # how long a drive must go on after its view was killed; longer than the Arduino's 150 ms
STOPPED_S = 2.0  # how long after a stop nothing may move the car any more
ATTEMPTS = 3  # how often a drive is tried if this machine was too busy; if it was each time, the drive fails
BUSY = ("the Arduino has not answered for", "the newest plan is too old to drive by")
LOOPBACK = "0100007F"  # 127.0.0.1, as the kernel writes it
LISTENS = "0A"


def view_beside_a_drive(pi: Container, pins: Pins, port: int, stop_s: float) -> list[Row]:
    """Return all rows for an installed view. port: of its page. stop_s: how long a stop may take from the click on.

    It starts the drive service and arms the car, and leaves the service stopped. Raises EmulationError if nothing can
    be judged: if there is no view, or the car does not drive.
    """
    token = page_token(pi)
    if not wait_for(lambda: status(port, f"/?token={token}") == 200, START_S, 0.5):
        told = show(pi, "ActiveState", "SubState", "StatusText", "Result", unit=VIEW_UNIT)
        raise EmulationError(f"the view serves no page: {told}; {_journal(pi)[-800:]}")
    rows = [_started(pi), _token_is_roots(pi, token), *_doors(port, token)]
    for attempt in range(1, ATTEMPTS + 1):
        pi.inside("systemctl", "reset-failed", UNIT, VIEW_UNIT, check=False)  # also clears their counts of starts
        pi.inside("systemctl", "start", UNIT)
        try:
            beside = list(_beside(pi, pins, port, token, stop_s))
        finally:
            pi.inside("systemctl", "stop", UNIT)
        log = (pi.root / STATE.lstrip("/") / "flight.log").read_text(errors="replace")
        if attempt == ATTEMPTS or not spoilt(log):
            break
    return [*rows, *beside, _after_the_drive(log)]


def spoilt(log: str) -> list[str]:
    """Return how drives in a flight log ended, if this machine had no time for the emulated Arduino or for a plan."""
    return re.findall(rf'"ended: ({"|".join(BUSY)})', log)


def view_again(pi: Container, port: int) -> list[Row]:
    """Return the rows after a boot: the page must be served again, with the token that it had."""
    token = page_token(pi)
    served = wait_for(lambda: status(port, f"/?token={token}") == 200, START_S, 0.5)
    return [Row("the view after a power cut", "served again", _state(pi), served)]


def view_gone(pi: Container, port: int) -> list[Row]:
    """Return the rows after provisioning with rover_view=false: only the drive service is left, nothing of the view."""
    left = [path for path in FILES if os.path.lexists(pi.root / path.lstrip("/"))]
    left += [f"user {VIEW_USER}"] if _uid(pi, VIEW_USER) is not None else []
    left += ["aiohttp"] if list((pi.root / VENV.lstrip("/")).glob("lib/python3*/site-packages/aiohttp")) else []
    state = _state(pi)
    answers = status(port, "/")
    drive = show(pi, "LoadState", "ActiveState")
    return [
        Row("rover_view=false, of the view", "nothing is left", left or "nothing", not left),
        Row("rover_view=false, its service", "inactive, not known", state, state["LoadState"] == "not-found"),
        Row("rover_view=false, its port", "nobody listens", answers, answers == 0 and not listening(port)),
        Row("rover_view=false, the drive service", "installed", drive, drive["LoadState"] == "loaded"),
    ]


def page_token(pi: Container) -> str:
    """Read the page's token from root's file. Raises EmulationError if there is none."""
    try:
        return (pi.root / TOKEN.lstrip("/")).read_text().strip()
    except OSError as error:
        raise EmulationError(f"{pi.name}: no {TOKEN} ({error.strerror})") from None


def status(port: int, path: str) -> int:
    """Return the HTTP status with which a port of the loopback answers; 0 if nobody answers."""
    wire = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    with contextlib.closing(wire), contextlib.suppress(OSError, http.client.HTTPException):
        wire.request("GET", path)
        return wire.getresponse().status
    return 0


def listening(port: int, tables: tuple[str, ...] = ("/proc/net/tcp", "/proc/net/tcp6")) -> list[str]:
    """Return the addresses at which somebody listens to a TCP port, in the kernel's own hexadecimal."""
    found = []
    for table in tables:
        for line in Path(table).read_text().splitlines()[1:]:
            _, local, _, state, *_ = line.split()
            address, _, number = local.partition(":")
            if int(number, 16) == port and state == LISTENS:
                found.append(address)
    return found


# ---- who may look


def _started(pi: Container) -> Row:
    """The service is active and enabled, with its own user, no other group and no capability."""
    told: dict[str, Any] = {**show(pi, "ActiveState", "UnitFileState", "MainPID", unit=VIEW_UNIT)}
    own = _uid(pi, VIEW_USER)
    with contextlib.suppress(EmulationError, OSError):
        lines = Path(f"/proc/{pi.pid_of(int(told['MainPID']))}/status").read_text().splitlines()
        about = {key: value.split() for key, _, value in (line.partition(":") for line in lines)}
        told |= {"uid": about["Uid"], "groups": about["Groups"], "capabilities": about["CapEff"]}
    alone = own is not None and told.get("uid") == [str(own)] * 4 and len(told["groups"]) <= 1
    runs = told["ActiveState"] == "active" and told["UnitFileState"] == "enabled"
    holds = runs and alone and int(told["capabilities"][0], 16) == 0
    return Row("the view's service", "active, enabled, its own user, no group and no capability else", told, holds)


def _token_is_roots(pi: Container, token: str) -> Row:
    file = (pi.root / TOKEN.lstrip("/")).stat()
    found = {"mode": f"{file.st_mode & 0o777:o}", "uid": file.st_uid, "letters": len(token)}
    told = token in _journal(pi)
    holds = found == {"mode": "600", "uid": 0, "letters": 24} and not told
    return Row("the token", "root's alone, in no journal", found | {"in the journal": told}, holds)


def _doors(port: int, token: str) -> Iterator[Row]:
    """Return the rows about the token, and where the view listens. tests/onboard/view has all ways to be sent away."""
    asked = [status(port, f"/?token={given}") for given in (token[:-1], token)]
    yield Row("the page, without a letter of its token; with all", "403, 200", asked, asked == [403, 200])
    yield Row("where it listens", "127.0.0.1 alone", at := listening(port), at == [LOOPBACK])


# ---- beside a drive


def _beside(pi: Container, pins: Pins, port: int, token: str, stop_s: float) -> Iterator[Row]:
    url = f"http://127.0.0.1:{port}/?token={token}"
    if not wait_for(lambda: show(pi, "StatusText")["StatusText"].startswith("disarmed"), READY_S):
        raise EmulationError(f"the service is not ready: {show(pi, 'ActiveState', 'StatusText')}")
    with Page(url) as page:
        seen = _shows(page, lambda newest: newest["phase"] == WAITING and newest["stopped"])
        yield Row("what a page shows of a disarmed car", "waiting, at rest", _brief(page), seen)
        armed_s = arm(pi, pins)
        drive = show(pi, "MainPID", "NRestarts")
        seen = _shows(page, _drives)
        yield Row("what it shows of an armed drive", "driving, with picture and pins", _brief(page), seen)
    yield from _killed(pi, pins, port, token, armed_s, drive)
    with Page(url) as page:
        seen = _shows(page, _drives)
        yield Row("a page of the view's next start", "driving", _brief(page), seen)
        yield from _stop(pi, pins, page, stop_s, armed_s, drive)


def _killed(pi: Container, pins: Pins, port: int, token: str, armed_s: float, drive: dict[str, str]) -> Iterator[Row]:
    """Kill the view while the car drives: the drive must go on, and systemd must start the view again."""
    before = show(pi, "MainPID", "NRestarts", unit=VIEW_UNIT)
    os.kill(pi.pid_of(int(before["MainPID"])), signal.SIGKILL)
    at_s = time.monotonic()
    time.sleep(WITHOUT_S)
    throttle = throttles(pins.since(armed_s), at_s, at_s + WITHOUT_S - READ_S)
    after = show(pi, "MainPID", "NRestarts", "ActiveState", "StatusText")
    same = {name: after[name] for name in drive} == drive
    kept = {"throttle_us": sorted(set(throttle)), **after}
    holds = min(throttle, default=0) > STOPPED_THROTTLE_US and same and after["StatusText"].startswith("driving")
    yield Row("a drive whose view is killed", "drives on, in the same process", kept, holds)
    served = wait_for(lambda: status(port, f"/?token={token}") == 200, START_S, 0.5)
    now = show(pi, "MainPID", "NRestarts", "ActiveState", unit=VIEW_UNIT)
    again = int(now["NRestarts"]) == int(before["NRestarts"]) + 1 and now["MainPID"] != before["MainPID"]
    found: dict[str, Any] = {**now, "after_s": round(time.monotonic() - at_s, 1)}
    yield Row("a view that was killed", "started again by systemd, once", found, served and again)


def _stop(pi: Container, pins: Pins, page: Page, stop_s: float, armed_s: float, drive: dict[str, str]) -> Iterator[Row]:
    """Click the button: the car must stop and stay stopped, and the service must wait disarmed."""
    at_s = page.stop()
    seen = _shows(page, lambda newest: newest["phase"] != DRIVING and newest["stopped"])
    time.sleep(STOPPED_S)
    events = pins.since(armed_s)
    before, after = throttles(events, at_s - READ_S, at_s), throttles(events, at_s + stop_s, time.monotonic())
    found = {
        "throttle_us before": sorted(set(before)),
        "throttle off after_ms": stopped(events, at_s)["after_ms"],
        "throttle_us later": sorted(set(after)),
    }
    holds = min(before, default=0) > STOPPED_THROTTLE_US >= max(after, default=1e9)
    yield Row("the page's button", f"throttle off within {stop_s:g} s, and it stays off", found, holds)
    yield Row("what the page says of it", "stopped", _brief(page), seen)
    told = show(pi, "MainPID", "NRestarts", "ActiveState", "StatusText")
    waits = told["ActiveState"] == "active" and told["StatusText"].startswith("disarmed")
    same = {name: told[name] for name in drive} == drive
    yield Row("the drive service after it", "disarmed, in the same process", told, waits and same)


def _after_the_drive(log: str) -> Row:
    """Return the row about what the flight log says about the view."""
    said = {
        "stopped from the view (127.0.0.1)": log.count('"ended: stopped from the view (127.0.0.1)'),
        "the view is gone": log.count('"the view is gone'),
        "not fed": log.count("the view is not fed"),
    }
    holds = list(said.values()) == [1, 1, 0]
    return Row("the flight log, of the view", "stopped by it once, gone once", said, holds)


def throttles(events: Sequence[PinEvent], from_s: float, until_s: float) -> list[float]:
    """Return the throttle's pulses (microseconds) in a span of time: the one at its beginning, and each new one.

    events: from before that span on, as the Arduino's emulator tells only once of a pulse that stays the same.
    """
    pulses = [(e.monotonic_s, e.pulse_us) for e in events if e.pin == "throttle" and e.kind == "pulse"]
    before = [us for at_s, us in pulses if at_s <= from_s]
    return before[-1:] + [us for at_s, us in pulses if from_s < at_s <= until_s]


def _shows(page: Page, wanted: Callable[[dict[str, Any]], object]) -> bool:
    return wait_for(lambda: wanted(page.newest), SEEN_S, 0.05)


def _drives(newest: dict[str, Any]) -> bool:
    return bool(newest["phase"] == DRIVING and newest["pins"] and newest["jpeg_bytes"] and not newest["stopped"])


def _brief(page: Page) -> dict[str, Any]:
    keys = ("phase", "text", "pins", "who", "stopped", "jpeg_bytes", "missing")
    return {key: page.newest.get(key) for key in keys}


# ---- what systemd and the disk say


def _state(pi: Container) -> dict[str, str]:
    return show(pi, "LoadState", "ActiveState", "UnitFileState", "NRestarts", unit=VIEW_UNIT)


def _journal(pi: Container) -> str:
    return pi.inside("journalctl", f"--unit={VIEW_UNIT}", "--output=cat", "--no-pager", check=False).stdout


def _uid(pi: Container, user: str) -> int | None:
    line = re.search(rf"^{user}:[^:]*:(\d+):", (pi.root / "etc/passwd").read_text(), re.M)
    return int(line[1]) if line else None

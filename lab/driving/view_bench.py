"""Measure what a view costs a drive, how old its picture is and how soon its button stops the car: python -m lab view.

Stops: `rover drive --service` drives with the real firmware in simavr. A page's button is pressed while the car drives
at speed, and the pins show when the throttle is off. Then a human wiggles the stick, the car is armed again, and so on.

Costs: during one drive in the balloon world, no view and a view with open pages take turns, so that whatever else this
machine does affects both. The pages speak the page's own protocol, in this process. A browser would take processor time
from the drive, which it does not do on a rover, as it runs on another machine there.
"""

import contextlib
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from balloon_world.child_process import Child
from lab.driving.bench import Drive, DrivingBench, FaultError
from lab.driving.page import Page, ViewServer
from lab.driving.pins import STOPPED, Gates, Observation, judge
from lab.params import lab_params
from rover_lib.onboard.drive.flight_log import read_log
from rover_lib.onboard.drive.service import Request, arm_car
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.stage import write_stage

SPEED_S = 0.5  # how long the car drives at speed before a click
WATCH_S = 0.5  # how long it is watched after the click
KNOWN_S = 0.05  # how long it takes until a pulse has ended and been read
ATTEMPTS = 5  # how often a stop is tried if this machine was too busy
SETTLE_S = 4.0  # the beginning of each turn, which does not count, as a view starts then
DRIVES_S = 90.0


@dataclass(frozen=True)
class ViewGates:
    """The gates in lab/params.yml's section `view_costs`."""

    stops: int
    stop_ms: float
    late_ms: float
    delay_ms: float
    cpu_pct: float
    pages: int


def percentiles(values: list[float]) -> dict[str, Any]:
    """Return p50, p95, p99, max and n."""
    p50, p95, p99 = (round(float(p), 2) for p in np.percentile(values, (50, 95, 99)))
    return {"p50": p50, "p95": p95, "p99": p99, "max": round(max(values), 2), "n": len(values)}


class _ServiceDrive(Drive):
    """A drive as the service does it, but without systemd."""

    arguments = ("--service",)


def stops(count: int, echo: Callable[[str], None] = lambda text: None) -> dict[str, Any]:
    """Press the button `count` times, each time while the car drives.

    Returns {stops, stopped, logged, stop_ms, shown_ms, spoilt, wrong}. stop_ms: from the click to the last throttle
    pulse that moves the car. shown_ms: from the click until the page says so. logged: how many stops are in the flight
    log. spoilt: how many were repeated, because this machine had no time for the Arduino, or so little for the drive
    that it had ended by itself.
    """
    gates = Gates.of_params()
    off_ms: list[float] = []
    shown_ms: list[float] = []
    wrong: list[str] = []
    spoilt = 0
    with DrivingBench() as bench, contextlib.ExitStack() as stack:
        os.environ["RUNTIME_DIRECTORY"] = str(bench.folder)  # for the service's socket, both here and in its process
        stack.callback(os.environ.pop, "RUNTIME_DIRECTORY", None)
        view = stack.enter_context(ViewServer(bench.view))
        page = stack.enter_context(Page(view.url))
        stack.callback(bench.end_drive)
        log = bench.start(make=_ServiceDrive).log
        attempts = 0
        while len(off_ms) < count and len(wrong) < count:
            _arm(bench, page)
            bench.wait(SPEED_S)
            at_s = page.stop()
            bench.wait(WATCH_S)
            end_s = time.monotonic()
            bench.wait(KNOWN_S)
            commands = [c for c in bench.cable.commands if at_s - 1 < c.at_s <= end_s]
            seen = Observation(bench.events, commands, at_s, end_s)
            said = next((m for m in page.messages if m["heard_s"] > at_s and m["stopped"]), None)
            by_another = said is not None and "stopped from the view" not in said["text"]  # and before the click
            attempts += 1
            stalled = seen.stalled_ms() or not seen.was_driving(gates.throttle_max_us)
            if attempts < ATTEMPTS and (stalled or by_another):
                spoilt += 1
                continue
            attempts = 0
            verdict = judge(STOPPED, seen, gates)
            if said is None or by_another:
                verdict.wrong.append(f"the page did not say that it stopped: {said}")
            else:
                shown_ms.append((said["heard_s"] - at_s) * 1e3)
            wrong += verdict.wrong
            off_ms.append(verdict.figures["stopped_after_ms"])
            if len(off_ms) % 10 == 0:
                echo(f"{len(off_ms)} stops: throttle off after {statistics.median(off_ms):.0f} ms, at most "
                     f"{max(off_ms):.0f}")  # fmt: skip
            bench.events = bench.events[-2000:]
            del page.messages[:-1]
        bench.end_drive()
        logged = log.read_bytes().count(b'"ended: stopped from the view')
    if logged < len(off_ms):  # there may be more in the log, as some were repeated
        wrong.append(f"{logged} of {len(off_ms)} stops are in the flight log")
    return {
        "stops": len(off_ms),
        "stopped": len(off_ms) - len(wrong),
        "logged": logged,
        "stop_ms": percentiles(off_ms),
        "shown_ms": percentiles(shown_ms) if shown_ms else None,
        "spoilt": spoilt,
        "wrong": wrong,
    }


def _arm(bench: DrivingBench, page: Page) -> None:
    """Let the human wiggle the stick and arm the car; wait until it drives and the page shows that."""
    end_s = time.monotonic() + DRIVES_S
    while True:
        with contextlib.suppress(RoverError):
            bench.arduino.wiggle()
            bench.wait(1.4)  # the stick must have been let go of for a second
            arm_car(Request(), wait_s=0.0)
            break
        bench.drive.check()
        if time.monotonic() > end_s:
            raise FaultError("the service was not armed", found=bench.drive.last_words(), remedy="try it by hand")
        bench.wait(0.2)
    end_s = time.monotonic() + 10.0
    while page.newest["phase"] != "driving" or not bench.driving:
        bench.wait(0.05)
        if time.monotonic() > end_s:
            raise FaultError("the car does not drive, or the page does not show it", found=page.newest)


class _WorldDrive(Child):
    """A drive of an artifact in the balloon world. It is already driving when this object has been made."""

    def __init__(self, artifact: Path, place: Path, log: Path):
        self.log = log
        options = ("--world", "--view", place, "--log", log)
        command = (sys.executable, "-m", "rover_lib.cli", "drive", artifact, *options)
        super().__init__("rover drive", *command, error=FaultError)
        end_s = time.monotonic() + DRIVES_S
        while not any("armed" in line for line in self.errors()):
            self.check()
            if time.monotonic() > end_s:
                raise FaultError("the drive did not begin", found=self.last_words(), remedy="try it by hand")
            time.sleep(0.1)
        time.sleep(SETTLE_S)

    def late_ms(self, since_s: float, until_s: float) -> np.ndarray:
        """Return by how much each of its commands in a span of time was late, in milliseconds."""
        flight = read_log(self.log)
        t_s = flight.ticks["t_s"] + flight.header["start_monotonic_s"]
        return flight.ticks["late_ms"][(t_s > since_s) & (t_s < until_s)]


@dataclass
class _Turns:
    """A turn without a view and a turn with one.

    alone, looked: from when to when the turns count, without and with a view. delays_ms: of each picture on each page.
    rates_hz: pictures a second on each page. cpu_pct: what the view's process took of a core.
    """

    alone: tuple[float, float]
    looked: tuple[float, float]
    delays_ms: list[float]
    rates_hz: list[float]
    cpu_pct: float


def _turns(place: Path, turn_s: float, pages: int) -> _Turns:
    begin_s = time.monotonic()
    time.sleep(turn_s)
    alone = begin_s + SETTLE_S, time.monotonic()
    with ViewServer(place) as view, contextlib.ExitStack() as opened:
        looking = [opened.enter_context(Page(view.url)) for _ in range(pages)]
        time.sleep(max(0.0, alone[1] + SETTLE_S - time.monotonic()))
        since_s, before_s = time.monotonic(), _processor_s(view.pid)
        time.sleep(max(0.0, alone[1] + turn_s - time.monotonic()))
        until_s = time.monotonic()
        cpu_pct = 100 * (_processor_s(view.pid) - before_s) / (until_s - since_s)
        heard = [[m for m in p.messages if since_s < m["heard_s"] < until_s and m["jpeg_bytes"]] for p in looking]
    delays_ms = [(m["heard_s"] - m["captured_s"]) * 1e3 for messages in heard for m in messages]
    rates_hz = [len(messages) / (until_s - since_s) for messages in heard]
    return _Turns(alone, (since_s, until_s), delays_ms, rates_hz, cpu_pct)


def costs(
    artifact: Path, pairs: int, turn_s: float = 12.0, pages: int = 3, echo: Callable[[str], None] = lambda text: None
) -> dict[str, Any]:
    """Drive an artifact in the balloon world, with and without a view in turns.

    Returns {pages, late_ms: {with, without}, late_p99_pairs_ms, late_p99_more_ms, delay_ms, pictures_hz, cpu_pct, load,
    repeated}. delay_ms: from a picture's capture until a page has it. cpu_pct: what the view with all its pages takes
    of one core. repeated: how many pairs were driven again, because the drive had ended as this machine was too busy.
    """
    late: dict[str, list[np.ndarray]] = {"with": [], "without": []}
    turns: list[_Turns] = []
    repeated = 0
    with tempfile.TemporaryDirectory(prefix="rover-view-") as name, contextlib.ExitStack() as stack:
        drive: _WorldDrive | None = None
        while len(turns) < pairs:
            if drive is None or not drive.running:
                drive = _WorldDrive(artifact, Path(name, "view"), Path(name, f"flight-{repeated}.log"))
                stack.callback(drive.close)
            turn = _turns(Path(name, "view"), turn_s, pages)
            time.sleep(1.0)  # the log is written twice a second
            if not drive.running:
                repeated += 1
                if repeated > pairs:
                    raise drive.ended()
                continue
            turns.append(turn)
            late["without"].append(drive.late_ms(*turn.alone))
            late["with"].append(drive.late_ms(*turn.looked))
            echo(f"{len(turns)} of {pairs}: {turn.cpu_pct:.1f} % of a core, {turn.rates_hz[0]:.1f} pictures a second")
    both = zip(late["with"], late["without"], strict=True)
    more = [float(np.percentile(looked, 99) - np.percentile(alone, 99)) for looked, alone in both]
    all_late = {which: percentiles(np.concatenate(parts).tolist()) for which, parts in late.items()}
    return {
        "pages": pages,
        "late_ms": all_late,
        "late_p99_pairs_ms": [round(value, 3) for value in more],
        "late_p99_more_ms": round(all_late["with"]["p99"] - all_late["without"]["p99"], 3),
        "delay_ms": percentiles([ms for turn in turns for ms in turn.delays_ms]),
        "pictures_hz": round(statistics.mean(hz for turn in turns for hz in turn.rates_hz), 2),
        "cpu_pct": round(statistics.mean(turn.cpu_pct for turn in turns), 2),
        "load": [round(value, 2) for value in os.getloadavg()],
        "repeated": repeated,
    }


def _processor_s(pid: int) -> float:
    """Return how many seconds of processor time a process has used until now."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure(
    output: Path, artifact: Path, pairs: int, count: int | None, echo: Callable[[str], None] = lambda text: None
) -> tuple[dict[str, Any], list[str]]:
    """Measure stops and costs, and write them to `output` as the stage `view`.

    count: the number of stops, that of lab/params.yml if None. Returns the metrics, and a sentence for each gate that
    does not hold.
    """
    gates = ViewGates(**lab_params()["view_costs"])
    metrics = costs(artifact, pairs, pages=gates.pages, echo=echo)
    metrics["stop"] = stop = stops(gates.stops if count is None else count, echo)
    found = {
        "late_ms": metrics["late_p99_more_ms"],
        "delay_ms": metrics["delay_ms"]["p95"],
        "cpu_pct": metrics["cpu_pct"],
        "stop_ms": stop["stop_ms"]["max"],
    }
    wrong = [f"{name} is {value:g}, {getattr(gates, name):g} are allowed" for name, value in found.items()
             if value > getattr(gates, name)] + stop["wrong"]  # fmt: skip
    write_stage(output, "view", params=vars(gates), metrics=metrics | {"wrong": wrong})
    return metrics, wrong

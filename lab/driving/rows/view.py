"""Faults of the view: it may stop the car, but whatever else happens to it, the drive goes on."""

import signal
import threading
import time

from lab.driving.bench import DrivingBench, FaultError
from lab.driving.page import Page, ViewServer, flood
from lab.driving.pins import CONTINUES, STOPPED
from lab.driving.row import FaultKind

FAULTS = FaultKind("view")
SHOWN_S = 10.0  # a drive looks for a view once a second
GOES_ON = "none: no view takes the drive's time"


def _open(bench: DrivingBench) -> tuple[ViewServer, Page]:
    """Open a view, and a page that shows the drive."""
    view = ViewServer(bench.view)
    bench.undo.callback(view.close)
    page = bench.undo.enter_context(Page(view.url))
    end_s = time.monotonic() + SHOWN_S
    while page.newest["phase"] != "driving":
        bench.wait(0.05)
        if time.monotonic() > end_s:
            raise FaultError("the page shows no drive", found=page.newest, remedy="try rover view by hand")
    bench.wait(0.3)
    return view, page


@FAULTS.add("stopped from a page", STOPPED, r"ended: stopped from the view \(127", "the page's button", exit_code=0)
def _stop(bench: DrivingBench) -> float:
    return _open(bench)[1].stop()


@FAULTS.add("view killed", CONTINUES, "the view is gone", "SIGKILL, with a page open", limits=GOES_ON)
def _kill(bench: DrivingBench) -> float:
    view, _ = _open(bench)
    at_s = time.monotonic()
    view.signal(signal.SIGKILL)
    return at_s


@FAULTS.add("view hangs", CONTINUES, "the view is gone", "SIGSTOP, after 2 s SIGKILL", limits=GOES_ON)
def _hang(bench: DrivingBench) -> float:
    view, _ = _open(bench)
    at_s = time.monotonic()
    view.signal(signal.SIGSTOP)
    bench.wait(2.0)
    view.signal(signal.SIGKILL)
    return at_s


@FAULTS.add(
    "view flooded",
    CONTINUES,
    "the view is gone",
    "1,000 requests a second for 3 s, with no token, a wrong one, another's host, another's page; then SIGKILL",
    starves=True,
    limits=GOES_ON,
)
def _flood(bench: DrivingBench) -> float:
    view, page = _open(bench)
    at_s = time.monotonic()
    page.close()  # in the middle of a message
    flooding = threading.Thread(target=flood, args=(view.url, 3.0), daemon=True)
    flooding.start()
    while flooding.is_alive():
        bench.wait(0.1)
    view.signal(signal.SIGKILL)
    return at_s

"""What a drive is given, and what is checked and opened before anything moves."""

import contextlib
import logging
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rover_lib.onboard.artifact.manifest import car_of
from rover_lib.onboard.car.car import Car, this_car
from rover_lib.onboard.car.host import boottime, default_log
from rover_lib.onboard.drive.flight_log import FlightLog, log_limits
from rover_lib.onboard.drive.loop import Report
from rover_lib.onboard.drive.plan import Settings
from rover_lib.onboard.status_line import StatusLine


@dataclass(frozen=True)
class DriveOptions:
    """The options of `rover drive`.

    hz: commands per second. dry_run: no motor is driven. record: folder in which an episode is written. record_mb: how
    much all episodes in it may take together; None: limited by the disk. max_seconds, ticks: when to end.
    throttle_limit: replaces that of params.yml. threads: of the policy; None: all cores but one. log_file: None: the
    user's. service: run as a systemd service, disarmed until a human arms it. latency_ms: make each plan take at least
    this long, for comparisons. view: the socket of a view; None: the user's. asked_s: when the car was asked for, by
    boottime().
    """

    artifact: Path
    camera: str = "0"
    port: str = ""
    hz: float = 30.0
    dry_run: bool = False
    record: Path | None = None
    record_mb: float | None = None
    max_seconds: float | None = None
    ticks: int | None = None
    throttle_limit: float | None = None
    threads: int | None = None
    log_file: Path | None = None
    service: bool = False
    latency_ms: float = 0.0
    view: Path | None = None
    asked_s: float = field(default_factory=boottime)


def another_car(manifest: dict[str, Any], this: Car) -> str:
    """Return a warning if an artifact was calibrated for another car, else "". It may drive all the same."""
    meant = car_of(manifest)
    if meant.drives_like(this):
        return ""
    return f"this policy was calibrated for {meant.name!r}, and this car is {this.name!r}: see that the way is free"


@contextlib.contextmanager
def open_flight_log(options: DriveOptions, settings: Settings, report: Report) -> Iterator[FlightLog]:
    """Open a flight log whose events are also lines on the terminal, above the report's status."""
    (max_bytes, keep), path = log_limits(), options.log_file or default_log()
    header: dict[str, Any] = {"artifact": str(options.artifact), "hz": options.hz, **vars(settings)}
    if not (car := this_car()).drives_like(Car()):
        header["car"] = car.description()
    with StatusLine(lambda: report.status) as status:
        logging.basicConfig(level=logging.INFO, format="rover: %(message)s", handlers=[status], force=True)
        with FlightLog(path, header=header, max_bytes=max_bytes, keep=keep) as log:
            yield log

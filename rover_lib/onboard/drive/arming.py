"""Arm the car: wait for what a human must do, and ask the Arduino for the car last of all. For session.py."""

import threading
from collections.abc import Callable, Sequence

from rover_lib.onboard.car.host import boottime
from rover_lib.onboard.car.servo_link import ServoLink, Telemetry
from rover_lib.onboard.drive.loop import Arm
from rover_lib.onboard.drive.service import CHECK_S, check_age
from rover_lib.onboard.errors import RoverError

WAIT_S = 30.0  # for a human, from the command that asks for the car; the Arduino refuses an arming after 31


def wanted_since(asked_s: float, clock: Callable[[], float] = boottime) -> Callable[[], None]:
    """Return a check for a car that was asked for at asked_s: it raises once that is over WAIT_S ago."""
    return lambda: check_age(clock() - asked_s, WAIT_S)


def arm_when_ready(
    arm: Arm,
    link: ServoLink,
    stop: threading.Event,
    notify: Callable[[str], None],
    checks: Sequence[Callable[[], object]] = (),
    still_wanted: Callable[[], object] | None = None,
) -> Telemetry | None:
    """Arm for a human in a terminal: say what is missing, wait for it, and then arm.

    checks: called while waiting; each raises if its device fails. still_wanted: raises if the human asked too long ago;
    None: they ask now. Raises RoverError when told to stop.
    """
    still_wanted = still_wanted or wanted_since(boottime())
    link.request()
    told = ""
    while missing := what_is_missing(link):
        still_wanted()
        if missing != told:
            notify(f"before the car can drive: {missing}")
            told = missing
        for check in checks:
            check()
        if stop.wait(CHECK_S):
            raise RoverError("told to stop before a human armed the car", kind="not armed")
    still_wanted()
    return arm()


def what_is_missing(link: ServoLink) -> str:
    """Return what a human must do before the Arduino can be armed, "" if nothing. Raises LinkError."""
    telemetry = link.latest()
    return link.remedy(telemetry.missing) if telemetry and telemetry.missing != "-" else ""


def arm_capped(
    link: ServoLink, limit: float, notify: Callable[[str], None], still_wanted: Callable[[], object] = lambda: None
) -> Telemetry:
    """Arm a car, after the Arduino was told to limit the host's throttle to `limit`, in [0, 1].

    notify: told if the Arduino allows less. Raises what still_wanted raises, and LinkError.
    """
    channel = link.calibration.throttle
    directions = (limit, -limit) if channel.low < 0 else (limit,)
    farthest_us = max(map(channel.pulse_us, directions), key=lambda us: abs(us - channel.neutral_us))
    cap_us = link.lower_cap(farthest_us).cap_us
    span_us = abs(channel.pulse_us(limit) - channel.neutral_us)
    if cap_us - channel.neutral_us < span_us:
        cap = limit * (cap_us - channel.neutral_us) / span_us
        what = f"the Arduino gives at most throttle {cap:.2f} ({cap_us} us), this drive may ask for {limit:.2f}"
        notify(f"{what}: what is above is cut; a reset of the Arduino raises a lowered cap")
    still_wanted()
    return link.arm()

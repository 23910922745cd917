"""The loop: absolute deadlines in a clock of its own, what ends it, and that neutral is the first that follows."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from rover_lib.onboard.car.camera import Frame
from rover_lib.onboard.car.pwm import PwmCalibration
from rover_lib.onboard.car.servo_link import LinkError, State
from rover_lib.onboard.drive.loop import KEEP_S, Hooks, Report, Until, drive
from rover_lib.onboard.drive.motion import Motion
from rover_lib.onboard.drive.pilot import PolicyPilot, Sight
from rover_lib.onboard.drive.plan import Commanded, Plan, Settings
from rover_lib.onboard.drive.watch import NOT_REPORTED, HealthWatch, stop_on_signals
from rover_lib.onboard.errors import CameraError, DriveFault, ParamsError, RoverError
from tests.helpers.fake_drive import Always, Clock, Link, Log

PERIOD = 1 / 30


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def link(clock):
    return Link(clock)


def go(pilot, link, clock, log=None, *, rate_hz=30, until=None, report=None, **hooks):
    times = {"rate_hz": rate_hz, "clock": clock, "sleep": clock.sleep}
    return drive(pilot, link, log or Log(), until=until, hooks=Hooks(**hooks), report=report, **times)


def test_a_command_at_each_absolute_deadline(link, clock):
    log = Log()
    report = go(
        Always(dict.fromkeys(range(30, 60), lambda: clock.sleep(0.02))), link, clock, log, until=Until(ticks=90)
    )
    assert (link.said[0], link.said[-1]) == ("arm", "neutral")
    assert link.sent_at[-1] - link.sent_at[0] == pytest.approx(89 * PERIOD, abs=1e-6)  # nothing adds up
    assert np.diff(link.sent_at[30:59]) == pytest.approx(PERIOD)  # and work does not shift them
    assert (report.ticks, report.missed, report.resent, report.ended) == (90, 0, 0, "90 ticks")
    assert len(log.ticks) == 90 and log.ticks[0].pins_throttle_us == 120
    assert json.loads(json.dumps(report.summary()))["jitter_max_ms"] == pytest.approx(20, abs=0.1)


def test_a_deadline_that_is_missed_is_left_out(link, clock):
    """Work of 80 ms covers the next deadline and a third of the time to the one after it."""
    report = go(Always({30: lambda: clock.sleep(0.08)}), link, clock, until=Until(ticks=60))
    assert (report.ticks, report.missed) == (60, 1)
    assert link.sent_at[-1] - link.sent_at[0] == pytest.approx(60 * PERIOD, abs=1e-6)


def stopped_in_turn(clock, stopped_s, every_s, *, until):
    """Sleeps as a process sleeps that is stopped for a part of each turn, from a second on (SIGSTOP and SIGCONT)."""

    def sleep(seconds):
        end = clock.now + seconds
        begun = (end - 1001) // every_s * every_s + 1001
        if clock.now <= begun + stopped_s and 1001 <= begun < until and end > begun:
            end = max(end, begun + stopped_s)
        clock.now = end

    return sleep


def test_a_loop_that_is_stopped_again_and_again_does_not_drive(link, clock):
    """110 ms of every 150: too short for the Arduino to notice. Stopped once for 140 ms, it drives on."""
    clock.sleep = stopped_in_turn(clock, 0.14, 0.6, until=1001.7)
    report = go(Always(), link, clock, until=Until(ticks=90))
    assert (report.ticks, report.missed) == (90, 6)
    link, clock.now = Link(clock), 1000.0
    clock.sleep = stopped_in_turn(clock, 0.11, 0.15, until=1e9)
    with pytest.raises(DriveFault, match=r"had no time for its ticks .* of the last 500 ms"):
        go(Always(), link, clock, until=Until(ticks=300))
    assert clock.now - 1001 <= 0.15 + 0.11 + PERIOD  # at the second time
    assert link.said[-1] == "neutral"


@pytest.mark.parametrize("rate_hz", [10, 100])
def test_rates_of_a_car(link, clock, rate_hz):
    """Rarer commands are sent again meanwhile: the Arduino stops the car for a host that pauses for 100 ms twice."""
    report = go(Always(), link, clock, rate_hz=rate_hz, until=Until(ticks=20))
    ticks = link.sent_at[0] + np.arange(20) / rate_hz
    assert np.abs(np.subtract.outer(ticks, link.sent_at)).min(axis=1) == pytest.approx(0, abs=1e-6)
    assert np.diff(link.sent_at).max() == pytest.approx(min(1 / rate_hz, KEEP_S))
    assert len(link.drives) == (20 if rate_hz > 30 else 20 * 3 - 2) and report.resent == 0
    for wrong_hz in (9.9, 101, float("nan")):
        with pytest.raises(ParamsError):
            go(Always(), Link(clock), clock, rate_hz=wrong_hz)


def test_ends_as_asked(link, clock):
    assert go(Always({5: "done"}), link, clock).ended == "done"
    assert link.said[-1] == "neutral"
    report = go(Always(), Link(clock), clock, until=Until(max_seconds=1.0))
    assert report.ticks == 31
    stop = threading.Event()
    report = go(Always({7: stop.set}), link := Link(clock), clock, until=Until(stop=stop))
    assert (report.ticks, report.ended, link.said[-1]) == (7, "told to stop", "neutral")
    assert go(Always(), link := Link(clock), clock, until=Until(stop=stop)).ticks == 0  # before it began
    assert "arm" not in link.said


@pytest.mark.parametrize(
    ("what", "raised"),
    [
        (CameraError("cam: it ended", found="3 frames", remedy="is it unplugged?"), DriveFault),
        (LinkError("gone"), DriveFault),
        (ZeroDivisionError("a bug"), ZeroDivisionError),
        (KeyboardInterrupt(), KeyboardInterrupt),
    ],
)
def test_whatever_ends_it_neutral_is_the_first_that_follows(link, clock, what, raised):
    log, report = Log(), Report()
    with pytest.raises(raised) as fault:
        go(Always({4: what}), link, clock, log, report=report)
    assert str(fault.value) == str(what)
    assert link.said == ["arm", (1456, 150), (1456, 150), (1456, 150), "neutral"]
    assert report.ticks == 3
    assert report.ended in log.events  # no fault without its line
    assert report.ended.startswith(str(what) if raised is DriveFault else type(what).__name__)


def test_what_ended_it_is_told_although_neutral_fails_too(link, clock, monkeypatch):
    monkeypatch.setattr(link, "neutral", Mock(side_effect=ZeroDivisionError("another bug")))
    log, report = Log(), Report()
    with pytest.raises(DriveFault, match="unplugged"):
        go(Always({2: CameraError("unplugged")}), link, clock, log, report=report)
    assert report.ended == "unplugged"
    assert any("ZeroDivisionError: another bug" in event for event in log.events)


def test_a_human_says_when(link, clock):
    """All is ready by then; nothing was sent before."""
    pilot = Always()
    pilot.ready = lambda stop: link.said.append("ready")
    report = go(pilot, link, clock, until=Until(ticks=3), arm=lambda: clock.sleep(5) or link.arm())
    assert link.said == ["ready", "arm", *[(1456, 150)] * 3, "neutral"]
    assert report.missed == 0 and link.sent_at[0] == 1005.0  # the deadlines begin when it is armed


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"state": State.MANUAL, "reason": "h"}, "human took over"),
        ({"state": State.STOPPED, "reason": "t"}, "no valid command for 150 ms"),
        ({"state": State.MANUAL, "reason": "r", "boot": 8}, "was reset"),
    ],
)
def test_the_arduino_has_the_last_word(link, clock, change, match):
    with pytest.raises(DriveFault, match=match):
        go(Always({3: lambda: setattr(link, "status", replace(link.status, **change))}), link, clock)
    assert len(link.drives) == 3 and link.said[-1] == "neutral"


@pytest.mark.parametrize(("boot", "why"), [(8, "watchdog"), (7, "unknown reason")])
def test_why_the_arduino_was_reset(link, clock, boot, why):
    link.hello = replace(link.hello, boot=boot, reset="watchdog")  # of the start that is meant, or the one before
    with pytest.raises(DriveFault, match=rf"was reset \({why}\)"):
        go(Always({3: lambda: setattr(link, "status", replace(link.status, boot=8))}), link, clock)


def test_a_port_that_is_stuck_is_said_once(link, clock):
    log, whole, calls = Log(), link.send, iter(range(100))

    def send(*pulses):
        if next(calls) in (0, 1):  # the first two
            raise LinkError("stuck")
        return whole(*pulses)

    link.send = send
    go(Always(), link, clock, log, until=Until(ticks=20))
    assert len([text for text in log.events if "a command was not sent: stuck" in str(text)]) == 1


def test_what_was_not_acknowledged_is_sent_again(clock):
    link = Link(clock, acknowledge=lambda n: n % 3 == 0)  # two of three get lost
    report = go(Always(), link, clock, until=Until(ticks=30))
    assert report.resent >= 15
    assert report.missed == 0
    assert len(link.drives) == 30 + report.resent
    assert max(np.diff(link.sent_at)) < PERIOD + 1e-6


def test_a_dry_run_drives_no_motor_and_tells_its_hooks(clock):
    log, said, rows = Log(), iter([["first"], [], ["third"]]), []
    hooks = {"warnings": lambda: next(said), "record": lambda *row, **extra: rows.append((row, extra))}
    report = go(Always(), None, clock, log, until=Until(max_seconds=2.5), **hooks)
    assert report.ticks == len(log.ticks) == len(rows) and log.ticks[0].state == ""
    assert [e for e in log.events if e in ("first", "third")] == ["first", "third"]
    (_, arduino_ms, *pulses), extra = rows[0]
    assert (arduino_ms, pulses, extra) == (0, [1456, 150, 21316, 1016], {"plan_age_ms": 100.0})


class Eyes:
    wanted_hz = 30.0

    def __init__(self):
        self.frame = Frame(np.zeros((4, 4, 3), np.uint8), 0.0, 1, 0, 100.0, 40.0)

    def wait(self, after, timeout_s):
        return None

    def see(self, now_s, repeats=0, mean=100.0, contrast=40.0):
        self.frame = Frame(self.frame.image, now_s, self.frame.number + 1, repeats, mean, contrast)

    def latest(self):
        return self.frame


class Plans:
    asking_s, strange = 0.0, None

    def __init__(self):
        self.plan = None

    def make(self, now_s, throttle=0.1):
        number = self.plan.number + 1 if self.plan else 1
        self.plan = Plan(number, now_s, now_s, np.tile([0.2, throttle], (32, 1)), strange=self.strange)

    def newest(self):
        return self.plan

    def wait(self, timeout_s):
        return self.plan


@pytest.fixture
def pilot():
    pilot = PolicyPilot(Eyes(), Plans(), Commanded(), Settings(blend_ticks=0), 30.0)
    pilot.eyes, pilot.plans = pilot._camera, pilot._planner
    return pilot


def drives(pilot, seconds, start_s=0.0, throttle=0.1, **seen):
    """Ticks with a fresh plan in each."""
    for i in range(round(seconds / PERIOD)):
        now = start_s + i * PERIOD
        pilot.eyes.see(now, **{k: v(i) if callable(v) else v for k, v in seen.items()})
        pilot.plans.make(now, throttle)
        order = pilot.order(now)
        pilot.sent(now, order)
    return order


def test_orders_are_pulses(pilot):
    order = drives(pilot, 0.5)
    pulses = PwmCalibration().pulses(0.2, 0.1)
    assert (order.steering_us, order.throttle_us) == (pulses.steering_us, pulses.throttle_us)
    assert (order.age_s, order.fade, order.plan) == (0.0, 1.0, 15)


def test_what_the_limit_cuts_is_said_once(pilot):
    drives(pilot, 0.5, throttle=0.2)
    assert list(pilot.warnings()) == []
    assert drives(pilot, 0.5, 0.5, throttle=0.31).throttle == 0.2
    assert "the policy asks for throttle 0.31, cut at throttle_limit 0.2" in next(pilot.warnings())
    drives(pilot, 0.5, 1.0, throttle=0.4)
    assert list(pilot.warnings()) == []


def test_an_unfamiliar_place_ends_the_drive_and_arms_nothing(pilot):
    pilot.check()
    drives(pilot, 0.5)
    pilot.plans.strange = float("nan")
    with pytest.raises(DriveFault, match="seen nothing like these pictures"):
        drives(pilot, 0.6, 0.5)
    assert pilot.eyes.frame.captured_s == pytest.approx(1.0)
    with pytest.raises(RoverError, match="nothing like") as refused:
        pilot.check()
    assert refused.value.kind == "not armed"


def test_a_camera_that_gives_no_more_pictures(pilot):
    """The throttle stayed full for 0.55 s, and was off after 0.98. After a pause, the camera's thread comes first."""
    drives(pilot, 0.5)
    last_s = pilot.eyes.frame.captured_s
    pilot.order(last_s + 0.135)
    with pytest.raises(CameraError):
        pilot.order(last_s + 0.145)
    pilot.eyes.wait = lambda after, timeout_s: replace(pilot.eyes.frame, captured_s=last_s + 0.1)
    pilot.order(last_s + 0.145)


def test_a_frozen_camera_while_the_car_reverses():
    sight = Sight(Eyes(), Settings())
    sight.sent(0.9, -0.1)
    with pytest.raises(CameraError, match="frozen: "):
        sight.watch(Frame(np.zeros((36, 64, 3), np.uint8), 1.1, 9, 8, 100.0, 50.0), 1.1)


def test_a_car_that_stands_may_see_the_same_again(pilot):
    """But from the first throttle on a camera that is frozen has 0.2 s."""
    drives(pilot, 1.0, throttle=0.0, repeats=lambda i: i)
    drives(pilot, 0.12, start_s=1.0, throttle=0.1, repeats=lambda i: 30 + i)  # it has only just been told to go
    drives(pilot, 0.5, start_s=1.12, throttle=0.1)
    drives(pilot, 0.6, start_s=1.62, throttle=0.0)
    drives(pilot, 1.0, start_s=2.22, throttle=0.0, repeats=lambda i: i)
    with pytest.raises(CameraError, match="frozen: 35 frames"):  # at the fifth tick, 0.13 s after the first
        drives(pilot, 1, start_s=3.22, repeats=lambda i: 30 + i)


@pytest.mark.parametrize(("seen", "fault"), [({"mean": 2.0}, "black"), ({"contrast": 0.7}, "nothing is on")])
def test_a_picture_without_anything_on_it(pilot, seen, fault):
    drives(pilot, 0.5)
    drives(pilot, 0.08, start_s=0.5, **seen)
    drives(pilot, 0.1, start_s=0.6)  # light again: the count begins anew
    with pytest.raises(CameraError, match=fault):
        drives(pilot, 0.2, start_s=0.7, **seen)


SCENE = np.random.default_rng(0).integers(30, 220, (9, 16, 3), np.uint8).repeat(20, 0).repeat(20, 1)


NOISE = np.random.default_rng(0)


def noisy(dimmer=1.0, moved_px=0, noise=6, flicker=0.0, at_s=0.0):
    """flicker: of lamps at 100 Hz, a share of their light, through a camera that reads its rows in 25 ms."""
    row_s = at_s + np.arange(180)[:, None, None] / 180 * 0.025
    lamp = dimmer * (1 + flicker * np.sin(2 * np.pi * 100 * row_s))
    shown = np.roll(SCENE, moved_px, 1) * lamp + NOISE.normal(0, noise, SCENE.shape)
    return np.clip(shown, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("throttle", "picture", "stops_s"),
    [
        (lambda s: 0.1, lambda s: noisy(), 1.7),
        (lambda s: -0.1, lambda s: noisy(1 - 0.1 * s), 1.7),  # dimmer light is no motion
        (lambda s: 0.1, lambda s: noisy(flicker=0.05, at_s=1.03 * s), 1.7),
        (lambda s: 0.1, lambda s: noisy(flicker=0.2, at_s=1.03 * s), 1.7),
        (lambda s: 0.1, lambda s: noisy(0.2, noise=8), 1.7),  # in the dark, at a mean of 25
        (lambda s: 0.1, lambda s: noisy(0.13, noise=4), 1.7),
        (lambda s: 0.1, lambda s: noisy(0.2, round(30 * s), 8, 0.2, 1.03 * s), None),  # drives in both
        (lambda s: 0.1 * (s % 0.9 < 0.6), lambda s: noisy(), 2.6),  # it brakes in between
        (lambda s: 0.1, lambda s: noisy(moved_px=round(3 * s)), None),  # it creeps: half a degree a second
        (lambda s: 0.1, lambda s: noisy(moved_px=round(50 * max(0.0, s - 1.3))), None),  # it starts slowly
        (lambda s: 0.015, lambda s: noisy(), None),  # no car moves by that
        (lambda s: 0.1 * (s % 2.5 < 0.6), lambda s: noisy(), None),  # it waits in between
    ],
)
def test_a_car_that_stands_although_its_throttle_is_on(throttle, picture, stops_s):
    motion, ended_s = Motion(1.5), None
    for i in range(round(6 / PERIOD)):
        try:
            motion.watch(Frame(picture(i * PERIOD), 5.0 + i * PERIOD, i, 0, 100.0, 40.0), throttle(i * PERIOD))
        except DriveFault as fault:
            assert "does not move" in str(fault)
            ended_s = i * PERIOD
            break
    assert (ended_s is None) == (stops_s is None) and (ended_s or 0) <= (stops_s or 0)


def test_no_picture_is_nothing_to_drive_by(pilot):
    pilot.eyes.frame = None
    with pytest.raises(CameraError):
        pilot.check()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT])
def test_signals_ask_it_to_stop(number):
    """Also where they are ignored, as a script's & and nohup start their programs."""
    earlier = signal.getsignal(number)
    try:
        for before in (earlier, signal.SIG_IGN):
            signal.signal(number, before)
            stop, log = threading.Event(), Log()
            with stop_on_signals(stop, log):
                os.kill(os.getpid(), number)
                time.sleep(0.01)
                assert stop.is_set()
            assert log.events == [f"{number.name}: stopping"] and signal.getsignal(number) is before
    finally:
        signal.signal(number, earlier)


def test_a_supply_that_stays_low_ends_a_drive_and_heat_is_told():
    now, log, report = [0.0], SimpleNamespace(start_s=0.0, machine={}), Report()
    health = HealthWatch(report, None, log, 3.0, clock=lambda: now[0])
    for now[0], bits, said in (
        (0, "0x0", []),
        (1, "0x50005", ["under-voltage, throttled; plans take longer"]),
        (3, "0x50001", ["under-voltage"]),
        (3.9, "0x50000", []),  # good again
        (5, "0x8", ["soft temperature limit; plans take longer"]),
        (6, None, [NOT_REPORTED]),
        (7, None, []),
        (8, "0x1", ["under-voltage"]),
    ):
        log.machine = {"t_s": now[0], "throttled": bits}
        assert list(health()) == said and report.machine == ("" if bits is None else "".join(said))
    now[0] = 11
    with pytest.raises(DriveFault, match="under-voltage for 3 s"):
        list(health())
    for now[0], bits in ((12, "0x0"), (13, "0x6"), (17, "0x6"), (18, "0x1"), (19, None), (20, None)):
        log.machine = {"t_s": now[0], "throttled": bits}
        list(health())  # hot for long, and then low for a moment
    now[0], log.machine = 21, {"t_s": 21, "throttled": "0x1"}
    with pytest.raises(DriveFault, match="for 3 s"):  # what was not read for a moment is not good again
        list(health())
    now[0] = 32
    assert list(health()) == [NOT_REPORTED]  # what was read long ago is not known


@pytest.mark.slow
def test_a_loop_that_is_dead_ends_the_process():
    """In a process, since it ends that; a loop that ticks, or has ended, does not."""
    code = """
import sys, time
from rover_lib.onboard.drive import loop, watch
watch.HUNG_S = 0.3
class Log:
    event = close = lambda self, *said, **_: print(*said, flush=True)
report = loop.Report(ticks=0)
with watch.exit_if_hung(report, Log()):
    time.sleep(0.6)  # not begun
    for report.ticks in range(1, 30):
        time.sleep(0.03)
    report.ended = sys.argv[1]
    time.sleep(1.5)
print("alive")
"""
    done = subprocess.run([sys.executable, "-c", code, ""], capture_output=True, text=True)
    assert done.returncode == 3 and "the loop has not ticked" in done.stdout
    done = subprocess.run([sys.executable, "-c", code, "ended"], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "alive\n")

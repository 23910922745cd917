"""What is written of a human who took over: each status once, who drove by it, and what ends it."""

import threading
from dataclasses import replace
from itertools import pairwise

import pytest

from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.servo_link import LinkError, State, Telemetry
from rover_lib.onboard.drive.takeover import LET_GO_S, TakeoverRecorder, driver_by
from rover_lib.onboard.recording.episode import HUMAN, NOBODY, POLICY

ARMED = Telemetry(99.0, 7, 0, 0, "k", State.AUTONOMOUS, "a", "-", 1456, 120, 238, 1460, 21316, 120, 1016, 0, 0, 0, 0)
STEP_S = 0.02  # between two statuses


def manual(steering_us=1600, throttle_us=180, **changes):
    """A status of a human whose pulses go to the servos."""
    pins = {"steering_us": steering_us, "throttle_us": throttle_us}
    receiver = {"receiver_steering_us": steering_us, "receiver_throttle_us": throttle_us}
    state = {"state": State.MANUAL, "reason": "h", "result": "i"}
    return replace(ARMED, **(state | pins | receiver | changes))


LOST = {"steering_us": 1456, "throttle_us": 120, "receiver_steering_us": 1600, "receiver_throttle_us": None,
        "receiver_throttle_period_us": None}  # fmt: skip


class Time(threading.Event):
    """Virtual time, which waiting moves on."""

    def __init__(self):
        super().__init__()
        self.now_s = 100.0

    def wait(self, timeout=None):
        self.now_s += timeout
        return self.is_set()

    def clock(self):
        return self.now_s


class Link:
    """Says what `said` gives for a time since 100 s, anew every STEP_S. It can be told nothing: no method is there."""

    calibration = Car().pwm

    def __init__(self, time, said):
        self._time, self._said = time, said
        self.turned = self.at(0)

    def at(self, number):
        status = self._said(number * STEP_S)
        if isinstance(status, Exception):
            raise status
        return replace(status, host_s=100 + number * STEP_S, uptime_ms=number * 20)

    def latest(self):
        return self.at(int((self._time.now_s - 100 + 1e-9) / STEP_S))


class Written:
    """In the place of a Recorder."""

    def __init__(self):
        self.rows, self.failure = [], None

    def control(self, *row, **columns):
        self.rows.append((row, columns))

    @property
    def drivers(self):
        return [columns["driver"] for _, columns in self.rows]


def human(said, *, written=None, armed=ARMED, over=lambda time: None, commands=()):
    """What is written of a human whose statuses are `said`, and how it ended."""
    time, written = Time(), written or Written()
    recorder = TakeoverRecorder(written, "static")
    for row in commands:
        recorder.command(*row)
    link = Link(time, said)
    takeover = recorder.human(link, armed, rate_hz=30, stop=time, over=lambda: over(time), clock=time.clock)
    return takeover, written


def let_go_at(end_s):
    return lambda t_s: manual() if t_s < end_s else manual(1470, 124)


# ---- who drives


@pytest.mark.parametrize(
    ("status", "driver"),
    [
        (ARMED, POLICY),
        (manual(receiver_steering_us=1604), HUMAN),  # a step of the Arduino's clock
        (manual(receiver_steering_us=1605), NOBODY),
        (manual(throttle_us=120, receiver_throttle_us=180), NOBODY),  # it waits until it was at rest
        (manual(**LOST), NOBODY),
        (manual(state=State.STOPPED), NOBODY),
    ],
)
def test_who_drives(status, driver):
    assert driver_by(status) == driver


def test_each_status_is_written_once_with_its_own_time_and_pulses():
    takeover, written = human(let_go_at(1.0))
    times_s = [row[0] for row, _ in written.rows]
    assert times_s[0] == 100 and all(0 < b - a < 0.041 for a, b in pairwise(times_s))
    assert takeover.controls == {HUMAN: len(written.rows), NOBODY: 0}
    row, columns = written.rows[10]
    assert row == (times_s[10], round((times_s[10] - 100) * 1000), 1600, 180, 21316, 1016) and columns == {
        "driver": HUMAN
    }


def test_no_pulse_is_no_number():
    _, written = human(lambda t_s: manual(**LOST) if 0.5 < t_s < 1 else let_go_at(1.5)(t_s))
    lost = [row for row, columns in written.rows if columns["driver"] == NOBODY]
    assert len(lost) > 10 and {row[3] for row in lost} == {row[5] for row in lost} == {None}
    assert {row[2] for row in lost} == {1600}  # what the receiver still says


# ---- what ends it


def test_it_ends_when_the_human_lets_go_and_not_at_a_short_rest():
    takeover, _ = human(lambda t_s: let_go_at(0.5)(t_s) if t_s < 2.0 else let_go_at(3.0)(t_s))
    assert takeover.ended == f"the sticks have been at rest for {LET_GO_S:g} s" and not takeover.fault
    assert takeover.seconds == pytest.approx(3.0 + LET_GO_S, abs=0.06)


@pytest.mark.parametrize(("steering_us", "rests"), [(1508, True), (1509, False), (1411, False)])
def test_rest_is_where_the_sticks_were_when_the_car_was_armed(steering_us, rests):
    takeover, _ = human(lambda t_s: manual(steering_us, 120))
    assert (takeover.seconds < 3) == rests


def test_rest_is_neutral_where_nothing_is_known_of_arming():
    assert human(lambda t_s: manual(1456 + 48, 120), armed=None)[0].seconds == pytest.approx(LET_GO_S, abs=0.1)


def test_it_ends_when_the_transmitter_is_off():
    takeover, written = human(lambda t_s: manual() if t_s < 1 else manual(**LOST))
    assert "no signal for 2 s" in takeover.ended and takeover.seconds == pytest.approx(3.0, abs=0.1)
    assert written.drivers[-1] == NOBODY


def full(written, time):
    written.failure = "the disk is full" if time.now_s > 101 else None


@pytest.mark.parametrize(
    ("later", "over", "ended", "fault"),
    [
        (LinkError("fake port: silent"), None, "silent", True),
        (manual(boot=8), None, "reset", True),  # its clock begins anew, and its pins were loose for a while
        (ARMED, None, "another program", False),
        (None, lambda written, time: time.set() if time.now_s > 101 else None, "told to stop", False),
        (None, lambda written, time: "enough" if time.now_s > 101 else None, "enough", False),
        (None, full, "nothing more can be recorded", False),
    ],
    ids=["link", "reset", "armed", "signal", "asked", "disk"],
)
def test_what_else_ends_it(later, over, ended, fault):
    written = Written()
    takeover, _ = human(
        lambda t_s: manual() if later is None or t_s < 1 else later,
        written=written,
        over=lambda time: over(written, time) if over else None,
    )
    assert ended in takeover.ended and takeover.fault is fault and takeover.seconds < 1.2
    assert len(written.rows) > 25 and written.rows[-1][0][0] < 101.2 and POLICY not in written.drivers
    assert f"{takeover.controls[HUMAN]} of human" in str(takeover)


# ---- the policy's last command


COMMANDS = [(s, 0, 1567, 209, 21316, 1016) for s in (99.90, 99.933, 99.966)]


@pytest.mark.parametrize(
    ("result", "at_s", "kept"),
    [
        ("k", 100.0, 3),  # the Arduino took it, and then the stick moved
        ("i", 100.0, 2),  # the stick had moved before it came
        ("k", 99.96, 2),  # that was known before it was sent
    ],
)
def test_a_command_that_was_not_taken_is_not_written(result, at_s, kept):
    time, written = Time(), Written()
    recorder = TakeoverRecorder(written, "static")
    for row in COMMANDS:
        recorder.command(*row, plan_age_ms=80.0)
    link = Link(time, let_go_at(0.5))
    link.turned = replace(manual(), host_s=at_s, result=result)
    recorder.human(link, ARMED, rate_hz=30, stop=time, clock=time.clock)
    policy = [(row, columns) for row, columns in written.rows if columns["driver"] == POLICY]
    assert [row for row, _ in policy] == COMMANDS[:kept]
    assert {(columns["mode"], columns["plan_age_ms"]) for _, columns in policy} == {("static", 80.0)}
    assert written.drivers[kept] == HUMAN and written.rows[kept][0][0] == at_s

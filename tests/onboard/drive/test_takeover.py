"""What is written of a human who took over: each status once, who drove by it, and what ends it."""

import threading
from dataclasses import replace
from types import SimpleNamespace

import pytest

from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.servo_link import LinkError, State, Telemetry
from rover_lib.onboard.drive.feed import TAKEN
from rover_lib.onboard.drive.loop import Report
from rover_lib.onboard.drive.session import Session
from rover_lib.onboard.drive.takeover import TakeoverRecorder, driver_by
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


class Human(threading.Event):
    """A human in virtual time, which waiting moves on, in the places of clock, link, recorder and stop.

    The link says `manual()` for a second from 100 s on, and then what comes `later`, anew every STEP_S. It can be told
    nothing: no method is there. commands: what the policy had sent.
    """

    calibration = Car().pwm

    def __init__(self, later, turned=None, commands=()):
        super().__init__()
        self.later, self.now_s = later, 100.0
        self.turned = turned or self.latest()
        self.rows, self.failure = [], None
        self.recorder = TakeoverRecorder(self, "static")
        for row in commands:
            self.recorder.command(*row, plan_age_ms=80.0)

    def wait(self, timeout=None):
        self.now_s += timeout
        return self.is_set()

    def clock(self):
        return self.now_s

    def latest(self):
        number = int((self.now_s - 100 + 1e-9) / STEP_S)
        status = manual() if number * STEP_S < 1 else self.later
        if isinstance(status, Exception):
            raise status
        return replace(status, host_s=100 + number * STEP_S, uptime_ms=number * 20)

    def control(self, *row, **columns):
        self.rows.append((row, columns))

    def drive(self, over=lambda human: None):
        return self.recorder.human(
            self, ARMED, rate_hz=30, stop=self, over=lambda: over(self) if self.now_s > 101 else None, clock=self.clock
        )


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


def test_a_status_is_written_with_its_own_time_and_pulses_and_no_pulse_is_no_number():
    human = Human(manual(**LOST))
    human.drive()
    assert human.rows[0] == ((100.0, 0, 1600, 180, 21316, 1016), {"driver": HUMAN})
    lost = [row for row, columns in human.rows if columns["driver"] == NOBODY]
    assert len(lost) > 10 and {row[2:] for row in lost} == {(1600, None, 21316, None)}


@pytest.mark.parametrize(("steering_us", "rests"), [(1508, True), (1509, False), (1411, False)])
def test_rest_is_where_the_sticks_were_when_the_car_was_armed(steering_us, rests):
    takeover = Human(manual(steering_us, 120)).drive()
    assert (takeover.seconds < 4) == rests and ("at rest for 2 s" in takeover.ended) == rests


@pytest.mark.parametrize(
    ("later", "over", "ended", "after_s", "fault"),
    [
        (LinkError("fake port: silent"), None, "silent", 1.0, True),
        (manual(boot=8), None, "reset", 1.0, True),  # its clock begins anew, and its pins were loose for a while
        (manual(**LOST), None, "no signal for 2 s", 3.0, False),
        (manual(), threading.Event.set, "told to stop", 1.0, False),
        (manual(), lambda human: "enough", "enough", 1.0, False),
        (manual(), lambda human: setattr(human, "failure", "full"), "nothing more can be recorded", 1.0, False),
    ],
)
def test_what_else_ends_it(later, over, ended, after_s, fault):
    human = Human(later)
    takeover = human.drive(over or (lambda human: None))
    assert ended in takeover.ended and takeover.fault is fault and takeover.seconds == pytest.approx(after_s, abs=0.1)
    assert len(human.rows) > 25 and all(columns["driver"] != POLICY for _, columns in human.rows)
    assert f"{takeover.controls[HUMAN]} of human" in str(takeover)


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
    human = Human(manual(1470, 124), replace(manual(), host_s=at_s, result=result), COMMANDS)
    human.drive()
    policy = [(row, columns) for row, columns in human.rows if columns["driver"] == POLICY]
    assert policy == [(row, {"mode": "static", "driver": POLICY, "plan_age_ms": 80.0}) for row in COMMANDS[:kept]]
    assert human.rows[kept][0][0] == at_s and human.rows[kept][1] == {"driver": HUMAN}


def test_the_view_ends_the_recording_of_a_human():
    """Its stop is heard then too; and the service's watchdog is fed meanwhile."""
    asked, shown, alive = ["stopped from the view", None], [], []
    feed = SimpleNamespace(over=asked.pop, show=lambda phase, *rest: shown.append(phase))
    service = SimpleNamespace(alive=lambda: alive.append(True))
    session = SimpleNamespace(service=service, report=Report(), feed=feed, camera=None, link=None)
    assert [Session._human_over(session) for _ in range(2)] == [None, "stopped from the view"]
    assert shown == [TAKEN, TAKEN] and alive == [True, True] and session.report.status

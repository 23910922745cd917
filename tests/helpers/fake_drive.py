"""What a control loop's tests need: time that passes only while somebody sleeps, a link, a log and a pilot."""

from dataclasses import replace

from rover_lib.onboard.car.pwm import PwmCalibration
from rover_lib.onboard.car.servo_link import MISSING, Hello, State, Telemetry
from rover_lib.onboard.drive.pilot import Order

STATUS = Telemetry(0.0, 7, 0, 0, "k", State.AUTONOMOUS, "a", "-", 1456, 120, 238, None, None, None, None, 0, 0, 0, 0)


class Clock:
    """Time that passes only while somebody sleeps."""

    def __init__(self):
        self.now, self.on_sleep = 1000.0, lambda: None

    def __call__(self):
        return self.now

    def sleep(self, seconds):
        assert seconds >= 0
        self.now += seconds
        self.on_sleep()


class Link:
    """Acknowledges at once what it is told to, and writes down everything: (when, what)."""

    port, calibration, remedy, garbled = "fake", PwmCalibration(), MISSING.get, 0

    def __init__(self, clock, acknowledge=lambda n: True):
        self.clock, self.acknowledge = clock, acknowledge
        self.said, self.sent_at, self.status, self.sequence = [], [], STATUS, 0
        self.hello = Hello(4, "4.2.0", 7, 0, "reset pin")

    def arm(self):
        self.said.append("arm")
        return self.latest()

    def neutral(self):
        self.said.append("neutral")
        self.status = replace(self.status, state=State.STOPPED, reason="n", throttle_us=120)
        return self.status

    def send(self, steering_us, throttle_us):
        self.sequence += 1
        self.said.append((steering_us, throttle_us))
        self.sent_at.append(self.clock())
        if self.acknowledge(self.sequence):
            self.status = replace(self.status, sequence=self.sequence)
        return self.sequence

    def latest(self):
        return replace(self.status, host_s=self.clock())

    def unacknowledged_s(self, now_s):
        unanswered = self.sent_at[self.latest().sequence :]
        return now_s - unanswered[0] if unanswered else 0.0

    @property
    def drives(self):
        return [s for s in self.said if isinstance(s, tuple)]


class Log:
    start_s = 1000.0

    def __init__(self):
        self.ticks, self.events = [], []

    def tick(self, row):
        self.ticks.append(row)

    def event(self, text, **_):
        self.events.append(text)


class Always:
    """A pilot with one order; `at` maps ticks to what happens in them."""

    plan = None

    def __init__(self, at=None):
        self.at, self.n = at or {}, 0

    def ready(self, stop):
        pass

    def order(self, now_s):
        self.n += 1
        what = self.at.get(self.n)
        if isinstance(what, BaseException):
            raise what
        if callable(what):
            what()
        return None if what == "done" else Order(0.0, 0.05, 1456, 150, self.n, 0.1, 0.05, 1.0, self.n)

    def sent(self, at_s, order):
        pass

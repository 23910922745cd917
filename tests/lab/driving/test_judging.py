"""How pulses are judged, by made-up ones: each gate by what it must not let pass. Whole rows are in test_rows.py."""

import numpy as np
import pytest

from balloon_world.simulated_arduino import PinEvent
from lab.driving.pins import CONTINUES, HUMAN, STOPPED, Command, Observation, judge, periods_of
from rover_lib.onboard.car.car import Car

AT, START, END = 100.0, 99.5, 102.0
DRIVEN = (1567, 209)


def then(*steps):
    """What is done from a time on: (seconds since the fault, steering_us, throttle_us or None); driven before."""

    def what(t):
        return next((us for since, *us in reversed(steps) if t >= since), DRIVEN)

    return what


def seen(what):
    """An observation of pins that do this, while the drive commands the same as before."""
    events = []
    for i, (pin, period_us) in enumerate(periods_of(Car()).items()):
        times = np.arange(START, END, period_us * 1e-6).tolist()
        pulses = [(at, what(at - AT)[i]) for at in times]
        events += [PinEvent(at, "pulse", pin, us, period_us) for at, us in pulses if us is not None]
    sent = [Command(float(t), *DRIVEN) for t in np.arange(START - 0.5, END, 1 / 30)]
    return Observation(sorted(events, key=lambda e: e.end_s), sent, AT, END)


@pytest.mark.parametrize(
    ("expected", "what", "sentence"),
    [
        (STOPPED, then((0.1, 1456, 120)), None),
        (STOPPED, then((0.26, 1456, 120)), "throttle off 26"),
        (STOPPED, then((0.1, 1500, 120)), "steering at 1500 us"),
        (STOPPED, then((-0.5, 1456, 120)), "not driving"),
        (STOPPED, then((0.1, 1456, 120), (1.5, 1456, None)), "0 throttle pulses"),
        (HUMAN, then((0.02, 1600, 140)), None),
        (HUMAN, then((0.06, 1600, 140)), "the human's pulses after"),
        (CONTINUES, then(), None),
        (CONTINUES, then((1.0, 1700, 209), (1.03, *DRIVEN)), "steering at 1700 us"),
        (CONTINUES, then((1.0, 1567, 120), (1.01, *DRIVEN)), "throttle at 120 us"),
    ],
)
def test_a_judgement(expected, what, sentence):
    _, wrong = judge(expected, seen(what), human_us=(1600, 140))
    assert any(sentence in w for w in wrong) if sentence else wrong == []

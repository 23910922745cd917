"""How faults are judged, by made-up pulses, each gate by what it must not let pass."""

from dataclasses import replace

import numpy as np
import pytest

from balloon_world.simulated_arduino import PinEvent
from lab.arduino.emulator import REPOSITORY
from lab.driving import on_pins
from lab.driving.pins import CONTINUES, HUMAN, REFUSED, STOPPED, Command, Gates, Observation, judge, periods_of
from rover_lib.onboard.car.car import Car, read_car

GATES = Gates(stopped_ms=250, throttle_max_us=124, takeover_ms=50, rows=60, stopped_rows=30)
AT, START, END = 100.0, 99.5, 102.0
DRIVEN = (1567, 209)


def pulses(what, car=None):
    """Events of both pins; what(seconds since the fault) gives steering_us, throttle_us, None for no pulse."""
    events = []
    for i, (pin, period_us) in enumerate(periods_of(car or Car()).items()):
        at, last = START, START - period_us * 1e-6
        while at < END:
            us = what(at - AT)[i]
            if us is not None:
                events.append(PinEvent(at, "pulse", pin, us, (at - last) * 1e6))
                last = at
            at += period_us * 1e-6
    return sorted(events, key=lambda e: e.end_s)


def commanded(what, end=END):
    return [Command(float(t), *what(t - AT)) for t in np.arange(START - 0.5, end, 1 / 30)]


def verdict(expected, what, *, commands=None, **more):
    return judge(expected, Observation(pulses(what), commands or commanded(what), AT, END), GATES, **more)


def then(*steps):
    """What is done from a time on: (seconds since the fault, steering_us, throttle_us); driven before."""

    def what(t):
        now = DRIVEN
        for since, *us in steps:
            now = tuple(us) if t >= since else now
        return now

    return what


def fading(begin=0.48, end=0.97):
    def what(t):
        t = int(t * 30 + 100) / 30 - 100 / 30  # a tick's
        share = min(max((t - begin) / (end - begin), 0), 1)
        return (1567 if share < 1 else 1456, round(209 - 89 * share))

    return what


def test_what_is_as_expected():
    stopped = verdict(STOPPED, then((0.1, 1456, 120)))
    assert stopped.wrong == []
    assert stopped.figures["stopped_after_ms"] == pytest.approx(100, abs=2)
    assert (stopped.figures["max_throttle_us_after"], stopped.figures["steering_us_after"]) == (120, 1456)
    assert verdict(STOPPED, then((0.1, 1460, 123)), human_us=(1460, 120)).wrong == []  # after a reset, in manual
    assert verdict(REFUSED, lambda t: (1456, 120)).wrong == []
    human = verdict(HUMAN, then((0.02, 1600, 140)), human_us=(1600, 140))
    assert human.wrong == [] and 20 < human.figures["takeover_ms"] < 45
    before = commanded(then((0.48, 1500, 180), (0.98, *DRIVEN)))
    assert verdict(CONTINUES, then((0.5, 1500, 180), (1.0, *DRIVEN)), commands=before).wrong == []
    limited = verdict(CONTINUES, fading(), commands=commanded(lambda t: fading()(t + 0.002)), until_limit=True)
    assert limited.wrong == [] and 480 < limited.figures["fades_after_ms"] < 560


@pytest.mark.parametrize(
    ("what", "sentence"),
    [
        (then((0.26, 1456, 120)), "throttle off 26"),
        (then((0.1, 1456, 120), (1.0, 1456, 128), (1.005, 1456, 120)), "throttle at 128 us"),
        (then((0.1, 1500, 120)), "steering at 1500 us"),
        (lambda t: (1456, 120), "not driving"),
        (then((0.1, 1456, 120), (1.5, 1456, None)), "0 throttle pulses"),
        (then((0.1, 1456, 120), (1.5, None, 120)), "0 steering pulses"),
    ],
)
def test_not_stopped(what, sentence):
    assert any(sentence in w for w in verdict(STOPPED, what).wrong)


def test_a_pulse_that_a_reset_cut_is_a_pulse():
    events = [*pulses(then((0.1, 1456, 120))), PinEvent(AT + 0.5, "cut", "throttle", 300.0, 0.0)]
    assert judge(STOPPED, Observation(events, [], AT, END), GATES).figures["max_throttle_us_after"] == 300


def test_a_car_that_reverses_moves_backwards_too():
    car = read_car(REPOSITORY / "lab" / "cars" / "crawler.yml")
    seen = Observation(pulses(then((0.1, 1500, 1500), (0.3, 1500, 1480), (0.4, 1500, 1500)), car), [], AT, END)
    assert judge(STOPPED, seen, Gates.of_params(car), car=car).figures["stopped_after_ms"] > 380


def test_not_refused():
    assert any("not to be armed" in w for w in verdict(REFUSED, then()).wrong)


@pytest.mark.parametrize(
    ("what", "sentence"),
    [
        (then((0.06, 1600, 140)), "the human's pulses after"),
        (then((0.02, 1600, 140), (1.0, *DRIVEN), (1.05, 1600, 140)), "the human's pulses after 10"),
        (then((0.02, 1600, 209)), "throttle was never the human's"),
        (then(), "steering was never the human's"),
    ],
)
def test_not_human(what, sentence):
    assert any(w.startswith(sentence) for w in verdict(HUMAN, what, human_us=(1600, 140)).wrong)


@pytest.mark.parametrize(
    ("what", "commands", "sentence"),
    [
        (then((1.0, 1700, 209), (1.02, *DRIVEN)), commanded(lambda t: DRIVEN), "steering at 1700 us"),
        (then((1.0, 1567, 400), (1.002, *DRIVEN)), commanded(lambda t: DRIVEN), "throttle at 400 us"),
        (then((1.0, 1567, 120), (1.1, *DRIVEN)), commanded(then((0.95, 1567, 120), (1.05, *DRIVEN))), "the throttle"),
        (then((1.0, None, 209), (1.03, *DRIVEN)), commanded(lambda t: DRIVEN), "a steering pulse out of time"),
        (then(), commanded(lambda t: DRIVEN, end=AT + 1), "steering at 1567 us"),
        # Commanded, but long ago:
        (then((1.0, 1500, 180), (1.1, *DRIVEN)), commanded(then((0.3, 1500, 180), (0.4, *DRIVEN))), "steering at 1500"),
    ],
)  # fmt: skip
def test_not_continued(what, commands, sentence):
    judged = verdict(CONTINUES, what, commands=commands)
    assert any(w.startswith(sentence) for w in judged.wrong), judged.wrong


@pytest.mark.parametrize(
    ("what", "sentence"),
    [(fading(0.1), "the throttle fades after"), (fading(end=1.4), "throttle off after"), (then(), "the car was never")],
)
def test_not_limited(what, sentence):
    judged = verdict(CONTINUES, what, commands=commanded(lambda t: what(t + 0.002)), until_limit=True)
    assert any(w.startswith(sentence) for w in judged.wrong), judged.wrong


def test_a_row_that_this_machine_spoilt_is_known():
    fault = on_pins.PinRow("a fault", "link", CONTINUES, "", "", lambda bench: None)
    steady = Observation(pulses(then()), commanded(then()), AT, END)
    assert not on_pins._spoilt(fault, steady, GATES)
    paused = replace(steady, commands=[c for c in steady.commands if not 0.5 < c.at_s - AT < 0.65])
    assert on_pins._spoilt(fault, paused, GATES)  # rover drive did not get its turn
    assert not on_pins._spoilt(replace(fault, starves=True), paused, GATES)
    for kind in ("stall", "lost"):
        stalled = replace(steady, events=[*steady.events, PinEvent(AT + 1, kind, "", 30_000.0, 0.0)])
        assert on_pins._spoilt(fault, stalled, GATES)
    assert on_pins._spoilt(fault, replace(steady, events=pulses(lambda t: (1456, 120))), GATES)

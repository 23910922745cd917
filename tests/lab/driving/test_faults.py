"""How faults are judged, by made-up pulses, each gate by what it must not let pass; the cable; and some real rows."""

import errno
import os
import pty
import random
import re
import select
import statistics
import time
import tty
from dataclasses import replace

import cv2
import needs
import numpy as np
import pytest
import serial
from click.testing import CliRunner

from balloon_world.simulated_arduino import PinEvent
from lab.__main__ import main
from lab.arduino.emulator import REPOSITORY
from lab.driving import faults, policy
from lab.driving.bench import FaultError
from lab.driving.cable import Cable, dropping, flipping
from lab.driving.pins import CONTINUES, HUMAN, PERIOD_US, REFUSED, STOPPED, Command, Gates, Observation, judge
from lab.driving.row import FaultRow
from lab.driving.rows import FAULTS, KINDS
from lab.driving.stories import KEPT
from rover_lib.onboard.car.servo_link import frame
from rover_lib.onboard.errors import PolicyError
from rover_lib.onboard.policy.load import load_policy

GATES = Gates(stopped_ms=250, throttle_max_us=124, takeover_ms=50, rows=60, stopped_rows=30, bytes_us=4)
AT, START, END = 100.0, 99.5, 102.0
DRIVEN = (1567, 209)


def pulses(what, start=START, end=END, pins=PERIOD_US):
    """Events of both pins; what(seconds since the fault) gives steering_us, throttle_us, None for no pulse."""
    events = []
    for i, pin in enumerate(PERIOD_US):
        at, last = start, start - PERIOD_US[pin] * 1e-6
        while at < end and pin in pins:
            us = what(at - AT)[i]
            if us is not None:
                events.append(PinEvent(at, "pulse", pin, us, (at - last) * 1e6))
                last = at
            at += PERIOD_US[pin] * 1e-6
    return sorted(events, key=lambda e: e.end_s)


def commanded(what, start=START - 0.5, end=END):
    return [Command(float(t), *what(t - AT)) for t in np.arange(start, end, 1 / 30)]


def verdict(expected, what, *, commands=None, end=END, **more):
    seen = Observation(pulses(what, end=end), commanded(what) if commands is None else commands, AT, end)
    return judge(expected, seen, GATES, **more)


def then(*steps):
    """What is done from a time on: (seconds since the fault, steering_us, throttle_us); driven before."""

    def what(t):
        now = DRIVEN
        for since, *us in steps:
            now = tuple(us) if t >= since else now
        return now

    return what


# ---- stopped


def test_stopped():
    judged = verdict(STOPPED, then((0.1, 1456, 120)))
    assert judged.wrong == []
    assert judged.figures["stopped_after_ms"] == pytest.approx(100, abs=2)
    assert judged.figures["max_throttle_us_after"] == 120
    assert judged.figures["steering_us_after"] == 1456


def test_after_a_reset_the_resting_stick_counts_as_neutral():
    assert verdict(STOPPED, then((0.1, 1460, 123)), human_us=(1460, 120)).wrong == []


@pytest.mark.parametrize(
    ("what", "sentence"),
    [
        (then((0.26, 1456, 120)), "throttle off 26"),
        (then((0.1, 1456, 120), (1.0, 1456, 209), (1.005, 1456, 120)), "throttle off 100"),
        (then((0.1, 1456, 120), (1.0, 1456, 128), (1.005, 1456, 120)), "throttle at 128 us"),
        (then((0.1, 1456, 128)), "throttle at 128 us"),
        (then((0.1, 1500, 120)), "steering at 1500 us"),
        (lambda t: (1456, 120), "not driving"),
        (then((0.1, 1456, 120), (1.5, 1456, None)), "0 throttle pulses"),
        (then((0.1, 1456, 120), (1.5, None, 120)), "0 steering pulses"),
    ],
)
def test_not_stopped(what, sentence):
    assert any(w.startswith(sentence) or sentence in w for w in verdict(STOPPED, what, commands=[]).wrong)


def test_a_pulse_that_a_reset_cut_is_a_pulse():
    events = pulses(then((0.1, 1456, 120)))
    events.append(PinEvent(AT + 0.5, "cut", "throttle", 300.0, 0.0))
    judged = judge(STOPPED, Observation(events, [], AT, END), GATES)
    assert judged.figures["max_throttle_us_after"] == 300
    assert judged.wrong


# ---- refused


def test_refused():
    assert verdict(REFUSED, lambda t: (1456, 120), commands=[]).wrong == []
    assert any("not to be armed" in w for w in verdict(REFUSED, then(), commands=[]).wrong)
    floating = verdict(REFUSED, lambda t: (1456, 120) if t < 1 else (None, None), commands=[])
    assert any("0 throttle pulses" in w for w in floating.wrong)


# ---- human


def test_human():
    judged = verdict(HUMAN, then((0.02, 1600, 140)), human_us=(1600, 140))
    assert judged.wrong == []
    assert 20 < judged.figures["takeover_ms"] < 45


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


# ---- continues


def test_continues():
    before = commanded(then((0.48, 1500, 180), (0.98, *DRIVEN)))
    judged = verdict(CONTINUES, then((0.5, 1500, 180), (1.0, *DRIVEN)), commands=before)
    assert judged.wrong == []
    assert judged.figures["stopped_after_ms"] is None


def test_what_is_commanded_may_be_a_step_of_the_timer_away():
    assert verdict(CONTINUES, lambda t: (1567.4, 208.1), commands=commanded(lambda t: DRIVEN)).wrong == []
    assert verdict(CONTINUES, lambda t: (1567.4, 212.1), commands=commanded(lambda t: DRIVEN)).wrong


@pytest.mark.parametrize(
    ("what", "commands", "sentence"),
    [
        (then((1.0, 1700, 209), (1.02, *DRIVEN)), commanded(lambda t: DRIVEN), "steering at 1700 us"),
        (then((1.0, 1567, 400), (1.002, *DRIVEN)), commanded(lambda t: DRIVEN), "throttle at 400 us"),
        (then((1.0, 1567, 120), (1.01, *DRIVEN)), commanded(lambda t: DRIVEN), "throttle at 120 us"),
        (then((1.0, 1567, 120), (1.1, *DRIVEN)), commanded(then((0.95, 1567, 120), (1.05, *DRIVEN))), "the throttle"),
        (then((1.0, None, 209), (1.03, *DRIVEN)), commanded(lambda t: DRIVEN), "a steering pulse out of time"),
        (then((1.0, 1567, None), (1.002, *DRIVEN)), commanded(lambda t: DRIVEN), "a throttle pulse out of time"),
        (then(), commanded(lambda t: DRIVEN, end=AT + 1), "steering at 1567 us"),
        # Commanded, but long ago:
        (then((1.0, 1500, 180), (1.1, *DRIVEN)), commanded(then((0.3, 1500, 180), (0.4, *DRIVEN))), "steering at 1500"),
    ],
)  # fmt: skip
def test_not_continued(what, commands, sentence):
    judged = verdict(CONTINUES, what, commands=commands)
    assert any(w.startswith(sentence) for w in judged.wrong), judged.wrong


def fading(begin=0.48, end=0.97):
    def what(t):
        t = int(t * 30 + 100) / 30 - 100 / 30  # a tick's
        share = min(max((t - begin) / (end - begin), 0), 1)
        return (1567 if share < 1 else 1456, round(209 - 89 * share))

    return what


def test_continues_until_a_limit():
    commands = commanded(lambda t: fading()(t + 0.002))
    judged = verdict(CONTINUES, fading(), commands=commands, until_limit=True)
    assert judged.wrong == []
    assert 480 < judged.figures["fades_after_ms"] < 560
    assert 900 < judged.figures["stopped_after_ms"] < 980


@pytest.mark.parametrize(
    ("what", "sentence"),
    [
        (fading(0.1), "the throttle fades after"),
        (then((0.98, 1456, 120)), "the throttle fades after"),
        (fading(end=1.4), "throttle off after"),
        (then(), "the car was never stopped"),
    ],
)
def test_not_limited(what, sentence):
    commands = commanded(lambda t: what(t + 0.002))
    judged = verdict(CONTINUES, what, commands=commands, until_limit=True)
    assert any(w.startswith(sentence) for w in judged.wrong), judged.wrong


def test_a_machine_that_stalled_is_known():
    events = pulses(then((0.1, 1456, 120)))
    assert Observation(events, [], AT, END).stalled_ms() == 0
    assert Observation([*events, PinEvent(AT + 1, "stall", "", 30_000.0, 0.0)], [], AT, END).stalled_ms() == 30
    assert Observation([*events, PinEvent(AT - 1, "stall", "", 30_000.0, 0.0)], [], AT, END).stalled_ms() == 0
    assert Observation([*events, PinEvent(AT + 1, "lost", "", 5.0, 0.0)], [], AT, END).stalled_ms() > 1e6


def test_a_row_that_this_machine_spoilt_is_known():
    fault = FaultRow("link", "a fault", CONTINUES, lambda bench: None, "", "", None)
    steady = Observation(pulses(then()), commanded(then()), AT, END)
    assert not faults._spoilt(fault, steady, GATES)
    commands = [c for c in steady.commands if not 0.5 < c.at_s - AT < 0.65]
    paused = replace(steady, commands=commands)  # rover drive did not get its turn
    assert faults._spoilt(fault, paused, GATES)
    assert not faults._spoilt(replace(fault, starves=True), paused, GATES)
    assert not faults._spoilt(replace(fault, paused_s=0.15), paused, GATES)  # it is the fault itself
    assert faults._spoilt(replace(fault, paused_s=0.1), paused, GATES)
    assert not faults._spoilt(replace(fault, expected=STOPPED), paused, GATES)
    standing = replace(steady, events=pulses(lambda t: (1456, 120) if t < -0.1 else DRIVEN))
    assert faults._spoilt(replace(fault, expected=STOPPED), standing, GATES)


def test_the_gates_are_those_of_params():
    assert Gates.of_params() == GATES


def test_every_row_is_one_of_a_kind_and_there_are_enough():
    names = [f.name for f in FAULTS]
    assert len(set(names)) == len(names) >= GATES.rows
    assert sum(f.expected == STOPPED for f in FAULTS) >= GATES.stopped_rows
    assert all(kind.rows and {f.kind for f in kind.rows} == {name} for name, kind in KINDS.items())
    assert all(f.message and (f.method or f.start == "disk") for f in FAULTS)
    assert all(f.limits or f.until_limit for f in FAULTS if f.expected == CONTINUES)


# ---- bytes


SENT = [(1456, 120), (1600, 236), (1100, 160), (1456, 120)]
TIMES = [5.0 + 0.25 * i for i in range(len(SENT))]


def steps_of(values, slew=faults.SLEW_US_PER_MS, step_s=0.25, start=10.0):
    """Events of pins that hold each value for step_s, slewing there as the firmware does, in whole microseconds."""

    def what(t):
        t += AT - start
        step = min(int(t / step_s), len(values) - 1)
        ms = int((t - step * step_s) * 1e3) + 1
        pins = []
        for pin, before, value in zip(PERIOD_US, values[max(step - 1, 0)], values[step], strict=True):
            way = min(abs(value - before), slew[pin] * ms)
            pins.append(before + way if value > before else before - way)
        return pins

    return pulses(what, start, start + step_s * len(values))


def compared(values, **more):
    return faults.compare_steps(steps_of(values, **more), SENT, TIMES)


def test_steps_that_come_out_as_they_went_in():
    for slew in (faults.SLEW_US_PER_MS, {"steering": 1e6, "throttle": 1e6}):
        found = compared(SENT, slew=slew)
        assert (found["steering_steps"], found["throttle_steps"]) == (4, 4)
        assert found["worst_us"] <= GATES.bytes_us  # the last pulse of the way is as near
        assert found["worst_ms"] < 25
        assert found["pulses"] > 700


@pytest.mark.parametrize(
    ("values", "worst_us"),
    [
        ([SENT[0], (1600, 244), *SENT[2:]], 8),  # too far
        ([SENT[0], (1600, 228), *SENT[2:]], 8),  # not far enough: it looks as if it were on the way, for too long
        ([*SENT[:2], SENT[3], SENT[3]], 356),  # a step is missing
    ],
)
def test_steps_that_come_out_otherwise(values, worst_us):
    assert compared(values)["worst_us"] >= worst_us


def test_steps_that_are_slower_than_the_firmware_is_are_found():
    slow = {pin: limit / 2 for pin, limit in faults.SLEW_US_PER_MS.items()}
    assert compared(SENT, slew=slow)["worst_us"] > 20


def test_a_pulse_the_wrong_way_is_found():
    events = steps_of(SENT)
    on_the_way = next(i for i, e in enumerate(events) if e.pin == "throttle" and e.pulse_us > 180)
    events[on_the_way] = events[on_the_way]._replace(pulse_us=130.0)
    assert faults.compare_steps(events, SENT, TIMES)["worst_us"] > 50


def test_steps_that_do_not_come_to_their_end():
    assert faults.compare_steps(steps_of(SENT[:3]), SENT, TIMES)["worst_us"] is None
    events = [e for e in steps_of(SENT) if e.monotonic_s < 10.75 + 0.02]
    assert faults.compare_steps(events, SENT, TIMES)["worst_us"] > 20


# ---- the policy


@pytest.fixture(scope="module")
def obedient(tmp_path_factory):
    path = tmp_path_factory.mktemp("faults") / "policy.pt"
    policy.make_artifact(path)
    loaded = load_policy(path)
    policy.obey(loaded)
    return loaded


def planned(obedient, instruction):
    jpegs = policy.pictures(instruction)
    assert len(set(jpegs)) == len(jpegs)
    plans = [
        obedient.predict_unclipped(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR), np.zeros(2))
        for jpeg in jpegs[:3]
    ]
    assert all(np.array_equal(plans[0], other) for other in plans)
    return plans[0]


@pytest.mark.slow
def test_the_policy_does_what_the_picture_tells_it_to(obedient):
    assert np.allclose(planned(obedient, policy.PLAIN), policy.PLAN)
    assert np.allclose(planned(obedient, policy.OTHER), policy.OTHER_PLAN)
    assert np.allclose(planned(obedient, policy.OUT_OF_RANGE), 5.0)
    start = time.monotonic()
    assert np.allclose(planned(obedient, policy.SLOW), policy.PLAN)
    assert 0.85 < time.monotonic() - start < 3
    with pytest.raises(PolicyError, match="NaN"):
        planned(obedient, policy.NAN)
    with pytest.raises(Exception, match="told to fail by the picture"):
        planned(obedient, policy.RAISE)


# ---- the cable


class Pty:
    """An Arduino's end."""

    def __init__(self):
        self.master, slave = pty.openpty()
        tty.setraw(slave)
        self.port = os.ttyname(slave)
        os.close(slave)

    def read(self, wanted, within_s=20.0):
        data, end = b"", time.monotonic() + within_s
        while len(data) < wanted and select.select([self.master], [], [], max(0, end - time.monotonic()))[0]:
            try:
                data += os.read(self.master, 4096)
            except OSError as error:  # until the cable opens it
                assert error.errno == errno.EIO
                time.sleep(0.002)
        return data


@pytest.fixture
def ends():
    """The Arduino's end, the cable, and the host's, open."""
    board = Pty()
    cable = Cable(board.port)
    host = serial.Serial(cable.port, 115200, timeout=20, write_timeout=20, exclusive=True)
    host.write(b"x")
    assert board.read(1) == b"x"
    yield board, cable, host
    host.close()
    cable.unplug()
    os.close(board.master)


def test_a_cable_carries_both_ways(ends):
    board, cable, host = ends
    for i in range(200):
        line = frame(f">D 1 {i} 0 1500 200")
        host.write(line)
        assert board.read(len(line)) == line
        os.write(board.master, line)
        assert host.read(len(line)) == line
    assert cable.commands[7][1:] == (1500, 200)
    assert len(cable.commands) == 200
    assert all(a.at_s <= b.at_s for a, b in zip(cable.commands, cable.commands[1:], strict=False))


@pytest.mark.release
def test_a_cable_has_no_delay(ends):
    board, _, host = ends
    delays_s = []
    for _ in range(200):
        start = time.perf_counter()
        host.write(b"123456789\n")
        board.read(10)
        delays_s.append(time.perf_counter() - start)
    assert statistics.median(delays_s) < 0.001


def test_only_the_drives_own_whole_lines_are_commands(ends):
    board, cable, host = ends
    good, other = frame(">D 1 7 0 1500 200"), frame(">D 1 8 0 1600 300")
    cable.not_ours.add(other[:-1])
    cable.to_arduino = lambda data: b""
    host.write(b">D 1 6 15" + good + other + good.replace(b"1500", b"1501") + b"AT\r\n")
    needs.until(lambda: cable.commands)
    assert board.read(1, 0.1) == b""
    assert [c[1:] for c in cable.commands] == [(1500, 200)]
    cable.inject(good)
    assert board.read(len(good)) == good


def test_a_stuck_cable_blocks_and_an_unplugged_one_fails(ends):
    _, cable, host = ends
    host.write_timeout = 0.01
    cable.stick()
    with pytest.raises(serial.SerialTimeoutException):
        host.write(b"abc")
    cable.unplug()
    with pytest.raises(serial.SerialException):
        host.read(1)


def test_spoiling():
    rng = random.Random(1)
    data = bytes(range(256)) * 100
    changed = flipping(rng, 0.01)(data)
    bits = [bin(a ^ b).count("1") for a, b in zip(data, changed, strict=True)]
    assert max(bits) == 1
    assert 0.008 < sum(bits) / len(data) < 0.012
    lines = [b"%d\n" % i for i in range(1000)]
    drop = dropping(rng, 0.3)
    kept = b"".join(drop(line[:2]) + drop(line[2:]) for line in lines).splitlines(keepends=True)
    assert set(kept) < set(lines)
    assert 650 < len(kept) < 750


# ---- the command


def test_a_fault_that_is_none():
    done = CliRunner().invoke(main, ["faults", "--only", "camera melted"])
    assert done.exit_code == 1
    assert "no fault ['camera melted']" in done.output
    with pytest.raises(FaultError):
        faults.run_faults(["camera melted"])
    with pytest.raises(FaultError, match="kind"):
        faults.run_faults(kinds=["weather"])


@pytest.mark.emulated
@needs.simavr
def test_some_faults_on_the_pins(tmp_path):
    """One of each kind, one whose line only the next start writes, and a recording's replay; `make faults` has all."""
    names = ["camera frozen", "SIGKILL", "human takes over by steering", "old line replayed"]
    outcome = faults.run_faults([*names, "bytes"])
    assert outcome.wrong == []
    assert outcome.bytes["steering_steps"] == outcome.bytes["throttle_steps"] == outcome.bytes["steps"]
    content = outcome.write(tmp_path / "faults.json")
    rows = {row["fault"]: row for row in content["metrics"]["faults"]}
    assert set(rows) == set(names)
    assert all(row["recovered"] and row["log_line"] for row in rows.values())
    assert rows["SIGKILL"]["kind"] == "operator"
    assert rows["SIGKILL"]["stopped_after_ms"] > 50  # it is the Arduino that stops
    assert 0 < content["metrics"]["summary"]["takeover_ms"] <= 50


# ---- what docs/safety.md names


def test_what_proves_safety_exists():
    """Each name in the last column of the page's tables is a row of the bench, a kept story, or a test."""
    text = (REPOSITORY / "docs" / "safety.md").read_text()
    rows = [line.split("|") for line in text.splitlines() if line.startswith("| ") and "proven by" not in line]
    cells = [row[-2] for row in rows]
    tests = {
        name
        for path in (REPOSITORY / "tests").rglob("test_*.py")
        for name in re.findall(r"def (test_\w+)", path.read_text())
    }
    for cell in cells:
        names = re.findall(r"`([^`]+)`", cell)
        assert names, f"a hazard that nothing proves: {cell}"
        assert set(names) <= {f.name for kind in KINDS.values() for f in kind.rows} | KEPT.keys() | tests

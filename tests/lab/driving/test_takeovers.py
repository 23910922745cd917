"""Who drove, as a recording says it, against the firmware's own pins: in virtual time exactly, and in simavr whole."""

import json
import time
from bisect import bisect_right

import needs
import numpy as np
import pytest

from balloon_world.simulated_arduino import REST_US
from lab.driving.bench import AT_SPEED_S, END_S, START_S, Drive, DrivingBench, FaultError
from lab.driving.faults import ATTEMPTS
from lab.driving.pins import HUMAN as BY_HUMAN
from lab.driving.pins import STEP_US, Gates, Observation, judge
from lab.driving.virtual import FRAME_MS, LOST, STICKS_US, World
from lab.driving.virtual_host import RATE_HZ, Process
from rover_lib.onboard.drive.takeover import LET_GO_S, TakeoverRecorder
from rover_lib.onboard.errors import TakenOver
from rover_lib.onboard.recording.episode import HUMAN, NOBODY, POLICY
from rover_lib.workshop.recordings.episodes import load_recordings

# ---- in virtual time: the real firmware's state machine, link, loop and plans


class Steps:
    """What each wait of the takeover's recorder is: the world goes on."""

    def __init__(self, world):
        self._world = world

    def is_set(self):
        return False

    def wait(self, seconds):
        self._world.sleep(seconds)


class Rows:
    """In the place of a Recorder."""

    failure = None

    def __init__(self):
        self.rows = []

    def control(self, *row, **columns):
        self.rows.append((row[0], row[1], columns["driver"], row[2:4]))


class Recorded(Process):
    """A drive that is recorded, through the human's takeover too."""

    def __init__(self, world):
        super().__init__(world, service=False)
        self.written, self.takeover = Rows(), None

    def _drive(self, link, report):
        recorder, world = TakeoverRecorder(self.written, "static"), self.world
        self.record = recorder.command
        try:
            super()._drive(link, report)
        except TakenOver:
            written = list(world.written)
            options = {"rate_hz": RATE_HZ, "stop": Steps(world), "clock": world.clock}
            self.takeover = recorder.human(link, self.armed, **options)
            assert world.written == written, "something was sent to a car that is the human's"
            raise


def mixed(*happenings, make=Recorded):
    """A drive in which a human does things: (milliseconds, what is done to the hand). The world, and the process."""
    world = World()
    process = make(world)

    def wiggle(throw_us):
        world.hand.sticks[0] = STICKS_US[0] + throw_us
        world.handle()

    for at_ms, throw_us in ((1400, 300), (1500, -300), (1600, 0)):
        world.at(at_ms, lambda us=throw_us: wiggle(us))
    for at_ms, change in happenings:
        world.at(at_ms + 1800, lambda change=change: (change(world.hand), world.handle()))
    world.sleep(2.8)
    process.run()
    world.close()
    return world, process


def sticks(steering_us, throttle_us):
    def change(hand):
        hand.sticks[:] = STICKS_US[0] + steering_us, STICKS_US[1] + throttle_us

    return change


def lost(hand):
    hand.receiver = LOST


def there(hand):
    hand.receiver = "live"


KNOWN_MS = 101  # a receiver that falls silent is known, by the firmware's design; until then its last pulses count


def hands_at(world, ms):
    """The pulses of each channel, without none, that the receiver has sent lately; a set for each."""
    lately = [hand for at, hand in world.seen.hands if ms - KNOWN_MS < at <= ms]
    lately.append([hand for at, hand in world.seen.hands if at <= max(0, ms - KNOWN_MS)][-1])
    return [{hand.pulses()[channel] for hand in lately} - {0} for channel in (0, 1)]


def drivers_by_pins(world):
    """A function of a millisecond: who drove, by what the pins did and what the receiver had sent."""
    found = {}

    def truly(ms):
        if ms not in found:
            pins = world.seen.pins[bisect_right(world.seen.pins, ms, key=lambda pin: pin[0]) - 1][1]
            steering, throttle = hands_at(world, ms)
            follows = pins.state == b"M" and pins.steering_us in steering and pins.throttle_us in throttle
            found[ms] = POLICY if pins.state == b"A" else HUMAN if follows else NOBODY
        return found[ms]

    return truly


MIXED = (
    (2600, sticks(200, 0)),  # takes over
    (3300, sticks(-200, 80)),
    (4000, lost),
    (4700, there),  # the throttle is held: it waits until it was at rest
    (5400, sticks(-200, 0)),
    (5800, sticks(100, 60)),
    (6600, sticks(0, 0)),
)


@needs.gcc
@pytest.mark.slow
def test_every_frame_of_a_mixed_drive_says_who_drove():
    """To a tick, whenever within one the stick moves; and then until the human lets go."""
    farthest_ms, judged = 0.0, 0
    for later_ms in range(0, 34, 3):
        world, process = mixed(*((ms + later_ms, change) for ms, change in MIXED))
        assert process.takeover.ended == f"the sticks have been at rest for {LET_GO_S:g} s"
        rows = process.written.rows
        times_ms = np.array([s for s, *_ in rows]) * 1e3
        assert np.all(np.diff(times_ms) > 0)
        assert {driver for _, _, driver, _ in rows} == {POLICY, HUMAN, NOBODY}
        truly = drivers_by_pins(world)
        changes = [ms for ms in range(round(times_ms[0]), world.seen.end_ms) if truly(ms - 1) != truly(ms)]
        for frame_ms in np.arange(times_ms[0] + 1, times_ms[-1], FRAME_MS / 10):  # wherever a frame may lie
            said = rows[int(np.abs(times_ms - frame_ms).argmin())][2]
            judged += 1
            if said != truly(int(frame_ms)):
                farthest_ms = max(farthest_ms, min(abs(frame_ms - ms) for ms in changes))
    print(f"{judged} moments judged; who drove is wrong for at most {farthest_ms:.1f} ms beside a change")
    assert judged > 10_000 and farthest_ms <= FRAME_MS


@needs.gcc
def test_what_is_written_of_the_human_is_what_the_receiver_measured():
    world, process = mixed(*MIXED)
    truly = drivers_by_pins(world)
    start_ms = world.seen.starts[-1]
    humans = [row for row in process.written.rows if row[2] != POLICY]
    assert len(humans) > 150
    for _, uptime_ms, driver, pulses_us in humans:
        ms = start_ms + uptime_ms
        assert driver == truly(ms)
        assert all(us is None or us in sent for us, sent in zip(pulses_us, hands_at(world, ms), strict=True))


@needs.gcc
def test_the_pins_are_the_humans_as_soon_whether_it_is_recorded_or_not():
    def pins_of(world):
        return [(ms, event.steering_us, event.throttle_us) for ms, event in world.seen.pins]

    happenings = (*MIXED[:1], (3300, sticks(0, 0)))
    recorded, process = mixed(*happenings)
    alone, _ = mixed(*happenings, make=lambda world: Process(world, service=False))
    assert process.takeover is not None
    assert recorded.seen.commands == alone.seen.commands and len(alone.seen.commands) > 30
    assert recorded.written == alone.written  # every line, to the byte
    assert pins_of(recorded)[: len(pins_of(alone))] == pins_of(alone)
    assert (1656, 120) in {pins[1:] for pins in pins_of(alone)}


@needs.gcc
def test_a_transmitter_that_is_switched_off_ends_the_recording():
    _, process = mixed((2600, sticks(200, 0)), (3200, lost))
    assert "no signal" in process.takeover.ended and process.written.rows[-1][2] == NOBODY


# ---- whole: `rover drive --record`, the real firmware in simavr, real time

PHASES = (  # seconds, and the transmitter's pulses from rest; None: off. Of the default car: 20 us of throttle are rest
    (0.6, (144, 20)),
    (0.6, (-180, 60)),
    (0.6, None),
    (0.5, (-180, 60)),  # there again: the throttle is held until it was at rest
    (0.4, (-180, 0)),
    (0.6, (100, 70)),
)
BESIDE_S = 0.09  # of a change, within which a frame is not judged: a tick, a status, and a machine that is busy
LATELY_S = 0.15  # what the pins may still follow: a receiver that fell silent, a pulse of 21 ms


class MixedDrive:
    """One `rover drive --record` that a human takes over; what was seen."""

    def __init__(self, bench, folder):
        self.bench, self.folder, self.sent = bench, folder, []
        make = type("RecordedDrive", (Drive,), {"arguments": ("--record", folder)})
        drive = bench.start(make=make)
        end = time.monotonic() + START_S
        while not bench.driving:
            bench.wait(0.05)
            if not drive.running or time.monotonic() > end:
                raise FaultError(f"rover drive did not drive: {drive.last_words()}")
        bench.arduino.ready(False)
        bench.wait(AT_SPEED_S)
        bench.events = bench.events[-3000:]
        self.at_s = time.monotonic()
        for seconds, moved in PHASES:
            self.transmit(moved)
            bench.wait(seconds)
        self.transmit((0, 0))
        bench.wait(LET_GO_S + 0.5)
        self.code = drive.wait(END_S)
        bench.wait(0.1)
        self.words = drive.last_words()
        self.offset_s = time.time() - time.monotonic()
        commands = [c for c in bench.cable.commands if c.at_s > self.at_s - 1]
        self.seen = Observation(bench.events, commands, self.at_s, self.at_s + PHASES[0][0] - 0.05)
        self.late_commands = [c for c in bench.cable.commands if c.at_s > self.at_s + 0.3]

    def transmit(self, moved):
        pulses = (0, 0) if moved is None else tuple(rest + us for rest, us in zip(REST_US, moved, strict=True))
        self.sent.append((time.monotonic(), pulses))
        self.bench.arduino.transmitter(*pulses)

    @property
    def spoilt(self):
        """This machine had no time for it: not for the Arduino, the loop, or who records."""
        if self.seen.stalled_ms() or not self.seen.was_driving(GATES.throttle_max_us) or self.code != 4:
            return True
        return max(np.diff([row["system_timestamp"] for row in self.content()["control_samples"]])) > 0.1

    def content(self):
        (episode,) = self.folder.iterdir()
        return json.loads((episode / "episode_data.json").read_text())

    def driver(self, at_s, pins):
        """Who drove, by the pulses that both pins have just had, and by what the transmitter had sent."""
        lately = [pulses for since_s, pulses in self.sent if at_s - LATELY_S < since_s <= at_s]
        lately += [pulses for since_s, pulses in self.sent if since_s <= at_s - LATELY_S][-1:] or [REST_US]
        human = all(any(abs(us - pulses[i]) <= STEP_US for pulses in lately) for i, us in enumerate(pins))
        if human:
            return HUMAN
        commanded = [c for c in self.seen.commands if at_s - 0.25 < c.at_s <= at_s]
        return POLICY if commanded and at_s < self.at_s + BESIDE_S else NOBODY


GATES = Gates.of_params()


@pytest.fixture(scope="module")
def taken_over(tmp_path_factory):
    """A mixed drive that this machine had time for, and its episodes."""
    with DrivingBench() as bench:
        for attempt in range(ATTEMPTS):
            folder = tmp_path_factory.mktemp(f"attempt{attempt}") / "episodes"
            try:
                found = MixedDrive(bench, folder)
            except FaultError:
                if attempt + 1 < ATTEMPTS:
                    continue
                raise
            if not found.spoilt:
                break
        return found, folder


@pytest.mark.emulated
@needs.simavr
def test_a_recorded_takeover_is_as_fast_and_ends_as_before(taken_over):
    found, _ = taken_over
    human_us = tuple(rest + us for rest, us in zip(REST_US, PHASES[0][1], strict=True))
    verdict = judge(BY_HUMAN, found.seen, GATES, human_us=human_us)
    print(f"the human's pulses after {verdict.figures['takeover_ms']} ms, recorded")
    assert verdict.wrong == [] and found.code == 4, found.words
    assert found.late_commands == []  # nothing is sent to a car that is the human's


@pytest.mark.emulated
@needs.simavr
def test_every_frame_says_who_drove_as_the_pins_of_the_emulated_arduino_do(taken_over):
    found, folder = taken_over
    content = found.content()
    recordings = load_recordings(folder, chunk=4)
    assert content["metadata"]["takeover"]["ended"] == f"the sticks have been at rest for {LET_GO_S:g} s"
    assert not {f.kind for f in recordings.faults} & {"unsorted_control_times", "serial_burst", "unknown_driver"}
    pulses = {pin: [e for e in found.seen.events if e.pin == pin] for pin in ("steering", "throttle")}
    ends = {pin: [e.end_s for e in events] for pin, events in pulses.items()}

    def truly(at_s):
        pins = [pulses[pin][bisect_right(ends[pin], at_s) - 1].pulse_us for pin in pulses]
        return found.driver(at_s, pins)

    judged = dict.fromkeys((POLICY, HUMAN, NOBODY), 0)
    frames = content["frame_samples"]
    for sample in recordings.samples:
        at_s = frames[sample.row]["timestamp"] - found.offset_s
        around = {truly(at_s + beside_s) for beside_s in np.linspace(-BESIDE_S, BESIDE_S, 9)}
        if at_s > found.at_s - 1 and len(around) == 1:
            assert sample.driver == around.pop(), f"{(at_s - found.at_s) * 1e3:.0f} ms after the takeover"
            judged[sample.driver] += 1
    print(f"frames that say who drove as the pins do: {judged}, of {len(recordings.samples)} samples")
    assert judged[HUMAN] > 40 and judged[POLICY] > 10 and judged[NOBODY] > 5

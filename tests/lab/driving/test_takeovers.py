"""Who drove, as a recording says it, against the firmware's own pins, in virtual time."""

import functools
from bisect import bisect_right
from dataclasses import replace

import needs
import numpy as np
import pytest

from lab.driving.virtual import FRAME_MS, LIVE, LOST, World
from lab.driving.virtual_host import Process
from rover_lib.onboard.drive.takeover import LET_GO_S
from rover_lib.onboard.recording.episode import HUMAN, NOBODY, POLICY


class Rows:
    """In the place of a Recorder."""

    failure = path = takeover = None

    def __init__(self, world):
        self.rows, self._world, self._written = [], world, None

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        pass

    def control(self, *row, **columns):
        self.rows.append((row[0], row[1], columns["driver"], row[2:4]))
        if columns["driver"] != POLICY:
            self._written = self._written or len(self._world.written)

    def note(self, takeover):
        self.takeover = takeover
        assert self._written == len(self._world.written), "something was sent to a car that is the human's"

    def close(self, fault):
        assert fault is None


class Recorded(Process):
    """A drive that is recorded, through the human's takeover too."""

    def __init__(self, world, service=False):
        super().__init__(world, service)
        self.written = Rows(world)
        self.session.options = replace(self.session.options, record="nowhere")
        self.session.make_recorder = lambda folder, room: self.written


def mixed(*happenings, service=False):
    """A drive in which a human does things: (milliseconds, what is done to the hand). The world, and the process."""
    world = World()
    process = Recorded(world, service)
    gesture = [(-400, sticks(300, 0)), (-300, sticks(-300, 0)), (-200, sticks(0, 0))]
    for at_ms, change in (*gesture, *happenings):
        world.at(at_ms + 1800, lambda change=change: (change(world.hand), world.handle()))
    world.sleep(2.8)
    if service:
        world.at(3600, process.ask)
        world.at(6000, process.ask)  # while the human drives
        world.at(12_500, process.ask)
        world.at(14_000, process.stopped.set)
    process.run()
    world.close()
    return world, process


def sticks(steering_us, throttle_us, receiver=LIVE):
    def change(hand):
        hand.sticks[:] = 1456 + steering_us, 120 + throttle_us
        hand.receiver = receiver

    return change


KNOWN_MS = 101  # a receiver that falls silent is known, by the firmware's design; until then its last pulses count


def hands_at(world, ms):
    """The pulses of each channel, without none, that the receiver has sent lately; a set for each."""
    lately = [hand for at, hand in world.seen.hands if ms - KNOWN_MS < at <= ms]
    lately.append([hand for at, hand in world.seen.hands if at <= max(0, ms - KNOWN_MS)][-1])
    return [{hand.pulses()[channel] for hand in lately} - {0} for channel in (0, 1)]


def driver_by_pins(world, ms):
    """Who drove, by what the pins did and what the receiver had sent."""
    pins = world.seen.pins[bisect_right(world.seen.pins, ms, key=lambda pin: pin[0]) - 1][1]
    steering, throttle = hands_at(world, ms)
    follows = pins.state == b"M" and pins.steering_us in steering and pins.throttle_us in throttle
    return POLICY if pins.state == b"A" else HUMAN if follows else NOBODY


MIXED = (
    (2600, sticks(200, 0)),  # takes over
    (3300, sticks(-200, 80)),
    (4000, sticks(-200, 80, LOST)),
    (4700, sticks(-200, 80)),  # the throttle is held: it waits until it was at rest
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
        assert process.written.takeover["ended"] == f"the sticks have been at rest for {LET_GO_S:g} s"
        rows = process.written.rows
        times_ms = np.array([s for s, *_ in rows]) * 1e3
        assert np.all(np.diff(times_ms) > 0)
        assert {driver for _, _, driver, _ in rows} == {POLICY, HUMAN, NOBODY}
        truly = functools.cache(functools.partial(driver_by_pins, world))
        changes = [ms for ms in range(round(times_ms[0]), world.seen.end_ms) if truly(ms - 1) != truly(ms)]
        for frame_ms in np.arange(times_ms[0] + 1, times_ms[-1], FRAME_MS / 10):  # wherever a frame may lie
            said = rows[int(np.abs(times_ms - frame_ms).argmin())][2]
            judged += 1
            if said != truly(int(frame_ms)):
                farthest_ms = max(farthest_ms, min(abs(frame_ms - ms) for ms in changes))
    assert judged > 10_000 and farthest_ms <= FRAME_MS


@needs.gcc
def test_after_a_takeover_the_service_waits_for_another_request():
    """With the port open: opened again, it might reset the Arduino, and the human would lose the car."""
    gesture = (9000, sticks(300, 0)), (9100, sticks(-300, 0)), (9200, sticks(0, 0))
    world, process = mixed((2600, sticks(200, 0)), (5000, sticks(0, 0)), *gesture, service=True)
    assert [words for _, _, words in world.seen.drives] == ["the human took over with the transmitter", "told to stop"]
    assert sum(line.startswith(b">C") or line.startswith(b">A") for line in world.written) > 0
    assert process.session.planner.newest() and len(world.seen.starts) == 1
    assert any("rest" in text for _, text in world.seen.log)
    assert process._operators._rounds > 4 * 30  # the watchdog is fed while the human is recorded

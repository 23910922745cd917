"""A human takes over from a service that records, with the firmware's own statuses, in virtual time."""

from dataclasses import replace
from itertools import groupby

import needs

from lab.driving.virtual import LIVE, LOST, World
from lab.driving.virtual_host import Process
from rover_lib.onboard.recording.episode import HUMAN, NOBODY, POLICY


class Rows:
    """In the place of a Recorder."""

    failure = path = takeover = None

    def __init__(self, world):
        self.drivers, self._world, self._written = [], world, None

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        pass

    def control(self, *row, **columns):
        self.drivers.append(columns["driver"])
        if columns["driver"] != POLICY:
            self._written = self._written or len(self._world.written)

    def note(self, takeover):
        self.takeover = takeover
        assert self._written == len(self._world.written), "something was sent to a car that is the human's"

    def close(self, fault):
        assert fault is None


def sticks(steering_us, throttle_us, receiver=LIVE):
    def change(hand):
        hand.sticks[:] = 1456 + steering_us, 120 + throttle_us
        hand.receiver = receiver

    return change


@needs.gcc
def test_a_human_who_takes_over_is_recorded_and_then_the_service_waits_for_another_request():
    """With the port open: opened again, it might reset the Arduino, and the human would lose the car."""
    world = World()
    gesture = (sticks(300, 0), sticks(-300, 0), sticks(0, 0))
    happens = [*zip((1400, 1500, 1600), gesture, strict=True), *zip((13_000, 13_100, 13_200), gesture, strict=True)]
    happens += [(4400, sticks(200, 0)), (5100, sticks(-200, 80)), (5800, sticks(-200, 80, LOST))]
    # After the loss the throttle is held: it waits until it was at rest.
    happens += [(6500, sticks(-200, 80)), (7200, sticks(-200, 0)), (8400, sticks(0, 0))]
    for at_ms, change in happens:
        world.at(at_ms, lambda change=change: (change(world.hand), world.handle()))
    process = Process(world, service=True)
    written = Rows(world)
    process.session.options = replace(process.session.options, record="nowhere")
    process.session.make_recorder = lambda folder, room: written
    world.sleep(2.8)
    for at_ms in (3600, 6000, 14_500):  # the second while the human drives
        world.at(at_ms, process.ask)
    world.at(17_000, process.stopped.set)
    process.run()
    world.close()
    assert [words for _, _, words in world.seen.drives] == ["the human took over with the transmitter", "told to stop"]
    assert len(world.seen.starts) == 1
    assert [driver for driver, _ in groupby(written.drivers)] == [POLICY, HUMAN, NOBODY, HUMAN, POLICY]
    assert "at rest" in written.takeover["ended"]
    assert process._operators._rounds > 4 * 30  # the watchdog is fed while the human is recorded

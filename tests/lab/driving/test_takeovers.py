"""A human takes over from a service that records, with the firmware's own statuses, in virtual time."""

from dataclasses import replace
from itertools import groupby
from unittest.mock import MagicMock

from lab.driving.virtual import LIVE, LOST, World
from lab.driving.virtual_host import Process
from rover_lib.onboard.recording.episode import HUMAN, NOBODY, POLICY
from tests.helpers import needs


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
    recorder, sent = MagicMock(failure=None, path=None, takeover=None), set()
    recorder.__enter__.return_value = recorder
    recorder.__exit__.return_value = None
    recorder.control.side_effect = lambda *row, driver, **_: sent.add(len(world.written)) if driver != POLICY else None
    recorder.note.side_effect = lambda takeover: sent.add(len(world.written))
    process.session.options = replace(process.session.options, record="nowhere")
    process.session.make_recorder = lambda folder, room: recorder
    world.sleep(2.8)
    for at_ms in (3600, 6000, 14_500):  # the second while the human drives
        world.at(at_ms, process.ask)
    world.at(17_000, process.stopped.set)
    process.run()
    world.close()
    assert [words for _, _, words in world.seen.drives] == ["the human took over with the transmitter", "told to stop"]
    assert len(world.seen.starts) == 1
    drivers = [call.kwargs["driver"] for call in recorder.control.call_args_list]
    assert [driver for driver, _ in groupby(drivers)] == [POLICY, HUMAN, NOBODY, HUMAN, POLICY]
    assert len(sent) == 1, "something was sent to a car that is the human's"
    assert "at rest" in recorder.note.call_args.kwargs["takeover"]["ended"]
    assert all(call.args == (None,) for call in recorder.close.call_args_list)
    assert process._operators._rounds > 4 * 30  # the watchdog is fed while the human is recorded

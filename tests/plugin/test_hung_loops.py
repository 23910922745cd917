"""A loop of LeRobot's that hangs leaves a stopped car: with the real firmware, on its pins."""

import ctypes
import time

import needs
import pytest

from balloon_world.simulated_arduino import REST_US
from lab.arduino.emulator import NICE, EmulatedArduino
from lab.driving.pins import STOPPED, Gates, Observation, judge

GATES = Gates.of_params()
HUNG_S = 1.0


def sleeps():
    """Something else takes its time: other threads go on."""
    time.sleep(HUNG_S)


def keeps_the_interpreter():
    """Native code that never gives other threads a turn: not even the drive's own."""
    ctypes.PyDLL(None).usleep(int(HUNG_S * 1e6))


@pytest.mark.emulated
@pytest.mark.slow
@needs.simavr
@pytest.mark.parametrize("hangs", [sleeps, keeps_the_interpreter])
@pytest.mark.parametrize("where", ["before an action", "after an action"])
@needs.real_time
def test_a_hung_loop_leaves_a_stopped_car(make_rover, hangs, where):
    with EmulatedArduino(transmitter=REST_US, ready=True, nice=NICE) as board:
        rover, _ = make_rover(board.port)
        rover.connect()
        try:
            end_s = time.monotonic() + 1.0
            while time.monotonic() < end_s:
                rover.get_observation()
                rover.send_action({"steering": 0.2, "throttle": 0.15})
                at_s = time.monotonic()
                time.sleep(0.02)
            if where == "before an action":
                rover.get_observation()
            events = board.pulses()
            hangs()
            events += board.pulses()
        finally:
            rover.disconnect()
    seen = Observation(events, [], at_s, at_s + HUNG_S)
    verdict = judge(STOPPED, seen, GATES)
    if verdict.wrong and seen.stalled_ms():
        raise needs.Late(f"the emulated Arduino had no time for {seen.stalled_ms():.0f} ms: {verdict.wrong}")
    assert verdict.wrong == []
    print(f"{hangs.__name__}, {where}: throttle off after {verdict.figures['stopped_after_ms']:g} ms")

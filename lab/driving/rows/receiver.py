"""Faults of transmitter and receiver, and what the human who holds the transmitter does."""

from balloon_world.simulated_arduino import REST_US
from lab.driving.bench import DrivingBench
from lab.driving.pins import HUMAN, NEUTRAL_US, PERIOD_US, REFUSED, STOPPED
from lab.driving.row import FaultKind

FAULTS = FaultKind("receiver")
PRESET_US = 280  # by how much a preset throttle is above rest


def _moved(steering_us: float, throttle_us: float) -> tuple[float, float]:
    """Return the transmitter's pulses with the sticks moved from rest by that much."""
    return REST_US[0] + steering_us, REST_US[1] + throttle_us


@FAULTS.add("receiver lost", STOPPED, "transmitter's signal was lost", "no pulses on the receiver's pins")
def _lose_receiver(bench: DrivingBench) -> None:
    bench.arduino.transmitter(0, 0)


@FAULTS.add("receiver's throttle channel lost", STOPPED, "transmitter's signal was lost", "no pulses on that pin")
def _lose_throttle(bench: DrivingBench) -> None:
    bench.arduino.transmitter(REST_US[0], 0)


@FAULTS.add(
    "no transmitter at the start", REFUSED, "the transmitter gives no signal", "no pulses from before the drive"
)
def _begin_without(bench: DrivingBench) -> None:
    bench.arduino.transmitter(0, 0)


@FAULTS.add("receiver's steering channel lost", STOPPED, "transmitter's signal was lost", "no pulses on that pin")
def _lose_steering(bench: DrivingBench) -> None:
    bench.arduino.transmitter(0, REST_US[1])


@FAULTS.add(
    "receiver comes back with presets",
    STOPPED,
    "transmitter's signal was lost",
    "no pulses for 0.3 s, then throttle that nobody sends",
)
def _presets(bench: DrivingBench) -> None:
    bench.arduino.transmitter(0, 0)
    bench.wait(0.3)
    bench.arduino.transmitter(*_moved(0, PRESET_US))


@FAULTS.add(
    "receiver begins with presets",
    REFUSED,
    "throttle stick is not at rest",
    "throttle that nobody sends, since before the Arduino's start",
)
def _begin_with_presets(bench: DrivingBench) -> None:
    bench.arduino.transmitter(*_moved(0, PRESET_US))
    bench.arduino.reset()


@FAULTS.add("nobody wiggles the stick", REFUSED, "nobody has just wiggled", "pulses that stay what they are")
def _no_gesture(bench: DrivingBench) -> None:
    bench.arduino.ready(False)
    bench.arduino.reset()  # forgets earlier gestures, which count for 30 s


def _by_steering(name: str, *moves: tuple[float, float], message: str = "nobody has just wiggled") -> None:
    """A row in which a human has steered before the drive: by how much, and then for how many seconds."""

    @FAULTS.add(name, REFUSED, message, f"steering by {moves} (us, s), the throttle at rest")
    def _steer(bench: DrivingBench) -> None:
        bench.arduino.ready(False)
        bench.arduino.reset()  # forgets earlier gestures
        bench.wait(1.0)
        for steering_us, seconds in moves:
            bench.arduino.transmitter(*_moved(steering_us, 0))
            bench.wait(seconds)


_by_steering("a gesture that takes too long", (290, 0.2), (0, 3.5), (-290, 0.2), (0, 1.2))
_by_steering("a gesture whose stick is held at a side", (290, 0.2), (-290, 0.2), (290, 1.2))


def _by_human(name: str, sent_us: tuple[float, float], human_us: tuple[float, float]) -> None:
    FAULTS.add(name, HUMAN, "the human took over", f"the transmitter sends {sent_us}", human_us=human_us)(
        lambda bench: bench.arduino.transmitter(*sent_us)
    )


# With slow throttle pulses the throttle needs longer to count as at rest than the gate allows for a takeover. So the
# human moves only the steering there.
_STEERED = _moved(144, 20 if PERIOD_US["throttle"] < 3000 else 0)
_by_human("human takes over by steering", _STEERED, _STEERED)
# The human's throttle passes only after it has been at rest, as a receiver without its transmitter looks the same.
_by_human("human takes over by throttle", _moved(14, 80), (_moved(14, 0)[0], NEUTRAL_US["throttle"]))

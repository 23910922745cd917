"""Faults of transmitter and receiver, and what the human who holds the transmitter does."""

from collections.abc import Callable

from balloon_world.simulated_arduino import REST_US
from lab.driving.bench import DrivingBench
from lab.driving.pins import CAR, HUMAN, NEUTRAL_US, PERIOD_US, REFUSED, STOPPED
from lab.driving.row import FaultKind
from lab.driving.virtual_gamepad import GamepadHuman, VirtualGamepad

FAULTS = FaultKind("receiver")
NOTHING = "no pulses on the receiver's pins" if CAR.human == "receiver" else "nobody holds L1"
PRESET_US = 280  # by how much a preset throttle is above rest


def _moved(steering_us: float, throttle_us: float) -> tuple[float, float]:
    """Return the transmitter's pulses with the sticks moved from rest by that much."""
    return REST_US[0] + steering_us, REST_US[1] + throttle_us


@FAULTS.add("receiver lost", STOPPED, "transmitter's signal was lost", NOTHING)
def _lose_receiver(bench: DrivingBench) -> None:
    bench.human.transmitter(0, 0)


def _lose_channel(name: str, *sent_us: float) -> None:
    FAULTS.add(
        f"receiver's {name} channel lost",
        STOPPED,
        "transmitter's signal was lost",
        "no pulses on that pin",
        human="receiver",
    )(lambda bench: bench.human.transmitter(*sent_us))


_lose_channel("throttle", REST_US[0], 0)
_lose_channel("steering", 0, REST_US[1])


@FAULTS.add(
    "no transmitter at the start", REFUSED, "the transmitter gives no signal", f"{NOTHING}, from before the drive"
)
def _begin_without(bench: DrivingBench) -> None:
    bench.human.transmitter(0, 0)


def _by_gamepad(name: str, expected: str, message: str, method: str, inject: Callable[[VirtualGamepad], None]) -> None:
    @FAULTS.add(f"gamepad {name}", expected, message, method, human="gamepad")
    def _fail(bench: DrivingBench) -> None:
        assert isinstance(bench.human, GamepadHuman)
        if expected == REFUSED:
            bench.human.transmitter(0, 0)
        inject(bench.human.pad)


_by_gamepad("pulled out", STOPPED, "the gamepad .* is gone", "its devices come to their end", VirtualGamepad.unplug)
_by_gamepad("out of reach", STOPPED, "transmitter's signal was lost", "it sends nothing more", VirtualGamepad.freeze)
_by_gamepad(
    "whose L1 is stuck",
    REFUSED,
    "the transmitter gives no signal",
    "L1 is held since before the drive",
    lambda pad: pad.hold(True),
)


@FAULTS.add(
    "receiver comes back with presets",
    STOPPED,
    "transmitter's signal was lost",
    "no pulses for 0.3 s, then throttle that nobody sends",
)
def _presets(bench: DrivingBench) -> None:
    bench.human.transmitter(0, 0)
    bench.wait(0.3)
    bench.human.transmitter(*_moved(0, PRESET_US))


@FAULTS.add(
    "receiver begins with presets",
    REFUSED,
    "throttle stick is not at rest",
    "throttle that nobody sends, since before the Arduino's start",
)
def _begin_with_presets(bench: DrivingBench) -> None:
    bench.human.transmitter(*_moved(0, PRESET_US))
    bench.arduino.reset()


@FAULTS.add("nobody wiggles the stick", REFUSED, "nobody has just wiggled", "pulses that stay what they are")
def _no_gesture(bench: DrivingBench) -> None:
    bench.human.ready(False)
    bench.arduino.reset()  # forgets earlier gestures, which count for 30 s


def _by_steering(name: str, *moves: tuple[float, float], message: str = "nobody has just wiggled") -> None:
    """A row in which a human has steered before the drive: by how much, and then for how many seconds."""

    @FAULTS.add(name, REFUSED, message, f"steering by {moves} (us, s), the throttle at rest", human="receiver")
    def _steer(bench: DrivingBench) -> None:
        bench.human.ready(False)
        bench.arduino.reset()  # forgets earlier gestures
        bench.wait(1.0)
        for steering_us, seconds in moves:
            bench.human.transmitter(*_moved(steering_us, 0))
            bench.wait(seconds)


_by_steering("a gesture that takes too long", (290, 0.2), (0, 3.5), (-290, 0.2), (0, 1.2))
_by_steering("a gesture whose stick is held at a side", (290, 0.2), (-290, 0.2), (290, 1.2))


def _by_human(name: str, sent_us: tuple[float, float], human_us: tuple[float, float]) -> None:
    watch_s = 1.0 if CAR.human == "receiver" else 0.2  # the drive ends, and with it a gamepad's way to the Arduino
    FAULTS.add(
        name, HUMAN, "the human took over", f"the transmitter sends {sent_us}", human_us=human_us, watch_s=watch_s
    )(lambda bench: bench.human.transmitter(*sent_us))


# With slow throttle pulses the throttle needs longer to count as at rest than the gate allows for a takeover. So the
# human moves only the steering there.
_STEERED = _moved(144, 20 if PERIOD_US["throttle"] < 3000 else 0)
_by_human("human takes over by steering", _STEERED, _STEERED)
# The human's throttle passes only after it has been at rest, as a receiver without its transmitter looks the same.
_by_human("human takes over by throttle", _moved(14, 80), (_moved(14, 0)[0], NEUTRAL_US["throttle"]))

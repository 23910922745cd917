"""What `rover doctor` says and asks for, rehearsed without a car: a script holds the transmitter."""

from collections.abc import Callable, Iterator
from pathlib import Path

from lab.arduino.emulator import EmulatedArduino
from rover_lib.onboard.doctor import Check, examine, receiver
from rover_lib.world.car import VirtualCar
from rover_lib.world.standin import REST_US


def rehearse(artifact: Path | None, say: Callable[[str], object]) -> Iterator[Check]:
    """The checks before a drive, then those of the ritual, with the real firmware and the balloon world's camera.

    say: gets what the human is asked to do, when the script does it. Raises ArduinoError and WorldError where an
    emulator does not start, and LinkError as the link does.
    """
    with EmulatedArduino(every_pulse=False, transmitter=REST_US) as board, VirtualCar() as world:
        yield from examine(artifact, camera=world.camera, port=board.port, log_folder=Path.cwd())
        does = iter(
            (
                lambda: board.transmitter(*REST_US),  # on, sticks let go of
                board.wiggle,
                lambda: board.transmitter(0, 0),  # off: a receiver whose failsafe is no pulses
                lambda: board.transmitter(*REST_US),
            )
        )

        def ask(what: str) -> None:
            say(what)
            next(does)()

        yield from receiver(board.port, ask)

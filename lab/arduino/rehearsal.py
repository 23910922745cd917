"""Rehearse what `rover doctor` says and asks for without a car: a script holds the transmitter."""

from collections.abc import Callable, Iterator
from pathlib import Path

from balloon_world.car import VirtualCar
from balloon_world.simulated_arduino import REST_US
from lab.arduino.emulator import EmulatedArduino
from rover_lib.onboard.care.doctor import Check, examine, receiver


def rehearse(artifact: Path | None, say: Callable[[str], object]) -> Iterator[Check]:
    """Yield the checks before a drive, then those of the ritual, with the real firmware and the balloon world's camera.

    say: called with what the human is asked to do, just before the script does it. Raises RoverError and TrainingError
    if an emulator does not start, and LinkError as the link does.
    """
    with EmulatedArduino(every_pulse=False, transmitter=REST_US) as board, VirtualCar() as world:
        yield from examine(artifact, camera=world.camera, port=board.port, log_folder=Path.cwd())
        does = iter(
            (
                lambda: board.transmitter(*REST_US),  # switched on, with the sticks at rest
                board.wiggle,
                lambda: board.transmitter(0, 0),  # switched off, with a receiver that sends no pulses as its failsafe
                lambda: board.transmitter(*REST_US),
            )
        )

        def ask(what: str) -> None:
            say(what)
            next(does)()

        yield from receiver(board.port, ask)

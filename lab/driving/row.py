"""Define what a fault of a drive is: how it is injected, and what the car should do. The faults are in rows/."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from balloon_world.simulated_arduino import REST_US
from lab.driving.bench import DrivingBench
from lab.driving.pins import CAR, CONTINUES, HUMAN, REFUSED, STOPPED

Inject = Callable[[DrivingBench], float | None]


@dataclass(frozen=True)
class FaultRow:
    """One fault, and what is expected of the car.

    kind: the name of its module in rows/.
    inject: makes the fault happen, waits if that takes time, and returns when it happened (None: when inject was
    called). If `refused` is expected, it is called before the drive is started.
    message: a regular expression for the line that tells of the fault, in the flight log or on stderr. told_later:
    whether only the next drive prints that line. method: how the fault is injected, in words. watch_s: how long the car
    is watched after inject.
    start: how the drive is prepared, see Drive. exit_code: of the drive, None if it goes on.
    limits: what stops a drive that `continues` after all, in words. until_limit: whether that happens in this row.
    starves: whether the fault takes this machine's time away from the drive. paused_s: for how long it pauses the
    drive. human_us: the pulses expected on the pins if `human` is expected.
    human: the only one of car.yml's humans who has this fault; "": both.
    """

    kind: str
    name: str
    expected: str
    inject: Inject
    message: str
    method: str
    exit_code: int | None
    watch_s: float = 1.0
    start: str = ""
    told_later: bool = False
    limits: str = ""
    until_limit: bool = False
    starves: bool = False
    human: str = ""
    paused_s: float = 0.0
    human_us: tuple[float, float] = REST_US


@dataclass
class FaultKind:
    """The faults of one kind, in the order in which they are run."""

    kind: str
    rows: list[FaultRow] = field(default_factory=list)

    def add(self, name: str, expected: str, message: str, method: str, **more: Any) -> Callable[[Inject], Inject]:
        """Return a decorator that adds a row whose inject is the decorated function.

        more: other fields of FaultRow. Unless exit_code is among them, it is 3 for `stopped`, 4 for `human`, None for
        `continues` and 1 for `refused`.
        """
        if CAR.human == "gamepad" and expected == STOPPED:  # whatever stops the commands stops its sticks too
            message += "|the transmitter's signal was lost"
        more.setdefault("exit_code", {STOPPED: 3, HUMAN: 4, CONTINUES: None, REFUSED: 1}[expected])

        def row(inject: Inject) -> Inject:
            self.rows.append(FaultRow(self.kind, name, expected, inject, message, method, **more))
            return inject

        return row

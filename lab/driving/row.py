"""What a fault of a drive is: its injection, and what is expected of the car. The faults themselves are in rows/."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from lab.driving.bench import DrivingBench
from lab.driving.pins import CONTINUES, HUMAN, REFUSED, STOPPED
from rover_lib.world.standin import REST_US

Inject = Callable[[DrivingBench], float | None]


@dataclass(frozen=True)
class FaultRow:
    """One fault, and what is expected of it.

    kind: whose fault it is, the name of its module in rows/.
    inject: makes it happen, waits if it takes time, and returns when it happened (None: when called). Of `refused`, it
    is called before the drive is started.
    message: a regular expression of the line that tells of it, in the flight log or on stderr; of the drive after it if
    told_later. method: how it is injected. watch_s: how long it is watched after inject.
    start: of the drive, see Drive. exit_code: of the drive, None: it goes on.
    limits: what makes a `continues` stop after all. until_limit: that happens here.
    starves: it takes the time of this machine away. paused_s: it pauses the drive for that long. human_us: of `human`.
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
    paused_s: float = 0.0
    human_us: tuple[float, float] = REST_US


@dataclass
class FaultKind:
    """The faults of one kind, in the order in which they are run."""

    kind: str
    rows: list[FaultRow] = field(default_factory=list)

    def add(self, name: str, expected: str, message: str, method: str, **more: Any) -> Callable[[Inject], Inject]:
        """A decorator that makes a row of the function which injects the fault; see FaultRow for the rest of it."""
        more.setdefault("exit_code", {STOPPED: 3, HUMAN: 4, CONTINUES: None, REFUSED: 1}[expected])

        def row(inject: Inject) -> Inject:
            self.rows.append(FaultRow(self.kind, name, expected, inject, message, method, **more))
            return inject

        return row

"""The levels of the balloon world: how hard a drive to the balloon is.

World(10_000, level=level_named("hard"))
"""

from dataclasses import asdict, dataclass
from typing import Any

from rover_lib.onboard.errors import TrainingError

Range = tuple[float, float]


@dataclass(frozen=True)
class Level:
    """What a world of this level draws from. Each share is a chance in [0, 1], each range is [low, high).

    bearing_rad: the balloon's from the start, at most, to either side; the camera sees 0.67. gain: of the light, by
    `flicker` at most, at flicker_hz times 2 pi. tint: at most, of each colour. glare: 0 to 255, at its middle.
    hidden: share of worlds in which something stands before the balloon, and hidden_share: of the balloon's width
    behind it. alike: share of worlds with balloons, a floor and a wall that have the balloon's colour. decoys: other
    red things, at most. solid: whether the drive ends when the car touches one of the things in its way.
    shoves: at least, in each drive; drags: share of them that last long, as on a slope. speed, steering: what the car
    makes of a command, as a factor. slip_s: how long the car's direction lags behind its heading.
    """

    name: str
    distance_m: Range = (1.8, 4.0)
    bearing_rad: float = 0.5
    timeout_s: float = 8.0
    gain: Range = (0.75, 1.15)
    flicker: float = 0.12
    flicker_hz: Range = (0.5, 2.0)
    tint: float = 0.07
    glare: float = 0.0
    hidden: float = 0.0
    hidden_share: Range = (0.0, 0.0)
    alike: float = 0.0
    decoys: int = 0
    solid: bool = False
    shoves: int = 0
    drags: float = 0.0
    speed: Range = (1.0, 1.0)
    steering: Range = (1.0, 1.0)
    slip_s: Range = (0.0, 0.0)


EASY = Level("easy")
HARD = Level(
    "hard",
    distance_m=(1.8, 3.4),
    bearing_rad=0.66,
    timeout_s=12.0,
    gain=(0.5, 1.3),
    flicker=0.3,
    flicker_hz=(0.5, 6.0),
    tint=0.15,
    glare=150.0,
    hidden=0.6,
    hidden_share=(0.25, 0.6),
    alike=0.6,
    decoys=2,
    solid=True,
    shoves=2,
    drags=0.3,
    speed=(0.65, 1.0),
    steering=(0.8, 1.1),
    slip_s=(0.05, 0.25),
)
LEVELS = {level.name: level for level in (EASY, HARD)}


def level_named(name: str) -> Level:
    """Return the level of a name. Raises TrainingError for another name."""
    if name not in LEVELS:
        raise TrainingError(f"a world's level must be one of {', '.join(LEVELS)}", found=name)
    return LEVELS[name]


def level_in_key(level: Level) -> dict[str, Any]:
    """What a key says of a level: nothing for easy, so that what was kept before there were levels stays valid."""
    return {} if level == EASY else {"level": asdict(level)}

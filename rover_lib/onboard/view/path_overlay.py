"""Where a plan leads, drawn into the camera's picture: the car's geometry, on a flat floor.

It assumes a speed proportional to the throttle, and a level camera that looks straight ahead. No command depends on it.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from rover_lib.onboard.car.car import WIDTH_PX, Car, this_car
from rover_lib.onboard.checked import is_number
from rover_lib.onboard.errors import ParamsError
from rover_lib.onboard.params import params

NEAR_M = 0.15  # in front of the camera; the picture does not show what is nearer


@dataclass(frozen=True)
class CarShape:
    """A car's wheelbase and camera, from its car.yml and the section `view` of params.yml.

    Lengths are in metres; positions in the picture are fractions of its width or height.

    wheel_angle_rad: angle of the front wheels at full steering. speed_mps: at throttle 1. focal: focal length, as a
    fraction of the picture's width. horizon: row of the horizon from the top, as a fraction of the picture's height.
    """

    wheelbase_m: float
    width_m: float
    wheel_angle_rad: float
    speed_mps: float
    camera_height_m: float
    focal: float
    horizon: float
    left: int = 1

    def __post_init__(self) -> None:
        wrong = {k: v for k, v in vars(self).items() if k != "left" and not is_number(v, math.ulp(0.0))}
        if wrong:
            raise ParamsError("view: each must be a number above 0", found=wrong, remedy="see params.yml")

    @classmethod
    def of(cls, car: Car | None = None) -> "CarShape":
        """The shape of `car`, or of this machine's car.

        Raises ParamsError for values that no car can have, CarError as this_car().
        """
        car = car or this_car()
        section = params()["view"]
        try:
            return cls(**section, wheelbase_m=car.wheelbase_m, focal=car.focal_px / WIDTH_PX, left=car.left)
        except TypeError as error:  # a name too many or too few
            raise ParamsError(f"view: {error}", found=sorted(section), remedy="see params.yml") from None

    def track(self, actions: Iterable[Sequence[float]], step_s: float) -> list[tuple[float, float, float]]:
        """The car's path as (ahead, left, heading) in metres and radians: before each action, and at the end.

        actions: [steering, throttle] each, for step_s seconds.
        """
        x = y = heading = 0.0
        points = [(x, y, heading)]
        for steering, throttle in actions:
            way_m = throttle * self.speed_mps * step_s
            turn = way_m / self.wheelbase_m * math.tan(self.left * steering * self.wheel_angle_rad)
            x += way_m * math.cos(heading + turn / 2)
            y += way_m * math.sin(heading + turn / 2)
            heading += turn
            points.append((x, y, heading))
        return points

    def ribbon(
        self, actions: Iterable[Sequence[float]], step_s: float, aspect: float
    ) -> list[tuple[float, float, float, float]]:
        """The path of both wheels in the picture: (x, y) of the left wheel, then of the right one.

        x and y are fractions of the picture's width and height. aspect: the picture's width divided by its height.
        Points behind the camera are left out; the list is empty for a car that does not move.
        """
        ribbon = []
        for x, y, heading in self.track(actions, step_s):
            side = self.width_m / 2
            feet = [(x - s * math.sin(heading), y + s * math.cos(heading)) for s in (side, -side)]
            if min(ahead for ahead, _ in feet) > NEAR_M:
                (a, b), (c, d) = (self._seen(ahead, rest, aspect) for ahead, rest in feet)
                ribbon.append((a, b, c, d))
        return ribbon

    def _seen(self, ahead: float, left: float, aspect: float) -> tuple[float, float]:
        x = 0.5 - self.focal * left / ahead
        return round(x, 4), round(self.horizon + self.focal * aspect * self.camera_height_m / ahead, 4)

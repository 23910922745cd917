"""README's film: the demo's policy in FP32 and in INT8, beside each other in the worlds that judge them first.

    python -m lab.repository.film          # what `make notebooks` does; needs runs/demo, takes half a minute

Time is virtual: a plan takes what the stored benchmark says, however busy this machine is.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from balloon_world.drives import SEED, NoLog, TimedCar
from balloon_world.world import RATE_HZ, World
from lab.repository.publish import source_of
from rover_exchange.film import WIDTH, draw_moment
from rover_exchange.moments import Moment
from rover_lib.onboard.drive.plan import Settings
from rover_lib.onboard.params import params
from rover_lib.onboard.policy.load import Policy, load_policy
from rover_lib.onboard.stage import atomic_path, read_stage

MODES = {"fp32": "FP32", "static": "INT8"}
WORLDS = 2
EVERY = 3  # ticks from one picture to the next
HELD = 10  # pictures of a world that has ended
BAR, MAP, MARGIN = 64, 120, 10  # pixels: height of the text's bar, side of the map
INK, PAPER, WAY, BALLOON = (240, 240, 240), (20, 23, 26), (46, 204, 113), (213, 94, 0)


class FilmedCar(TimedCar):
    """A car that draws itself at every third tick. text: of the bar below. pictures: (h, WIDTH, 3) uint8 RGB."""

    def __init__(self, world: World, policy: Policy, latency_s: float, text: str):
        self.pictures: list[np.ndarray] = []
        self._text, self._drawn = text, -EVERY
        super().__init__(world, policy, latency_s)

    def sleep(self, seconds: float) -> None:
        super().sleep(seconds)
        tick = round(self.clock() * RATE_HZ)
        if self.newest() and tick >= self._drawn + EVERY:
            self._drawn = tick
            self.pictures.append(self.picture())

    def picture(self) -> np.ndarray:
        """Draw what the camera sees, the way that the plan takes, and the way so far on a map."""
        plan = self.newest()
        assert plan
        done = round((self.clock() - plan.captured_s) * RATE_HZ)
        nothing: dict[str, Any] = dict.fromkeys(("steering", "throttle", "latency_ms", "late_ms", "plan_age_ms"))
        tick = nothing | {"pins_steering_us": None, "pins_throttle_us": None, "state": "A"}
        moment = Moment(self.clock(), Path(), tick, plan.actions[done:], "")
        frame = self.world.render()
        height = round(WIDTH * frame.shape[0] / frame.shape[1] / 2) * 2
        picture = Image.fromarray(draw_moment(moment, frame, self.policy.car, 1 / RATE_HZ)[: height + BAR])
        draw = ImageDraw.Draw(picture)
        draw.rectangle((0, height, WIDTH, height + BAR), PAPER)
        draw.text((MARGIN, height + 12), self._text, INK, ImageFont.load_default(30))
        if self.world.hit:
            draw.text((WIDTH - MARGIN, height + 12), "hit!", WAY, ImageFont.load_default(30), "ra")
        _draw_map(draw, self.world)
        return np.asarray(picture)


def _draw_map(draw: ImageDraw.ImageDraw, world: World) -> None:
    """Draw the car's way from above, upwards, and the balloon, in the upper right corner."""
    left, top = WIDTH - MAP - MARGIN, MARGIN
    draw.rectangle((left, top, left + MAP, top + MAP), PAPER)
    way = [(s.x_m, s.y_m) for s in (*world.trajectory, world.state)]
    balloon = world.balloon.x_m, world.balloon.y_m
    scale = 0.8 * MAP / max(1.5, *(max(abs(2 * y), x) for x, y in (*way, balloon)))

    def place(x_m: float, y_m: float) -> tuple[float, float]:
        return left + MAP / 2 - scale * y_m, top + 0.9 * MAP - scale * x_m

    draw.line([place(*at) for at in way], WAY, 4)
    column, row = place(*balloon)
    draw.ellipse((column - 6, row - 6, column + 6, row + 6), BALLOON)


def pictures_of(mode: str, latency_ms: float, run_dir: Path) -> Iterator[list[np.ndarray]]:
    """Drive through each world, and yield its pictures."""
    policy = load_policy(run_dir / f"policy_{mode}.pt", threads=1)
    for count in range(WORLDS):
        text = f"{MODES[mode]}: a plan in {latency_ms:.0f} ms"
        car = FilmedCar(World(SEED + count, left=policy.car.left), policy, latency_ms / 1e3, text)
        car.drive(Settings.of(params()["drive"]), NoLog())
        yield [*car.pictures, car.picture()]


def write_film(path: Path, run_dir: Path, benchmark: Path) -> None:
    """Write the film as WebP. benchmark: JSON of a run's benchmark, whose latencies it shows and whose hash it has."""
    timed = read_stage(benchmark, "benchmark")["metrics"]["artifacts"]
    frames = []
    for worlds in zip(*(pictures_of(mode, timed[mode]["latency_p50_ms"], run_dir) for mode in MODES), strict=True):
        count = max(map(len, worlds)) + HELD
        both = [pictures + [pictures[-1]] * (count - len(pictures)) for pictures in worlds]
        frames += [Image.fromarray(np.concatenate(beside, axis=1)) for beside in zip(*both, strict=True)]
    first, *others = frames
    with atomic_path(path) as temporary:
        first.save(
            temporary, "webp", save_all=True, append_images=others, duration=round(1000 * EVERY / RATE_HZ),
            loop=0, quality=60, method=4, xmp=source_of(benchmark).encode(),
        )  # fmt: skip


if __name__ == "__main__":
    write_film(Path("pictures/drive.webp"), Path("runs/demo"), next(Path("results/demo").glob("benchmark-*.json")))

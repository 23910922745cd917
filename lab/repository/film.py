"""README's film: the demo's policy in FP32 and in INT8, beside each other in the worlds that judge them first.

    python -m lab.repository.film          # what `make notebooks` does; needs runs/demo, takes half a minute

Time is virtual: a plan takes what the stored benchmark says, however busy this machine is.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from balloon_world.drives import SEED, NoLog, TimedCar
from balloon_world.world import RATE_HZ, World
from lab.repository.publish import source_of
from rover_exchange.film import WIDTH, draw_moment
from rover_exchange.moments import Moment
from rover_lib.onboard.drive.flight_log import Tick
from rover_lib.onboard.drive.plan import Settings
from rover_lib.onboard.params import params
from rover_lib.onboard.policy.load import Policy, load_policy
from rover_lib.onboard.stage import atomic_path, read_stage

MODES = {"fp32": "FP32", "static": "INT8"}
WORLDS, EVERY, HELD = 2, 3, 10  # worlds, ticks from one picture to the next, pictures of a world that has ended
BAR, MAP, MARGIN = 64, 120, 10  # pixels: height of the text's bar, side of the map
INK, PAPER, WAY, BALLOON = (240, 240, 240), (20, 23, 26), (46, 204, 113), (213, 94, 0)
NOTHING = dict.fromkeys(Tick._fields) | {"state": "A"}  # the bar below takes the place of what draw_moment writes


class FilmedCar(TimedCar):
    """A car that draws itself at every third tick. pictures: (h, WIDTH, 3) uint8 RGB."""

    def __init__(self, world: World, policy: Policy, latency_s: float, name: str):
        self.pictures: list[np.ndarray] = []
        self._text = f"{name}: a plan in {1000 * latency_s:.0f} ms"
        super().__init__(world, policy, latency_s)

    def sleep(self, seconds: float) -> None:
        super().sleep(seconds)
        if self.newest() and round(self.clock() * RATE_HZ) % EVERY == 0:
            self.pictures.append(self.picture())

    def picture(self) -> np.ndarray:
        """Draw what the camera sees, the way that the plan takes, and the way so far on a map."""
        plan, frame = self.newest(), self.world.render()
        assert plan
        ahead = plan.actions[round((self.clock() - plan.captured_s) * RATE_HZ) :]
        drawn = draw_moment(Moment(self.clock(), Path(), NOTHING, ahead, ""), frame, self.policy.car, 1 / RATE_HZ)
        height = WIDTH * frame.shape[0] // frame.shape[1]
        picture = Image.fromarray(drawn[: height + BAR])
        draw, font = ImageDraw.Draw(picture), ImageFont.load_default(30)
        draw.rectangle((0, height, WIDTH, height + BAR), PAPER)
        draw.text((MARGIN, height + 12), self._text, INK, font)
        if self.world.hit:
            draw.text((WIDTH - MARGIN, height + 12), "hit!", WAY, font, "ra")
        _draw_map(draw, self.world)
        return np.asarray(picture)


def _draw_map(draw: ImageDraw.ImageDraw, world: World) -> None:
    """Draw the car's way from above, upwards, and the balloon, in the upper right corner."""
    left = WIDTH - MAP - MARGIN
    draw.rectangle((left, MARGIN, left + MAP, MARGIN + MAP), PAPER)
    places = [(s.x_m, s.y_m) for s in (*world.trajectory, world.state)] + [(world.balloon.x_m, world.balloon.y_m)]
    scale = 0.8 * MAP / max(1.5, *(max(abs(2 * y_m), x_m) for x_m, y_m in places))
    *way, balloon = [(left + MAP / 2 - scale * y_m, MARGIN + 0.9 * MAP - scale * x_m) for x_m, y_m in places]
    draw.line(way, WAY, 4)
    draw.circle(balloon, 6, BALLOON)


def pictures_of(mode: str, latency_s: float, run_dir: Path) -> Iterator[list[np.ndarray]]:
    """Drive through each world, and yield its pictures."""
    policy = load_policy(run_dir / f"policy_{mode}.pt", threads=1)
    for seed in range(SEED, SEED + WORLDS):
        car = FilmedCar(World(seed, left=policy.car.left), policy, latency_s, MODES[mode])
        car.drive(Settings.of(params()["drive"]), NoLog())
        yield [*car.pictures, car.picture()]


def write_film(path: Path, run_dir: Path, benchmark: Path) -> None:
    """Write the film as WebP. benchmark: JSON of a run's benchmark, whose latencies it shows and whose hash it has."""
    timed = read_stage(benchmark, "benchmark")["metrics"]["artifacts"]
    frames = []
    for worlds in zip(*(pictures_of(m, timed[m]["latency_p50_ms"] / 1e3, run_dir) for m in MODES), strict=True):
        count = max(map(len, worlds)) + HELD
        both = [pictures + [pictures[-1]] * (count - len(pictures)) for pictures in worlds]
        frames += [Image.fromarray(np.concatenate(pair, axis=1)) for pair in zip(*both, strict=True)]
    options = {"save_all": True, "duration": round(1000 * EVERY / RATE_HZ), "loop": 0, "quality": 60, "method": 4}
    with atomic_path(path) as temporary:
        frames[0].save(temporary, "webp", append_images=frames[1:], xmp=source_of(benchmark).encode(), **options)


if __name__ == "__main__":
    write_film(Path("pictures/drive.webp"), Path("runs/demo"), next(Path("results/demo").glob("benchmark-*.json")))

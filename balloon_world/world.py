"""Simulate a balloon world: how a small car moves in it and what its front camera sees. The seed determines everything.

A car stands on a floor, a red balloon floats some metres ahead, and the task is to drive into it. Lengths are in
metres, angles in radians (positive to the left). Actions are the policy's: steering in [-1, 1], throttle in [0, 1], or
in [-1, 1] if the car has a reverse gear. Positive steering turns to the car's positive side, the recorded car's right.
That side, the wheelbase and the field of view come from car.yml.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from balloon_world.level import EASY, Level
from rover_lib.onboard.car.car import this_car
from rover_lib.onboard.errors import TrainingError

_CAR = this_car()  # its wheelbase, focal length and limits of the throttle are used here

RATE_HZ = 30.0
FRAME_HEIGHT, FRAME_WIDTH = 360, 640
TIMEOUT_S = EASY.timeout_s

# The car. Full steering turns the wheels by 34 degrees. A throttle of 0.09, the highest in real recordings of drives,
# gives 1.1 m/s.
WHEELBASE_M = _CAR.wheelbase_m
WHEEL_ANGLE_RAD = 0.6
STEERING_LAG_S = 0.12
SPEED_PER_THROTTLE_MPS = 12.0
SPEED_LAG_S = 0.2

# The expert.
STEERING_MOST = 0.65  # to the balloon
STEERING_MOST_AROUND = 0.9  # where something may be in the way
THROTTLE_MOST = 0.09
THROTTLE_RISE_PER_S = 0.20  # from a stand to full in half a second
THROTTLE_FALL_PER_S = 0.30

# The camera: a pinhole above the front bumper. It looks straight ahead, and the horizon is above the picture's middle.
FOCAL_PX = _CAR.focal_px
HORIZON_ROW = 125
CENTRE_COLUMN = FRAME_WIDTH / 2
CAMERA_HEIGHT_M = 0.20

BALLOON_RADIUS_M = 0.16
BALLOON_HEIGHT_M = 0.24  # of its centre above the floor
HIT_DISTANCE_M = 0.30  # from the camera to the balloon's centre; at this distance the bumper touches the balloon
ARENA_RADIUS_M = 7.0
CAR_HALF_M = 0.06  # of the bumper's width: what is solid ends the drive when the bumper's middle is so near to it
CLEARANCE_M = 0.28  # that the expert keeps between the bumper's middle and what is solid

PUSH_S, PUSH_RAD, PUSH_M = 0.15, 0.4, 0.1  # of somebody's push: its duration, the turn and the shift
DECOY_ASIDE_RAD = 0.25  # the least angle between a decoy and the balloon, as seen from the start

DRAG = 4.0  # how many times longer a push takes that drags the car
GAP_M = 0.75  # between what hides the balloon and other things
SEEN_RAD = 0.8  # what is solid farther aside than this is beside the car

FLOOR_PX_PER_M = 160
FLOOR_TILE_PX = 640
GLARE_PX = 110
FAR_ROWS = 24  # rows below the horizon that show a blurred floor, as a sharp one would flicker so far away

# fmt: off
_DISTRACTOR_BGR = (
    (190, 90, 30), (70, 150, 40), (40, 190, 215), (150, 60, 120),
    (205, 200, 195), (45, 45, 45), (170, 170, 40), (90, 115, 140),
)
_NEARLY_RED_BGR = ((25, 105, 225), (140, 75, 215), (120, 25, 190), (35, 35, 110), (40, 160, 235))
# fmt: on


@dataclass(frozen=True)
class CarState:
    """Where the car is and how it moves. `steering` follows `steering_command` with a lag, in the same unit."""

    x_m: float = 0.0
    y_m: float = 0.0
    heading_rad: float = 0.0
    speed_mps: float = 0.0
    steering: float = 0.0
    steering_command: float = 0.0
    throttle_command: float = 0.0
    time_s: float = 0.0


@dataclass(frozen=True)
class Thing:
    """Something that stands on the floor. kind: 'balloon', 'box' or 'cone'. colour: BGR, 0 to 255."""

    kind: str
    x_m: float
    y_m: float
    radius_m: float
    height_m: float
    colour: tuple[int, int, int]


@dataclass(frozen=True)
class Shove:
    """A push from outside: the car is turned and moved sideways while it lasts."""

    start_s: float
    end_s: float
    yaw_rps: float
    sideways_mps: float


class World:
    """One drive to one balloon.

    seed: determines everything that is random. shoves: how many pushes the car gets on its way. decoys: how many red
    things stand about that are not balloons; else only the balloon is red. left: 1 if positive steering turns left, -1
    if right; None: as this machine's car. level: what else is in the way, and how the car drives.
    """

    def __init__(self, seed: int, shoves: int = 0, decoys: int = 0, left: int | None = None, level: Level = EASY):
        if seed < 0:
            raise TrainingError("a world's seed must not be negative", found=seed)
        self.seed = seed
        self.left = left or _CAR.left
        self.level = level
        rng = np.random.default_rng([seed, 20_251])
        self.state = CarState()
        distance = rng.uniform(*level.distance_m)
        bearing = rng.uniform(-level.bearing_rad, level.bearing_rad)
        red = (int(rng.integers(20, 50)), int(rng.integers(15, 45)), int(rng.integers(190, 240)))
        x, y = _point(distance, bearing)
        self.balloon = Thing("balloon", x, y, BALLOON_RADIUS_M, BALLOON_HEIGHT_M, red)
        self.distractors = tuple(_distractors(rng, self.balloon))
        more = np.random.default_rng([seed, 20_254])
        decoys = max(decoys, int(more.integers(level.decoys + 1)))
        self.distractors += tuple(_decoys(np.random.default_rng([seed, 20_253]), self.balloon, decoys))
        alike = more.random() < level.alike
        if alike:
            self.distractors = tuple(_nearly_red(more, thing) for thing in self.distractors)
        if more.random() < level.hidden:
            hider = _hider(more, self.balloon, more.uniform(*level.hidden_share))
            apart = [t for t in self.distractors if math.hypot(t.x_m - hider.x_m, t.y_m - hider.y_m) > GAP_M]
            self.distractors = (*apart, hider)
        self.solid = self.distractors if level.solid else ()
        self.trajectory = [self.state]
        # 'hit', 'left' (the car passed the balloon or left the arena), 'bumped' (into what is solid) or 'timeout'
        self.outcome: str | None = None
        self._shoves = tuple(_shoves(np.random.default_rng([seed, 20_252]), max(shoves, level.shoves), level.drags))
        self._floor, self._far_floor = _floor(rng)
        self._wall = _wall(rng)
        self._light = _light(rng, level.tint)
        self._gain = rng.uniform(*level.gain)
        self._flicker = rng.uniform(0.0, level.flicker), rng.uniform(*level.flicker_hz), rng.uniform(0, 2 * math.pi)
        self._speed, self._steering, self._slip_s = (
            more.uniform(*span) for span in (level.speed, level.steering, level.slip_s)
        )
        if alike:
            _paint_red(more, self._floor, self._far_floor, self._wall)
        self._glare = _glare(more, level.glare) if level.glare else None
        self._glare_at = more.uniform(-0.8, 0.8), int(more.integers(-40, 260))  # its bearing and its row

    @property
    def hit(self) -> bool:
        return self.outcome == "hit"

    @property
    def done(self) -> bool:
        return self.outcome is not None

    def push(self, side: int) -> None:
        """Push the car from outside, from now on for PUSH_S: to the left if side is 1, to the right if it is -1."""
        now_s = self.state.time_s
        push = Shove(now_s, now_s + PUSH_S, side * PUSH_RAD / PUSH_S, side * PUSH_M / PUSH_S)
        self._shoves = (*self._shoves, push)

    def step(self, steering: float, throttle: float, dt: float = 1 / RATE_HZ) -> None:
        """Drive for dt seconds. Raises TrainingError for an action outside its range, or if the drive has ended."""
        (_, lowest), _ = _CAR.limits
        if not (-1 <= steering <= 1 and lowest <= throttle <= 1):
            raise TrainingError(
                f"steering must be in [-1, 1] and throttle in [{lowest:g}, 1]", found=(steering, throttle)
            )
        if self.done:
            raise TrainingError(f"world {self.seed} has ended ({self.outcome})", remedy="make a new one")
        s = self.state
        wheels = s.steering + (steering - s.steering) * (1 - math.exp(-dt / STEERING_LAG_S))
        target_mps = throttle * SPEED_PER_THROTTLE_MPS * self._speed
        speed = s.speed_mps + (target_mps - s.speed_mps) * (1 - math.exp(-dt / SPEED_LAG_S))
        yaw_rps = speed / WHEELBASE_M * math.tan(self.left * wheels * WHEEL_ANGLE_RAD) * self._steering
        sideways_mps = -self._slip_s * speed * yaw_rps  # outwards, as the tyres slip
        for shove in self._shoves:
            if shove.start_s <= s.time_s < shove.end_s:
                yaw_rps += shove.yaw_rps
                sideways_mps += shove.sideways_mps
        middle = s.heading_rad + yaw_rps * dt / 2
        self.state = replace(
            s,
            x_m=s.x_m + (speed * math.cos(middle) - sideways_mps * math.sin(middle)) * dt,
            y_m=s.y_m + (speed * math.sin(middle) + sideways_mps * math.cos(middle)) * dt,
            heading_rad=s.heading_rad + yaw_rps * dt,
            speed_mps=speed,
            steering=wheels,
            steering_command=steering,
            throttle_command=throttle,
            time_s=s.time_s + dt,
        )
        self.trajectory.append(self.state)
        distance, bearing = self.balloon_seen()
        if distance < HIT_DISTANCE_M:
            self.outcome = "hit"
        elif any(self.seen(thing)[0] < thing.radius_m + CAR_HALF_M for thing in self.solid):
            self.outcome = "bumped"
        elif (distance < 1.5 and abs(bearing) > 1.4) or math.hypot(self.state.x_m, self.state.y_m) > ARENA_RADIUS_M:
            self.outcome = "left"
        elif self.state.time_s >= self.level.timeout_s:
            self.outcome = "timeout"

    def balloon_seen(self) -> tuple[float, float]:
        """Return the balloon's distance in metres and its bearing in radians from the camera."""
        return self.seen(self.balloon)

    def seen(self, thing: Thing) -> tuple[float, float]:
        """Return a thing's distance in metres and its bearing in radians from the camera."""
        ahead_m, left_m = self._local(thing.x_m, thing.y_m)
        return _polar(ahead_m, left_m)

    def _local(self, x_m: float, y_m: float) -> tuple[float, float]:
        dx, dy = x_m - self.state.x_m, y_m - self.state.y_m
        cos, sin = math.cos(self.state.heading_rad), math.sin(self.state.heading_rad)
        return cos * dx + sin * dy, cos * dy - sin * dx

    def render(self) -> np.ndarray:
        """Draw what the front camera sees now: (360, 640, 3) uint8 BGR."""
        frame = np.empty((FRAME_HEIGHT, FRAME_WIDTH, 3), np.uint8)
        first = round(-self.state.heading_rad * FOCAL_PX) % (self._wall.shape[1] - FRAME_WIDTH)
        frame[:HORIZON_ROW] = self._wall[:, first : first + FRAME_WIDTH]
        self._draw_floor(frame)
        visible = []
        for thing in (*self.distractors, self.balloon):
            ahead_m, left_m = self._local(thing.x_m, thing.y_m)
            if ahead_m > 0.12 and abs(left_m) < 1.2 * ahead_m + 0.5:
                visible.append((ahead_m, left_m, thing))
        # Far things first, so that near ones hide them.
        for ahead_m, left_m, thing in sorted(visible, key=lambda s: -s[0]):
            _draw_thing(frame, ahead_m, left_m, thing)
        depth, rate, phase = self._flicker
        gain = self._gain * (1 + depth * math.sin(rate * self.state.time_s + phase))
        lit: np.ndarray = cv2.multiply(frame, self._light, scale=gain / 128)
        if self._glare is not None:
            bearing, row = self._glare_at
            column = CENTRE_COLUMN - (bearing - self.state.heading_rad) * FOCAL_PX
            _add_light(lit, self._glare, round(column), row)
        return lit

    def _draw_floor(self, frame: np.ndarray) -> None:
        s = self.state
        cos, sin = math.cos(s.heading_rad), math.sin(s.heading_rad)
        # Below the horizon a pixel (u, v) shows the floor at ahead = f h / (v - v0), left = (u0 - u) h / (v - v0).
        ahead_row = [0, 0, FOCAL_PX * CAMERA_HEIGHT_M]
        left_row = [-CAMERA_HEIGHT_M, 0, CENTRE_COLUMN * CAMERA_HEIGHT_M]
        to_local = np.array([ahead_row, left_row, [0, 1, -HORIZON_ROW]])
        to_floor = np.array([[cos, -sin, s.x_m], [sin, cos, s.y_m], [0, 0, 1]])
        middle = HORIZON_ROW + FAR_ROWS
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        for texture, first, last in ((self._far_floor, HORIZON_ROW, middle), (self._floor, middle, FRAME_HEIGHT)):
            px_per_m = FLOOR_PX_PER_M * texture.shape[0] / FLOOR_TILE_PX
            from_crop = np.array([[1, 0, 0], [0, 1, first + 0.5], [0, 0, 1.0]])
            matrix = np.diag([px_per_m, px_per_m, 1]) @ to_floor @ to_local @ from_crop
            options: dict[str, Any] = {"dst": frame[first:last], "flags": flags, "borderMode": cv2.BORDER_WRAP}
            cv2.warpPerspective(texture, matrix, (FRAME_WIDTH, last - first), **options)


def expert(world: World) -> tuple[float, float]:
    """Return what a good driver does now: (steering, throttle)."""
    distance, bearing = world.balloon_seen()
    bearing = _around(world, distance, bearing)
    limit = STEERING_MOST_AROUND if world.solid else STEERING_MOST
    steering = world.left * float(np.clip(1.1 * bearing, -limit, limit))
    in_turn = 1 - 0.55 * min(1.0, abs(bearing) / 0.5)
    near = float(np.clip(0.35 + 0.65 * (distance - 0.5) / 1.2, 0.35, 1.0))
    target = THROTTLE_MOST * in_turn * near
    before = world.state.throttle_command
    throttle = min(max(target, before - THROTTLE_FALL_PER_S / RATE_HZ), before + THROTTLE_RISE_PER_S / RATE_HZ)
    return steering, throttle


def _around(world: World, distance: float, bearing: float) -> float:
    """Return where to drive instead of straight to the balloon: past what is solid, on the balloon's side of it."""
    for thing in sorted(world.solid, key=lambda thing: world.seen(thing)[0]):
        away, at = world.seen(thing)
        if away > distance or abs(at) > SEEN_RAD:
            continue
        clearance_rad = math.asin(min(1.0, (thing.radius_m + CLEARANCE_M) / away))
        if abs(bearing - at) < clearance_rad:
            return at + math.copysign(clearance_rad, bearing - at)
    return bearing


def _polar(x_m: float, y_m: float) -> tuple[float, float]:
    """Return a point's distance and its bearing in radians."""
    return math.hypot(x_m, y_m), math.atan2(y_m, x_m)


def _point(distance: float, bearing: float) -> tuple[float, float]:
    return distance * math.cos(bearing), distance * math.sin(bearing)


def _distractors(rng: np.random.Generator, balloon: Thing) -> Iterator[Thing]:
    for _ in range(int(rng.integers(2, 7))):
        kind = str(rng.choice(["balloon", "box", "cone"]))
        base = _DISTRACTOR_BGR[int(rng.integers(len(_DISTRACTOR_BGR)))]
        blue, green, red = (int(c) for c in np.clip(np.array(base) * rng.uniform(0.75, 1.2), 0, 255))
        distance = rng.uniform(1.2, 6.0)
        bearing = rng.uniform(-0.9, 0.9)
        x, y = _point(distance, bearing)
        radius = rng.uniform(0.10, 0.18)
        height = rng.uniform(0.2, 0.4) if kind == "balloon" else rng.uniform(0.15, 0.45)
        to_balloon = math.hypot(balloon.x_m, balloon.y_m)
        along = (x * balloon.x_m + y * balloon.y_m) / to_balloon
        aside = abs(x * balloon.y_m - y * balloon.x_m) / to_balloon
        if aside < 0.45 and along < to_balloon + 0.3:
            continue  # it would hide the balloon from a car that drives straight to it
        yield Thing(kind, x, y, radius, height, (blue, green, red))


def _nearly_red(rng: np.random.Generator, thing: Thing) -> Thing:
    blue, green, red = _NEARLY_RED_BGR[int(rng.integers(len(_NEARLY_RED_BGR)))]
    return replace(thing, colour=(blue, green, red)) if rng.random() < 0.5 else thing


def _hider(rng: np.random.Generator, balloon: Thing, hidden_share: float) -> Thing:
    """Return what stands on the way to the balloon and hides this share of its width from the start."""
    to_balloon, bearing = _polar(balloon.x_m, balloon.y_m)
    kind = str(rng.choice(["balloon", "box", "cone"]))
    colour = (*_DISTRACTOR_BGR, *_NEARLY_RED_BGR)[int(rng.integers(len(_DISTRACTOR_BGR) + len(_NEARLY_RED_BGR)))]
    radius = rng.uniform(0.10, 0.16)
    distance = to_balloon * rng.uniform(0.5, 0.65)
    widths = balloon.radius_m / to_balloon, radius / distance
    aside = rng.choice([-1.0, 1.0]) * (sum(widths) - 2 * hidden_share * widths[0])
    x, y = _point(distance, bearing + aside)
    return Thing(kind, x, y, radius, rng.uniform(0.24, 0.45), colour)


def _decoys(rng: np.random.Generator, balloon: Thing, count: int) -> Iterator[Thing]:
    """Yield boxes and cones in a balloon's red, about as far away as the balloon and well beside the way to it."""
    to_balloon, bearing = _polar(balloon.x_m, balloon.y_m)
    for _ in range(count):
        kind = str(rng.choice(["box", "cone"]))
        aside = rng.choice([-1.0, 1.0]) * rng.uniform(DECOY_ASIDE_RAD, 2 * DECOY_ASIDE_RAD)
        distance = to_balloon * rng.uniform(0.8, 1.2)
        red = (int(rng.integers(20, 50)), int(rng.integers(15, 45)), int(rng.integers(190, 240)))
        x, y = _point(distance, bearing + aside)
        yield Thing(kind, x, y, rng.uniform(0.10, 0.18), rng.uniform(0.2, 0.45), red)


def _shoves(rng: np.random.Generator, count: int, drags: float) -> Iterator[Shove]:
    for i in range(count):
        start = 0.3 + 1.1 * i + rng.uniform(0.0, 0.8)
        length = rng.uniform(0.10, 0.20)
        turn = rng.choice([-1.0, 1.0]) * rng.uniform(0.12, 0.45)
        if drags and rng.random() < drags:
            length *= DRAG
        yield Shove(start, start + length, turn / length, rng.uniform(-0.12, 0.12) / length)


def _noise(rng: np.random.Generator, size: int, cells: int) -> np.ndarray:
    """Return (size, size) float32 noise in about [-1, 1], smooth over size / cells pixels, that repeats seamlessly."""
    grid = rng.uniform(-1, 1, (cells, cells)).astype(np.float32)
    wrapped = np.pad(grid, 2, mode="wrap")
    cell = size // cells
    big = cv2.resize(wrapped, None, fx=cell, fy=cell, interpolation=cv2.INTER_CUBIC)
    return big[2 * cell : 2 * cell + size, 2 * cell : 2 * cell + size]


def _floor(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return a floor that repeats every four metres, (640, 640, 3) uint8, and a blurred one of (80, 80, 3)."""
    size = FLOOR_TILE_PX
    base = rng.uniform(70, 170) + rng.uniform(-22, 22, 3)
    shade = _noise(rng, size, 10) * rng.uniform(4, 16) + _noise(rng, size, 80) * rng.uniform(2, 10)
    shade += rng.normal(0, rng.uniform(1, 6), (size, size)).astype(np.float32)
    pattern = str(rng.choice(["plain", "tiles", "planks", "carpet"]))
    if pattern == "tiles":
        pitch = int(rng.choice([40, 64, 80]))
        step = np.arange(size) // pitch
        shade += ((step[:, None] + step[None]) % 2) * rng.uniform(-25, 25)
        joints = (np.arange(size) % pitch) < 2
        shade -= (joints[:, None] | joints[None]) * rng.uniform(10, 40)
    elif pattern == "planks":
        rows = np.repeat(rng.uniform(-16, 16, size // 32), 32)
        shade += rows[:, None] + ((np.arange(size) % 32) < 2)[:, None] * -25
    elif pattern == "carpet":
        stripes = np.sin(np.arange(size) * 2 * np.pi * int(rng.integers(4, 16)) / size)
        shade += stripes[None] * rng.uniform(6, 22)
    floor = np.clip(base[None, None] + shade[..., None], 0, 255).astype(np.uint8)
    far = cv2.GaussianBlur(cv2.resize(floor, (80, 80), interpolation=cv2.INTER_AREA), (0, 0), 2.0)
    return floor, far


def _wall(rng: np.random.Generator) -> np.ndarray:
    """Return the panorama above the horizon, (125, w + 640, 3) uint8: a turn of w columns, and its first 640 again."""
    width = round(2 * math.pi * FOCAL_PX)
    top, bottom = (rng.uniform(90, 220) + rng.uniform(-25, 25, 3) for _ in range(2))
    ramp = np.linspace(0, 1, HORIZON_ROW)[:, None, None]
    wall = np.broadcast_to(top * (1 - ramp) + bottom * ramp, (HORIZON_ROW, width, 3)).astype(np.float32)
    wall = np.ascontiguousarray(np.clip(wall, 0, 255).astype(np.uint8))
    for _ in range(int(rng.integers(4, 18))):
        x = int(rng.integers(0, width - 160))
        y = int(rng.integers(0, 100))
        w = int(rng.integers(20, 160))
        h = int(rng.integers(15, 110))
        grey = rng.uniform(40, 210)
        colour = np.clip(grey + rng.uniform(-35, 35, 3), 0, 255)
        cv2.rectangle(wall, (x, y), (x + w, min(y + h, HORIZON_ROW - 4)), colour.tolist(), cv2.FILLED)
    skirting = rng.uniform(40, 200)
    wall[HORIZON_ROW - int(rng.integers(2, 7)) :] = np.uint8(skirting)
    return np.ascontiguousarray(np.concatenate([wall, wall[:, :FRAME_WIDTH]], axis=1))


def _paint_red(rng: np.random.Generator, floor: np.ndarray, far_floor: np.ndarray, wall: np.ndarray) -> None:
    """Paint round spots in a balloon's red on the floor, and on the wall above the horizon."""
    blurred = FLOOR_TILE_PX // far_floor.shape[0]
    turn = wall.shape[1] - FRAME_WIDTH
    for _ in range(int(rng.integers(1, 7))):
        colour = (int(rng.integers(20, 50)), int(rng.integers(15, 45)), int(rng.integers(170, 240)))
        centre = rng.integers(30, FLOOR_TILE_PX - 30, 2)
        radius = int(rng.integers(12, 28))
        cv2.circle(floor, centre.tolist(), radius, colour, cv2.FILLED, cv2.LINE_AA)
        cv2.circle(far_floor, (centre // blurred).tolist(), radius // blurred, colour, cv2.FILLED)
        place = int(rng.integers(20, turn - 20)), int(rng.integers(20, HORIZON_ROW - 25))
        cv2.ellipse(wall, place, (radius // 2, round(0.56 * radius)), 0, 0, 360, colour, cv2.FILLED, cv2.LINE_AA)
    wall[:, turn:] = wall[:, :FRAME_WIDTH]


def _glare(rng: np.random.Generator, brightest: float) -> np.ndarray:
    """Return the light that a lamp or a window throws into the camera, (n, n, 3) uint8, brightest in its middle."""
    half = round(GLARE_PX * rng.uniform(0.5, 1.5))
    away = np.linspace(-1, 1, 2 * half) ** 2
    light = brightest * rng.uniform(0.2, 1.0) * np.clip(1 - away[:, None] - away, 0, 1) ** 2
    return np.repeat(light[..., None], 3, axis=2).astype(np.uint8)


def _add_light(frame: np.ndarray, light: np.ndarray, column: int, row: int) -> None:
    x, y = column - light.shape[1] // 2, row - light.shape[0] // 2
    x0, x1 = max(0, x), min(frame.shape[1], x + light.shape[1])
    y0, y1 = max(0, y), min(frame.shape[0], y + light.shape[0])
    if x0 < x1 and y0 < y1:
        frame[y0:y1, x0:x1] = cv2.add(frame[y0:y1, x0:x1], light[y0 - y : y1 - y, x0 - x : x1 - x])


def _light(rng: np.random.Generator, most_tint: float) -> np.ndarray:
    """Return how each pixel is lit, (360, 640, 3) uint8, where 128 changes nothing: a slope, a tint, dark corners."""
    x = np.linspace(-1, 1, FRAME_WIDTH)[None]
    y = np.linspace(-1, 1, FRAME_HEIGHT)[:, None]
    slope = 1 + rng.uniform(-0.2, 0.2) * x + rng.uniform(-0.15, 0.15) * y - rng.uniform(0, 0.12) * (x**2 + y**2)
    tint = 1 + rng.uniform(-most_tint, most_tint, 3)
    return np.clip(128 * slope[..., None] * tint, 0, 255).astype(np.uint8)


_SHIFT = 3  # coordinates are in eighths of a pixel, so that a thing moves smoothly
_ONE = 1 << _SHIFT


def _draw_thing(frame: np.ndarray, ahead_m: float, left_m: float, thing: Thing) -> None:
    scale = FOCAL_PX / ahead_m
    column = CENTRE_COLUMN - left_m * scale
    foot = HORIZON_ROW + CAMERA_HEIGHT_M * scale
    _draw_shadow(frame, column, foot, thing.radius_m, ahead_m)
    if thing.kind == "balloon":
        middle = HORIZON_ROW + (CAMERA_HEIGHT_M - thing.height_m) * scale
        string = (int(column), int(middle)), (int(column + 0.01 * scale), int(min(foot, 2 * FRAME_HEIGHT)))
        cv2.line(frame, *string, (215, 215, 215), max(1, round(0.004 * scale)), cv2.LINE_AA)
        _draw_sphere(frame, column, middle, thing.radius_m * scale, thing.colour)
        return
    top = HORIZON_ROW + (CAMERA_HEIGHT_M - thing.height_m) * scale
    half = thing.radius_m * scale
    upper = half if thing.kind == "box" else 0.1 * half
    corners = np.array([[column - upper, top], [column + upper, top], [column + half, foot], [column - half, foot]])
    cv2.fillConvexPoly(frame, (corners * _ONE).astype(np.int32), thing.colour, cv2.LINE_AA, _SHIFT)
    lit = [min(255, c * 1.25 + 12) for c in thing.colour]
    corners[[1, 2], 0] = column + 0.15 * np.array([-upper, -half])
    cv2.fillConvexPoly(frame, (corners * _ONE).astype(np.int32), lit, cv2.LINE_AA, _SHIFT)


def _draw_shadow(frame: np.ndarray, column: float, foot: float, radius_m: float, ahead: float) -> None:
    half_width = FOCAL_PX * radius_m * 0.9 / ahead
    half_height = half_width * CAMERA_HEIGHT_M / ahead
    x0, x1 = max(0, int(column - half_width)), min(FRAME_WIDTH, int(column + half_width) + 1)
    y0, y1 = max(0, int(foot - half_height)), min(FRAME_HEIGHT, int(foot + half_height) + 1)
    if x0 >= x1 or y0 >= y1:
        return
    x = (np.arange(x0, x1, dtype=np.float32) - column) / max(half_width, 1)
    y = (np.arange(y0, y1, dtype=np.float32) - foot) / max(half_height, 1)
    keep = np.clip(0.5 + 0.6 * (x[None] ** 2 + y[:, None] ** 2), 0, 1)
    part = frame[y0:y1, x0:x1]
    part[:] = part * keep[..., None]


def _draw_sphere(frame: np.ndarray, column: float, row: float, radius: float, colour: tuple[int, int, int]) -> None:
    """Draw a balloon: a little taller than wide, dark at its rim, with a highlight towards the upper left."""
    rings = int(np.clip(radius / 8, 3, 14))  # enough that a near balloon shows no steps
    for i in range(rings):
        share = i / (rings - 1)
        size = radius * (1 - 0.85 * share)
        shade = 0.62 + 0.50 * share
        lift = 70 * max(0.0, share - 0.7) / 0.3
        centre = round((column - 0.28 * radius * share) * _ONE), round((row - 0.33 * radius * share) * _ONE)
        axes = max(1, round(size * _ONE)), max(1, round(1.12 * size * _ONE))
        lit = [min(255.0, c * shade + lift) for c in colour]
        cv2.ellipse(frame, centre, axes, 0, 0, 360, lit, cv2.FILLED, cv2.LINE_AA, _SHIFT)

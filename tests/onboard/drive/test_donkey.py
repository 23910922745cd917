"""The part for donkeycar: beside our own loop in virtual time, and in donkeycar's own where that is installed."""

import re
import textwrap
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from rover_lib.onboard.car.camera import Camera
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.drive import donkey
from rover_lib.onboard.drive.donkey import NEUTRAL, RoverPilot
from rover_lib.onboard.drive.inference import PolicyProcess
from rover_lib.onboard.drive.loop import Until, drive
from rover_lib.onboard.drive.pilot import PolicyPilot
from rover_lib.onboard.drive.plan import Commanded, Follower, Plan, Settings
from rover_lib.onboard.errors import DriveFault, RoverError
from rover_lib.onboard.params import params
from tests.helpers import needs
from tests.helpers.fake_drive import Clock, Log

HZ, TURN_S = 20.0, 1 / 16  # a plan's steps a second; a turn of the loop, of another length, and exact in floats
PAGE = Path(__file__).parents[3] / "docs/donkeycar.md"
PLANNED = np.stack([np.linspace(-0.5, 0.5, 32), np.linspace(0.1, 0.18, 32)], 1)  # what is meant changes with time


def picture(turn):
    """What the car's camera shows at a turn of the loop, (60, 80, 3) uint8 RGB."""
    blocks = np.random.default_rng(turn).integers(60, 200, (6, 8, 3), np.uint8)
    return blocks.repeat(10, axis=0).repeat(10, axis=1)  # single pixels would be noise, and no motion


def black(turn):
    return picture(turn) // 64


class Drive:
    """A policy, what plans by it in virtual time, and what the camera shows: at each turn, from `turn` on."""

    def __init__(self, clock, car=None):
        self.clock, self.car = clock, car or Car()
        self.states, self.latency_s, self.wrong, self.strange, self.show = [], 0.1, 0.0, None, picture
        self.rate_hz, self.closed = HZ, threading.Event()
        size = {"height": 60, "width": 80, "name": "front"}
        self.manifest = {"cameras": [size], "car": self.car.description()}

    def __enter__(self):
        return self

    def close(self):
        self.closed.wait(10)

    def predict(self, frame_bgr, state):
        self.states.append((self.clock(), state.tolist()))
        return PLANNED + self.wrong + [frame_bgr[..., 0].mean() / 2000 + state[0] / 10, 0]


class Planning:
    """inference.Planner without a thread: a plan is ready when the drive's latency is over."""

    def __init__(self, camera, policy, commanded, *, rest_s=0, limits, clock):
        self.camera, self.policy, self.commanded, self.limits, self.clock = camera, policy, commanded, limits, clock
        self.plan, self.asked, self.number, self.asking_s, self.failure = None, None, 0, 0.0, None

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        pass

    def without_rest(self):
        return threading.Lock()

    def newest(self):
        if self.failure:
            raise self.failure
        if self.asked and self.clock() >= self.asked[2] - 1e-9:
            captured_s, actions, ready_s = self.asked
            self.number, self.asked = self.number + 1, None
            try:
                self.plan = Plan(self.number, captured_s, ready_s, actions, self.limits, self.policy.strange)
            except RoverError as error:
                self.failure = error
                raise
        frame = self.camera.latest()
        if not self.asked and frame and (self.plan is None or frame.captured_s > self.plan.captured_s):
            actions = self.policy.predict(frame.image, self.commanded.state(frame.captured_s, HZ))
            self.asked = frame.captured_s, actions, self.clock() + self.policy.latency_s
        return self.plan


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def world(clock, monkeypatch):
    """world(car): a part whose policy is a Drive, and that."""
    monkeypatch.setattr(donkey, "Planner", Planning)

    def make(car=None, **options):
        policy = Drive(clock, car)
        monkeypatch.setattr(donkey, "PolicyProcess", lambda path: policy)
        return RoverPilot("policy.pt", clock=clock, **options), policy

    return make


class Loop:
    """donkeycar's turns: what DriveMode sends is the part's input a turn later. turn_s: from one turn to the next."""

    def __init__(self, part, policy, clock, events=(), turn_s=TURN_S):
        self.part, self.policy, self.clock, self.events, self.turn_s = part, policy, clock, dict(events), turn_s
        self.turn, self.sent, self.rows = 0, (None, None), []

    def go(self, turns, mode="local", hand=NEUTRAL):
        for _ in range(turns):
            self.events.get(self.turn, lambda policy: None)(self.policy)
            answer = self.part.run(self.policy.show(self.turn), mode, *self.sent)
            self.sent = hand if mode == "user" else answer
            self.rows.append((self.clock() - 1000, *answer))
            self.clock.sleep(self.turn_s)
            self.turn += 1
        return answer


def driven_by_us(clock, events, turns, begun):
    """The rows of our own loop, and why it ended: the same turns, the same policy."""
    clock.now, rows, policy = 1000.0, [], Drive(clock)
    camera, commanded, settings = Camera("cam", rate_hz=HZ, clock=clock), Commanded(), Settings.of(params()["drive"])
    planner = Planning(camera, policy, commanded, limits=policy.car.limits, clock=clock)

    class Own(PolicyPilot):
        turn, shown = -1, None

        def look(self):
            if (turn := round((clock() - 1000) / TURN_S)) == self.turn:
                return
            self.turn = turn
            events.get(turn, lambda policy: None)(policy)
            if (image := policy.show(turn)) is not None and not np.array_equal(image, self.shown):
                camera.add(np.ascontiguousarray(image[..., ::-1]), clock(), None)
                self.shown = image

        def ready(self, stop):
            self.look()
            while clock() < 1000 + begun * TURN_S or planner.newest() is None:
                rows.append((clock() - 1000, *NEUTRAL))
                clock.sleep(TURN_S)
                self.look()
            self.check()

        def order(self, now_s):
            self.look()
            order = super().order(now_s)
            rows.append((now_s - 1000, order.steering, order.throttle))
            return order

    pilot = Own(camera, planner, commanded, settings, HZ)
    try:
        drive(pilot, None, Log(), rate_hz=1 / TURN_S, until=Until(ticks=turns), clock=clock, sleep=clock.sleep)
        return rows, ""
    except DriveFault as error:
        return rows, str(error)


def change(**values):
    return lambda policy: vars(policy).update(values)


FROZEN = picture(0)
FAULTS = {
    "nothing": ({}, ""),
    "unfamiliar": ({30: change(strange=1.5)}, "the policy has seen nothing like these pictures"),
    "black": ({30: change(show=black)}, "the camera's picture is black"),
    "frozen": ({30: change(show=lambda turn: FROZEN)}, "no new frame for 0.19 s"),
    "repeats": ({30: change(show=lambda turn: picture(turn % 2))}, "the camera is frozen"),
    "stuck": ({30: change(show=lambda turn: FROZEN + picture(turn) // 64)}, "the picture does not move"),
    "gone": ({30: change(show=lambda turn: None)}, "no new frame for 0.19 s"),
    "late": ({30: change(latency_s=3.0)}, "the newest plan is too old to drive by"),
    "slow": ({30: change(latency_s=0.45)}, ""),  # the throttle fades, and comes again
    "not finite": ({30: change(wrong=np.nan)}, "is not finite"),
    "far out": ({30: change(wrong=3.0)}, "outside the range of a servo"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_drives_and_stops_as_our_own_loop(fault, world, clock):
    events, match = FAULTS[fault]
    loop = Loop(*world(), clock, events)
    loop.go(2, "user")
    loop.go(70)
    ours, why = driven_by_us(clock, events, 72, begun=2)
    ours = ours[: len(loop.rows)]
    assert np.array(loop.rows[: len(ours)]) == pytest.approx(np.array(ours), abs=1e-9)
    assert all(row[1:] == NEUTRAL for row in loop.rows[len(ours) :])
    assert loop.part.stopped == why and match in why
    assert len(ours) == len(loop.rows) or match
    assert np.ptp([row[1] for row in ours]) > 0.05 and max(row[2] for row in ours) > 0.1


def test_the_policys_state_is_what_went_to_the_car_a_step_before(world, clock):
    loop = Loop(*world(), clock, turn_s=TURN_S)
    loop.go(3, "user", hand=(0.25, 0.125))
    loop.go(30)
    sent = {1000 + t_s: answer for t_s, *answer in loop.rows} | {1000 + t * TURN_S: [0.25, 0.125] for t in range(3)}
    for asked_s, state in loop.policy.states:
        assert state == pytest.approx(sent[asked_s - TURN_S])


def test_a_car_whose_positive_side_is_left(world, clock):
    """The same plans, seen from the other side, and a state that is turned over with them."""
    content = Car().description()
    content["steering"] |= {"positive": "left"}
    loop = Loop(*world(car := Car.of(content)), clock)
    loop.go(1, "user", hand=(0.5, 0.0))
    loop.go(30)
    assert car.left == 1 and loop.policy.states[0][1] == [-0.5, 0]
    assert loop.rows[6][1] > 0.2  # the plan begins at -0.5


def test_a_human_begins_each_drive(world, clock):
    part, policy = world()
    loop = Loop(part, policy, clock, {40: change(wrong=np.nan), 60: change(wrong=0.0)})
    assert loop.go(20) == NEUTRAL and "no human has driven yet" in part.stopped  # WEB_INIT_MODE = "local"
    loop.go(1, "user")
    assert loop.go(15, "local_angle")[1] > 0.05
    assert loop.go(50) == NEUTRAL and "not finite" in part.stopped  # and still at turn 85, where nothing is wrong
    loop.go(1, "user")
    assert not part.stopped and loop.go(15)[1] > 0.05
    assert loop.go(15, None) == NEUTRAL  # whose mode nobody knows, donkeycar would drive by the pilot


def test_a_pause_of_the_loop_stops_the_car(world, clock):
    loop = Loop(*world(), clock, {30: lambda policy: clock.sleep(0.08), 40: lambda policy: clock.sleep(0.1)})
    loop.go(1, "user")
    assert loop.go(35)[1] > 0.05
    assert loop.go(10) == NEUTRAL and "loop paused for 0.16 s" in loop.part.stopped


def test_a_slower_camera_is_not_frozen(world, clock):
    part, policy = world()
    policy.show = lambda turn: picture(turn // 7)  # 18 pictures a second
    loop = Loop(part, policy, clock, turn_s=1 / 128)
    loop.go(7, "user")
    assert loop.go(600)[1] > 0.05 and not part.stopped
    assert len(policy.states) < 60  # no picture is planned from twice


def test_a_standing_car_may_see_the_same_picture(world, clock):
    events = {30: change(wrong=np.array([0, -0.2])), 50: change(show=lambda turn: FROZEN), 85: change(show=picture)}
    loop = Loop(*world(), clock, events | {90: change(wrong=0.0)})
    loop.go(1, "user")
    assert loop.go(80)[1] == 0 and not loop.part.stopped
    assert loop.go(30)[1] > 0.05


@pytest.mark.parametrize(
    ("wrong", "match"),
    [
        ({"strange": 1.5}, "seen nothing like these pictures"),
        ({"show": black}, "picture is black"),
        ({"show": lambda turn: picture(turn)[:, :60]}, "must have the shape of the policy's"),
        ({"show": lambda turn: None}, "no fresh plan within 0.8 s"),
        ({"latency_s": 2.0}, "no fresh plan within 0.8 s"),
    ],
)
def test_does_not_begin_where_our_rover_would_not_be_armed(world, clock, wrong, match):
    part, policy = world()
    change(**wrong)(policy)
    loop = Loop(part, policy, clock)
    loop.go(20, "user")
    loop.go(40)
    assert {row[1:] for row in loop.rows} == {NEUTRAL} and match in part.stopped


def test_nothing_is_raised_into_the_loop(world, clock):
    part, policy = world(throttle_limit=0.11)
    loop = Loop(part, policy, clock)
    loop.go(1, "user")
    assert loop.go(20)[1] == 0.11
    wrong = ((np.zeros((60, 80), np.uint8), 0, 0), (picture(0)[:, :40], 0, 0), ("picture", 0, 0), (picture(99), "a", 0))
    for image, *sent in wrong:
        assert part.run(image, "local", *sent) == NEUTRAL and part.stopped
        loop.go(1, "user")
    began_s = time.monotonic()
    part.shutdown()
    assert time.monotonic() - began_s < 0.5
    policy.closed.set()


@needs.real_time
def test_the_pages_lines_drive_in_donkeycars_own_loop(tmp_path, monkeypatch):
    """A real artifact in its own process, in real time: each action is our own follower's by our own engine's plans."""
    dk = pytest.importorskip("donkeycar", reason="needs donkeycar, which needs Python 3.12: .ci/run installs it")
    from donkeycar.parts.transform import Lambda
    from donkeycar.templates.complete import DriveMode

    from lab.driving.policy import make_artifact
    from rover_lib.onboard.policy.load import load_policy

    make_artifact(
        tmp_path / "policy_static.onnx.zip", size=(60, 80), plan=PLANNED, follows=0.5
    )  # of torch: the name does not count
    monkeypatch.chdir(tmp_path)
    asked, calls, turns = [], [], []
    predict, add, command = PolicyProcess.predict, Follower.add, Follower.command

    def asks(process, *observed):
        asked.append((*observed, predict(process, *observed)))
        return asked[-1][2]

    def adds(follower, plan, now_s):
        calls.append(lambda ours: add(ours, plan, now_s))
        add(follower, plan, now_s)

    def commands(follower, now_s):
        calls.append(lambda ours: command(ours, now_s))
        return command(follower, now_s)

    monkeypatch.setattr(PolicyProcess, "predict", asks)
    monkeypatch.setattr(Follower, "add", adds)
    monkeypatch.setattr(Follower, "command", commands)
    vehicle = dk.Vehicle()
    vehicle.add(Lambda(lambda: picture(len(turns))), outputs=["cam/image_array"])
    vehicle.add(Lambda(lambda: "user" if len(turns) < 5 else "local"), outputs=["user/mode"])
    vehicle.mem.update({"user/angle": 0.0, "user/throttle": 0.0})
    lines = re.search(r"<!-- manage.py -->\n(.*?)<!-- end -->", PAGE.read_text(), re.DOTALL)[1]
    exec(textwrap.dedent(lines), {"V": vehicle})
    vehicle.add(DriveMode(), outputs=["steering", "throttle"],
                inputs=["user/mode", "user/angle", "user/throttle", "pilot/angle", "pilot/throttle"])  # fmt: skip
    vehicle.add(Lambda(lambda *sent: turns.append(sent)), inputs=["steering", "throttle"])
    part = vehicle.parts[2]["part"]
    vehicle.start(rate_hz=20, max_loop_count=60)
    assert len(turns) == 60 and part.stopped == "shut down"
    ours = Follower(part._settings, 30.0)
    meant = [made for call in calls if (made := call(ours))]
    assert len(meant) > 40 and turns[-len(meant) :] == [(made.steering, made.throttle) for made in meant]
    assert all(turn == NEUTRAL for turn in turns[: -len(meant)])
    policy = load_policy("policy_static.onnx.zip")
    for frame, state, answer in asked:
        assert answer == pytest.approx(policy.predict_unclipped(frame, state), abs=1e-5)
    assert len({answer[0, 0] for *_, answer in asked}) > 10

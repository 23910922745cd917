"""What a drive sends to a view, and that no view can delay a tick. The loop has a virtual clock, the socket is real."""

import contextlib
import json
import socket
from dataclasses import replace
from functools import partial
from unittest.mock import Mock

import numpy as np
import pytest

from rover_lib.onboard.car.camera import CameraError, Frame
from rover_lib.onboard.car.servo_link import State
from rover_lib.onboard.drive import feed as f
from rover_lib.onboard.drive.flight_log import FlightLog, read_log
from rover_lib.onboard.drive.loop import Hooks, Report, Until, drive
from rover_lib.onboard.drive.plan import Plan
from tests.helpers.fake_drive import STATUS, Always, Clock, Link

JPEG = b"\xff\xd8 a picture\n with a line's end \xff\xd9"
FRAME = Frame(np.zeros((36, 64, 3), np.uint8), 999.95, 5, 0, 100.0, 40.0, JPEG)
TICKS = 90


class Listener:
    """A view's socket. hello(): the connection to the drive, None until the drive has connected."""

    def __init__(self, place):
        self.wire = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        self.wire.bind(str(place))
        self.wire.listen(1)
        self.drive = None

    def hello(self):
        if self.drive is None:
            with contextlib.suppress(BlockingIOError):
                self.drive = self.wire.accept()[0]
                self.drive.setblocking(False)
        return self.drive

    def say(self, message):
        with contextlib.suppress(BlockingIOError):
            self.hello() and self.drive.send(message)

    def messages(self):
        found = []
        for _ in range(2):  # if the other end closed with something unread, the first read fails
            with contextlib.suppress(BlockingIOError, ConnectionResetError):
                while self.hello() and (data := self.drive.recv(1 << 20)):
                    line, _, picture = data.partition(b"\n")
                    found.append((json.loads(line), picture))
        return found

    def close(self):
        """Close the connection to the drive, which may make another one."""
        if self.drive:
            self.drive.close()
        self.drive = None


class Bench:
    """A drive with a feed. each: called whenever the loop sleeps. fails: what its camera raises."""

    def __init__(self, folder, each=lambda: None, frame=FRAME, fails=None):
        self.clock, self.report, self.eyes, self.pilot = Clock(), Report(), Mock(), Always()
        self.eyes.latest.configure_mock(return_value=frame, side_effect=fails)
        self.pilot.plan = Plan(3, 999.9, 1000.0, np.tile([0.25, 0.125], (32, 1))), 30.0
        self.link = Link(self.clock)
        self.clock.on_sleep = each
        self.path = folder / "flight.log"
        self.log = FlightLog(self.path, header={"hz": 30}, max_bytes=1_000_000, keep=1, clock=self.clock)
        self.feed = f.Feed(folder / "view", self.log, "policy.pt", clock=self.clock, sleep=self.clock.sleep)

    def drive(self, ticks=TICKS):
        """Return what the link was told, and when commands were sent."""
        with self.log:
            show = partial(self.feed.tick, self.report, self.eyes, self.pilot)
            until = Until(ticks=ticks, over=self.feed.over)
            drive(self.pilot, self.link, self.log, rate_hz=30, until=until, hooks=Hooks(show=show), report=self.report,
                  clock=self.clock, sleep=self.clock.sleep)  # fmt: skip
            self.ended_s = self.clock()
            self.feed.ended(self.report, self.eyes, self.link)
            self.feed.close()
        return self.link.said, self.link.sent_at


@pytest.fixture
def alone(tmp_path):
    """What a drive does that nobody watches."""
    (folder := tmp_path / "alone").mkdir()
    return Bench(folder).drive()


@pytest.fixture
def listener(tmp_path):
    listener = Listener(tmp_path / "view")
    with listener.wire:
        yield listener
        listener.close()


def test_a_message_is_the_flight_logs_tick_with_its_plan_and_picture(tmp_path, listener, alone):
    seen = []
    bench = Bench(tmp_path, lambda: seen.extend(listener.messages()))
    assert bench.drive() == alone
    seen += listener.messages()
    logged = read_log(bench.path).ticks
    driving = [m for m, _ in seen if m["phase"] == f.DRIVING]
    assert len(driving) == TICKS // 3  # ten messages a second at thirty ticks a second
    for message in driving:
        row = int(np.argmin(np.abs(logged["t_s"] - message["tick"]["t_s"])))
        for name in ("steering", "throttle", "steering_us", "throttle_us", "pins_throttle_us", "plan", "frame"):
            assert message["tick"][name] == logged[name][row]
        assert (message["pins"], message["who"], message["why"]) == ([1456, 120], "A", "armed by the host")
        assert (message["frame"], message["captured_s"], message["size"]) == (5, 999.95, [64, 36])
    assert {picture for _, picture in seen} == {JPEG}
    assert driving[-1]["plan"] == {"captured_s": 999.9, "rate_hz": 30.0, "actions": [[0.25, 0.125]] * 32}
    last = seen[-1][0]
    assert (last["phase"], last["text"], last["pins"]) == (f.ENDED, f"{TICKS} ticks", [1456, 120])
    assert "armed" in [text for _, text in last["events"]]


@pytest.mark.parametrize("message", [b"stop", b"arm", b"stop 1.2.3.4 arm", b"stop " + b"1" * 60])
def test_nothing_else_does_anything(tmp_path, listener, alone, message):
    assert Bench(tmp_path, lambda: listener.say(message)).drive() == alone


def test_a_view_that_reads_nothing_costs_nothing(tmp_path, listener, alone):
    bench = Bench(tmp_path, listener.hello, replace(FRAME, jpeg=bytes(60_000)))
    assert bench.drive() == alone
    assert 0.2 <= bench.clock() - bench.ended_s < 0.4  # the last message waits shortly
    assert len(listener.messages()) == 1  # no message waits behind another


@pytest.mark.parametrize("stops", [False, True])
def test_a_flood_moves_no_tick_and_a_stop_in_it_is_heard(tmp_path, listener, alone, stops):
    def flood():
        with contextlib.suppress(BlockingIOError):
            for _ in range(3 if stops and listener.hello() else 1000):
                listener.drive and listener.drive.send(b"x" * 1000)
        listener.hello()
        if stops and len(bench.link.drives) > 10:
            listener.say(b"stop 127.0.0.1")

    bench = Bench(tmp_path, flood)
    assert (bench.drive() == alone) is not stops
    assert bench.report.ended.startswith("stopped from the view") is stops


def test_views_that_come_and_go_move_no_tick(tmp_path, listener, alone):
    bench = Bench(tmp_path, lambda: listener.hello() and listener.close())
    assert bench.drive() == alone and "the view is gone" in [e.text for e in bench.log.recent]


@pytest.mark.parametrize("fails", [CameraError("unplugged"), ValueError("anything")])
def test_what_cannot_be_shown_stops_no_drive(tmp_path, listener, alone, fails):
    bench = Bench(tmp_path, listener.hello, fails=fails)
    assert bench.drive() == alone
    told = [e.text for e in bench.log.recent if "not fed any more" in e.text]
    assert len(told) == isinstance(fails, ValueError)


@pytest.mark.parametrize("jpeg", [None, bytes(400_000)])
def test_a_raw_picture_or_a_large_one_is_not_sent(tmp_path, listener, jpeg):
    Bench(tmp_path, listener.hello, replace(FRAME, jpeg=jpeg)).drive(ticks=1)
    message, picture = listener.messages()[0]
    assert picture == b"" and message["tick"]["throttle_us"] == 150


@pytest.mark.parametrize(
    ("phase", "missing", "said"), [(f.WAITING, "t", "let go of the throttle stick"), (f.TAKEN, "w", "")]
)
def test_while_it_waits_it_says_what_is_missing(tmp_path, listener, phase, missing, said):
    """But while a human is recorded it asks for nothing: nobody is about to arm the car."""
    bench = Bench(tmp_path)
    bench.link.status = replace(STATUS, state=State.MANUAL, reason="h", missing=missing)
    bench.feed.show(phase, "40 ticks", bench.report, bench.eyes, bench.link)
    bench.feed.show(phase, "too soon", bench.report, bench.eyes, bench.link)
    (message, picture), *more = listener.messages()
    assert (message["phase"], message["text"], picture, more) == (phase, "40 ticks", JPEG, [])
    assert (message["missing"], message["who"], message["why"]) == (said, "M", "the human moved a stick")
    listener.say(b"stop 127.0.0.1")
    assert bench.feed.over().startswith("stopped from the view")

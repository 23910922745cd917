"""What a drive sends to a view, and that no view can delay a tick. The loop has a virtual clock, the socket is real."""

import contextlib
import json
import socket
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from rover_lib.onboard.car.camera import CameraError, Frame
from rover_lib.onboard.car.pwm import PwmCalibration
from rover_lib.onboard.car.servo_link import MISSING, State, Telemetry
from rover_lib.onboard.drive import feed as f
from rover_lib.onboard.drive.flight_log import FlightLog, read_log
from rover_lib.onboard.drive.loop import Hooks, Report, Until, drive
from rover_lib.onboard.drive.pilot import Order
from rover_lib.onboard.drive.plan import Plan

STATUS = Telemetry(0.0, 7, 0, 0, "k", State.AUTONOMOUS, "a", "-", 1456, 150, 238, None, None, None, None, 0, 0, 0, 0)
JPEG = b"\xff\xd8 a picture\n with a line's end \xff\xd9"
TICKS = 90


class Clock:
    """A clock that advances only while somebody sleeps."""

    def __init__(self):
        self.now = 1000.0
        self.on_sleep = lambda: None

    def __call__(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds
        self.on_sleep()


class Link:
    port, calibration, remedy = "fake", PwmCalibration(), MISSING.get

    def __init__(self, clock):
        self.clock, self.said, self.status, self.sequence = clock, [], STATUS, 0

    def arm(self):
        return self.status

    def neutral(self):
        self.said.append((self.clock(), "neutral"))
        self.status = replace(self.status, state=State.STOPPED, reason="n", throttle_us=120)
        return self.status

    def send(self, steering_us, throttle_us):
        self.sequence += 1
        self.said.append((self.clock(), throttle_us))
        return self.sequence

    def latest(self):
        return replace(self.status, host_s=self.clock(), sequence=self.sequence)

    def unacknowledged_s(self, now_s):
        return 0.0


class Pilot:
    def __init__(self):
        self.plan = (Plan(3, 999.9, 1000.0, np.tile([0.25, 0.125], (32, 1))), 30.0)

    def ready(self, stop):
        pass

    def order(self, now_s):
        return Order(0.25, 0.125, 1500, 250, plan=3, age_s=0.1, latency_s=0.1, frame=5)

    def sent(self, at_s, order):
        pass


class Eyes:
    """A camera. frame: its newest frame, or an exception to raise."""

    def __init__(self, frame=None):
        self.frame = frame or Frame(np.zeros((36, 64, 3), np.uint8), 999.95, 5, 0, 100.0, 40.0, JPEG)

    def latest(self):
        if isinstance(self.frame, Exception):
            raise self.frame
        return self.frame


class Listener:
    """A view's socket. hello(): the connection to the drive, None until the drive has connected."""

    def __init__(self, place):
        self.place = place
        self.open()

    def open(self):
        with contextlib.suppress(FileNotFoundError):
            self.place.unlink()
        self.wire = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        self.wire.bind(str(self.place))
        self.wire.listen(1)
        self.drive = None

    def hello(self):
        if self.drive is None:
            with contextlib.suppress(BlockingIOError):
                self.drive = self.wire.accept()[0]
                self.drive.setblocking(False)
        return self.drive

    def messages(self):
        found = []
        for _ in range(2):  # if the other end closed with something unread, the first read fails
            with contextlib.suppress(BlockingIOError, ConnectionResetError):
                found += self.read()
        return found

    def read(self):
        found = []
        with contextlib.suppress(BlockingIOError):
            while self.hello() and (data := self.drive.recv(1 << 20)):
                line, _, picture = data.partition(b"\n")
                found.append((json.loads(line), picture))
        return found

    def close(self):
        if self.drive:
            self.drive.close()
        self.wire.close()


class Bench:
    """A drive with a feed. each: called whenever the loop sleeps."""

    def __init__(self, folder, each=lambda: None, eyes=None):
        self.clock, self.report, self.place = Clock(), Report(), folder / "view"
        self.link, self.eyes, self.pilot = Link(self.clock), eyes or Eyes(), Pilot()
        self.clock.on_sleep = each
        self.path = folder / "flight.log"
        self.log = FlightLog(self.path, header={"hz": 30}, max_bytes=1_000_000, keep=1, clock=self.clock)
        self.feed = f.Feed(self.place, self.log, "policy.pt", clock=self.clock, sleep=self.clock.sleep)

    def drive(self, ticks=TICKS):
        with self.log:
            show = partial(self.feed.tick, self.report, self.eyes, self.pilot)
            until = Until(ticks=ticks, over=self.feed.over)
            drive(self.pilot, self.link, self.log, rate_hz=30, until=until, hooks=Hooks(show=show), report=self.report,
                  clock=self.clock, sleep=self.clock.sleep)  # fmt: skip
            self.feed.ended(self.report, self.eyes, self.link)
            self.feed.close()
        return self.link.said

    def events(self):
        return [e.text for e in self.log.recent]


@pytest.fixture
def alone(tmp_path):
    """What the link hears, and when, in a drive that nobody watches."""
    folder = tmp_path / "alone"
    folder.mkdir()
    return Bench(folder).drive()


@pytest.fixture
def listener(tmp_path):
    listener = Listener(tmp_path / "view")
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
        assert logged["t_s"][row] == pytest.approx(message["tick"]["t_s"], abs=1e-3)
        for name in ("steering", "throttle", "steering_us", "throttle_us", "pins_throttle_us", "plan", "frame"):
            assert message["tick"][name] == logged[name][row]
        assert (message["pins"], message["who"], message["why"]) == ([1456, 150], "A", "armed by the host")
        assert (message["frame"], message["captured_s"], message["size"]) == (5, 999.95, [64, 36])
    assert {picture for _, picture in seen} == {JPEG}
    assert driving[-1]["plan"] == {"captured_s": 999.9, "rate_hz": 30.0, "actions": [[0.25, 0.125]] * 32}
    assert driving[-1]["hz"] == pytest.approx(30) and driving[-1]["late_most_ms"] == pytest.approx(0, abs=1e-6)
    last = seen[-1][0]
    assert (last["phase"], last["text"], last["pins"]) == (f.ENDED, f"{TICKS} ticks", [1456, 120])
    assert "armed" in [text for _, text in last["events"]]


def test_a_stop_ends_the_drive_before_its_next_command_and_is_logged(tmp_path, listener):
    seen = []

    def stop():
        seen.extend(listener.messages())
        if len(bench.link.said) >= 30:
            listener.drive.send(b"stop 192.168.1.7")

    bench = Bench(tmp_path, stop)
    said = bench.drive()
    commanded = [throttle for _, throttle in said]
    assert commanded[-1] == "neutral" and len(commanded) <= 32 and set(commanded[:-1]) == {250}
    assert bench.report.ended == "stopped from the view (192.168.1.7)"
    assert "ended: stopped from the view (192.168.1.7)" in [e.text for e in read_log(bench.path).events]
    last = (seen + listener.messages())[-1][0]
    assert (last["phase"], last["pins"]) == (f.ENDED, [1456, 120])  # from this the page knows that the car stands


NOT_A_STOP = [b"stop", b"arm", b"STOP 1.2.3.4", b"stop 1.2.3.4 arm", b"stop 1.2.3.4\n", b"steer 1", b"\0" * 64]
NOT_A_STOP += [b"stop " + b"1" * 60, b"x" * 10_000, b'{"ask": "arm"}', bytes(range(128, 168))]


@pytest.mark.parametrize("message", NOT_A_STOP, ids=[repr(m[:20]) for m in NOT_A_STOP])
def test_nothing_else_does_anything(tmp_path, listener, alone, message):
    def ask():
        if listener.hello():
            with contextlib.suppress(BlockingIOError):
                listener.drive.send(message)

    assert Bench(tmp_path, ask).drive() == alone


def test_a_view_that_reads_nothing_costs_nothing(tmp_path, listener, alone):
    bench = Bench(tmp_path, listener.hello, Eyes(replace(Eyes().frame, jpeg=bytes(60_000))))
    assert bench.drive() == alone
    assert len(listener.messages()) == 1  # no message waits behind another


def test_a_view_that_never_accepts_costs_nothing(tmp_path, listener, alone):
    """A view that SIGSTOP has stopped is like this. Three others have connected earlier, and fill the backlog."""
    others = [socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK) for _ in range(3)]
    for other in others:
        other.connect_ex(str(listener.place))
    bench = Bench(tmp_path)
    assert bench.drive() == alone
    for other in others:
        other.close()


def test_a_flood_moves_no_tick_and_a_stop_in_it_is_heard(tmp_path, listener, alone):
    def flood():
        with contextlib.suppress(BlockingIOError):
            while listener.hello():
                listener.drive.send(b"x" * 1000)

    assert Bench(tmp_path, flood).drive() == alone

    def flood_and_stop():
        if listener.hello() and len(bench.link.said) > 10:
            with contextlib.suppress(BlockingIOError):
                for _ in range(3):
                    listener.drive.send(b"x" * 1000)
                listener.drive.send(b"stop 127.0.0.1")

    listener.open()
    (folder := tmp_path / "again").mkdir()
    bench = Bench(folder, flood_and_stop)
    bench.feed._place = listener.place
    bench.drive()
    assert bench.report.ended.startswith("stopped from the view")


def test_views_that_come_and_go_move_no_tick_and_leave_one_line(tmp_path, listener, alone):
    def come_and_go():
        if listener.hello():
            listener.close()
            listener.open()

    bench = Bench(tmp_path, come_and_go)
    assert bench.drive() == alone
    assert bench.events().count("the view is gone") == 1


@pytest.mark.parametrize("fails", [CameraError("unplugged"), ValueError("anything")])
def test_what_cannot_be_shown_stops_no_drive(tmp_path, listener, alone, fails):
    eyes = Eyes()
    eyes.frame = fails
    bench = Bench(tmp_path, listener.hello, eyes)
    assert bench.drive() == alone
    told = [text for text in bench.events() if "not fed any more" in text]
    assert len(told) == isinstance(fails, ValueError)


def test_a_picture_that_is_no_jpeg_comes_in_points_and_one_too_large_not_at_all(tmp_path, listener):
    image = np.arange(360 * 640 * 3, dtype=np.uint64).astype(np.uint8).reshape(360, 640, 3)
    raw, large = replace(Eyes().frame, image=image, jpeg=None), replace(Eyes().frame, jpeg=bytes(400_000))
    bench = Bench(tmp_path, listener.hello, Eyes(raw))
    bench.drive(ticks=1)
    message, picture = listener.messages()[0]
    assert message["shape"] == [120, 214, 3] and message["size"] == [640, 360]
    assert np.array_equal(np.frombuffer(picture, np.uint8).reshape(120, 214, 3), image[::3, ::3])
    listener.open()
    (folder := tmp_path / "large").mkdir()
    bench = Bench(folder, listener.hello, Eyes(large))
    bench.feed._place = listener.place
    bench.drive(ticks=1)
    message, picture = listener.messages()[0]
    assert picture == b"" and message["tick"]["throttle_us"] == 250


def test_while_it_waits_it_says_what_is_missing(tmp_path, listener):
    bench = Bench(tmp_path)
    bench.link.status = replace(STATUS, state=State.MANUAL, reason="h", missing="t")
    bench.feed.show(f.WAITING, "40 ticks", bench.report, bench.eyes, bench.link)
    bench.feed.show(f.WAITING, "too soon", bench.report, bench.eyes, bench.link)
    (message, picture), *more = listener.messages()
    assert (message["phase"], message["text"], picture, more) == (f.WAITING, "40 ticks", JPEG, [])
    assert (message["missing"], message["who"]) == ("let go of the throttle stick", "M")


def test_while_a_human_is_recorded_it_asks_for_nothing(tmp_path, listener):
    bench = Bench(tmp_path)
    bench.link.status = replace(STATUS, state=State.MANUAL, reason="h", missing="w")
    bench.feed.show(f.TAKEN, "recorded", bench.report, bench.eyes, bench.link)
    bench.feed.show(f.TAKEN, "too soon", bench.report, bench.eyes, bench.link)
    (message, picture), *more = listener.messages()
    assert (message["phase"], message["text"], picture, more) == (f.TAKEN, "recorded", JPEG, [])
    assert (message["missing"], message["who"], message["why"]) == ("", "M", "the human moved a stick")
    listener.drive.send(b"stop 127.0.0.1")
    assert bench.feed.over().startswith("stopped from the view")


def test_the_last_message_waits_for_a_busy_view_only_shortly(tmp_path, listener):
    bench = Bench(tmp_path, listener.hello, Eyes(replace(Eyes().frame, jpeg=bytes(60_000))))
    bench.drive()
    ended_s = bench.link.said[-1][0]
    assert f.LAST_S <= bench.clock() - ended_s < 2 * f.LAST_S

"""The recorder beside a loop, and the loop for a human: what is recorded, and what is left when something fails."""

import os
import signal
import threading
import time
from contextlib import nullcontext
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from rover_lib.onboard.car.camera import CameraError, Frame
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.servo_link import LinkError, State, Telemetry
from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.recording import recorder as module
from rover_lib.onboard.recording.episode import About, EpisodeWriter
from rover_lib.onboard.recording.recorder import Recorder, record
from rover_lib.workshop.recordings.episodes import load_recordings
from tests.helpers.command import rover
from tests.helpers.needs import until
from tests.helpers.recorded import content_of, names_in

PICTURE = np.full((36, 64, 3), (30, 90, 200), np.uint8)


class Stepped(threading.Event):
    """Virtual time, a camera, and the event that a loop waits for: waiting moves time on, and a picture is seen."""

    source, wanted_hz = "fake camera", 100.0

    def __init__(self):
        super().__init__()
        self.now_s, self._changed = 50.0, threading.Condition()
        self._frame = self._failure = None
        self._seen = 0  # number of the last picture that the recorder has taken

    def clock(self):
        return self.now_s

    def wait(self, timeout, image=PICTURE):
        self.now_s += timeout
        with self._changed:
            number = self._frame.number + 1 if self._frame else 1
            self._frame = Frame(image, self.now_s, number, 0, 100.0, 40.0)
            self._changed.notify_all()
        until(lambda: self._seen >= number or self._failure or not self.recorder._thread.is_alive())

    def fail(self):
        with self._changed:
            self._failure = CameraError("fake camera: it ended; is the camera unplugged?")
            self._changed.notify_all()

    def latest(self):
        return self._frame

    def take(self, after, timeout_s):
        """The camera's wait()."""
        with self._changed:
            self._seen = after
            self._changed.wait_for(lambda: self._failure or (self._frame and self._frame.number > after), timeout_s)
            if self._failure:
                raise self._failure
            return self._frame if self._frame and self._frame.number > after else None

    def beside(self, folder, about=None, **options):
        camera = SimpleNamespace(source=self.source, wanted_hz=self.wanted_hz, latest=self.latest, wait=self.take)
        self.recorder = Recorder(folder, camera, about or About(), clock=self.clock, **options)
        return self.recorder

    def drive(self, ticks, image=PICTURE, **extra):
        for i in range(ticks):
            self.recorder.control(self.now_s, 20 * i, 1500, 136, 21316, 1016, **extra)
            self.wait(0.03, image)


@pytest.fixture
def virtual():
    return Stepped()


def test_an_episode_beside_a_loop(tmp_path, virtual):
    before_s = time.time()
    about = About("driven", arduino_port="/dev/x", source="rover drive")
    recorder = virtual.beside(tmp_path / "new", about, rate_hz=50)
    virtual.drive(2, mode="static", plan_age_ms=None)
    virtual.drive(3, mode="static", plan_age_ms=80.5)
    folder = recorder.close()
    assert folder == recorder.folder == recorder.path == recorder.close() and recorder.failure is None
    assert names_in(tmp_path / "new") == [folder.name]
    assert abs(time.mktime(time.strptime(folder.name, "episode_%Y%m%d_%H%M%S")) - before_s) <= 2
    content = content_of(folder)
    expected = {"camera_fps": 50, "camera_resolution": [64, 36], "arduino_port": "/dev/x", "source": "rover drive"}
    expected |= {"total_control_samples": 5, "total_frames": 5}
    assert content["action_label"] == "driven" and expected.items() <= content["metadata"].items()
    assert "fault" not in content["metadata"]
    assert [c["plan_age_ms"] for c in content["control_samples"]] == [None, None, 80.5, 80.5, 80.5]
    times = [c["system_timestamp"] for c in content["control_samples"]]
    times += [f["timestamp"] for f in content["frame_samples"]]
    assert before_s <= min(times) <= max(times) <= time.time() + 0.125
    assert len(load_recordings(folder, chunk=2).samples) == 5


def test_a_faster_camera_is_thinned_and_earlier_pictures_are_left_out(tmp_path, virtual):
    virtual._frame = Frame(PICTURE, virtual.now_s, 1, 0, 100.0, 40.0)
    with virtual.beside(tmp_path, rate_hz=20) as recorder:
        recorder.control(virtual.now_s, 0, 1500, 136, 21316, 1016)
        for _ in range(60):
            virtual.wait(0.01)
    times = [f["timestamp"] for f in content_of(recorder.path)["frame_samples"]]
    assert len(times) == 15 and np.diff(times) == pytest.approx(0.04, abs=1e-3)


def test_two_in_one_second(tmp_path, virtual, monkeypatch):
    monkeypatch.setattr(time, "time", lambda: 1_760_000_000.0)
    paths = set()
    for _ in range(2):
        with virtual.beside(tmp_path) as first:
            virtual.drive(1)
            with virtual.beside(tmp_path) as second:  # while the first is recording
                virtual.drive(1)
        paths |= {first.path.name, second.path.name}
    assert sorted(paths) == names_in(tmp_path) and len(paths) == 4


def test_a_fault_of_camera_or_loop_keeps_what_there_is(tmp_path, virtual, caplog):
    with pytest.raises(ZeroDivisionError), virtual.beside(tmp_path) as recorder:
        virtual.drive(1)
        raise ZeroDivisionError("in the loop")
    assert content_of(recorder.path)["metadata"]["fault"] == "ZeroDivisionError: in the loop"
    caplog.clear()
    recorder = virtual.beside(tmp_path)
    virtual.drive(2)
    virtual.fail()
    until(lambda: recorder.failure)
    virtual.drive(2)  # the loop goes on
    assert content_of(recorder.close())["metadata"]["fault"] == recorder.failure and "unplugged" in recorder.failure
    assert [r.message for r in caplog.records] == [f"recording ended: {recorder.failure}"]  # once


def test_a_car_that_was_not_armed_leaves_no_episode(tmp_path, virtual, caplog):
    with pytest.raises(LinkError), virtual.beside(tmp_path) as recorder:
        virtual.wait(0.1)
        raise LinkError("arming was refused")
    assert names_in(tmp_path) == [] and (recorder.path, recorder.failure) == (None, None) and not caplog.records


def test_a_full_disk_is_seen_before_it_is_full(tmp_path, virtual, monkeypatch):
    def free(size):
        monkeypatch.setattr(os, "statvfs", lambda path: SimpleNamespace(f_bavail=size, f_frsize=1))

    free(1_000_000)
    with pytest.raises(EpisodeError, match=r"full.*1\.0 MB free"):
        virtual.beside(tmp_path)
    assert names_in(tmp_path) == []
    free(1e9)
    recorder = virtual.beside(tmp_path)
    virtual.drive(1)
    until(lambda: recorder.frames)
    free(1_000_000)
    virtual.wait(0.1)
    until(lambda: recorder.failure)
    assert len(load_recordings(recorder.close(), chunk=2).samples) == 1 and "almost full" in recorder.failure
    free(30_000_000)
    assert module.room_for(tmp_path, 2000.0) == 15_000_000  # room to be packed is left


def test_episodes_take_no_more_than_they_may(tmp_path, virtual):
    picture = np.random.default_rng(0).integers(0, 256, (360, 640, 3), np.uint8)  # 500 kB as JPEG
    (tmp_path / "before").mkdir()
    (tmp_path / "before" / "frame_000001.jpg").write_bytes(bytes(2_000_000))
    room = module.room_for(tmp_path, 6.0)
    assert 3_900_000 < room <= 4_000_000
    recorder = virtual.beside(tmp_path, most_bytes=room)
    virtual.drive(20, picture)
    until(lambda: recorder.failure)
    folder = recorder.close()
    taken = sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())
    assert 1_500_000 < taken < 4_000_000 and recorder.frames < 20
    assert content_of(folder)["metadata"]["fault"] == recorder.failure
    with pytest.raises(EpisodeError, match="or delete some"):
        virtual.beside(tmp_path, most_bytes=module.room_for(tmp_path, 6.0))
    assert names_in(tmp_path) == ["before", folder.name]


def test_a_disk_that_hangs_holds_up_nothing(tmp_path, virtual, monkeypatch):
    hanging = threading.Event()
    monkeypatch.setattr(EpisodeWriter, "frame", lambda *_: hanging.wait(20))
    monkeypatch.setattr(module, "QUEUE_MOST", 50)
    monkeypatch.setattr(module, "CLOSE_S", 0.1)
    recorder = virtual.beside(tmp_path)
    virtual._seen = 99
    virtual.drive(1)
    time.sleep(0.05)
    start = time.monotonic()
    for i in range(1000):
        recorder.control(virtual.now_s, i, 1500, 136, 21316, 1016)
    assert recorder.close() is None and time.monotonic() - start < 2
    assert "has not taken" in recorder.failure and len(recorder._queue) <= 50
    hanging.set()
    recorder._thread.join(5)


class FakeLink:
    """An Arduino with a status every 20 ms of the clock, of which every fourth lacks the throttle's pulse."""

    port, car = "fake port", Car()

    def __init__(self, clock):
        self.start, self._clock = clock(), clock
        self.dies_s = self.silent_s = 1e9

    def latest(self):
        now = self._clock() - self.start
        if now > self.dies_s:
            raise LinkError("fake port: reading failed; is it still plugged in?")
        n = int(min(now, self.silent_s) / 0.02)
        throttle = (None, None) if n % 4 == 3 else (120 + n % 5 * 4, 1016)
        receiver = 1456 + n % 50 * 4, 21316, *throttle
        host_s = self.start + 0.02 * n
        return Telemetry(host_s, 7, 20 * n, 0, "-", State.MANUAL, "r", "-", 1456, 120, 238, *receiver, 0, 0, 0, 0)


def record_a_human(folder, virtual, monkeypatch, **link):
    """Record in virtual time. link: when the Arduino dies_s, or becomes silent_s."""
    virtual_recorder = lambda folder, camera, *args, clock, **options: virtual.beside(folder, *args, **options)  # noqa: E731
    monkeypatch.setattr(module, "Recorder", virtual_recorder)
    arduino = FakeLink(virtual.clock)
    vars(arduino).update(link)
    return record(virtual, arduino, folder, rate_hz=100, max_seconds=3, label="left", stop=virtual, clock=virtual.clock)


def test_a_human_is_recorded(tmp_path, virtual, monkeypatch):
    report = record_a_human(tmp_path, virtual, monkeypatch)
    assert report.fault is None and report.seconds == pytest.approx(3, abs=0.02)
    controls = content_of(report.folder)["control_samples"]
    assert len(controls) == report.controls and 148 <= len(controls) <= 151  # each status once, at twice the rate
    stamps = [c["arduino_timestamp"] for c in controls]
    assert stamps == sorted(set(stamps))
    assert min(b["system_timestamp"] - a["system_timestamp"] for a, b in pairwise(controls)) > 0.0185  # no burst
    assert all(c["throttle_measured"] is not (c["arduino_timestamp"] // 20 % 4 == 3) for c in controls)
    assert report.not_measured == (0, sum(not c["throttle_measured"] for c in controls))
    assert "throttle was not measured" in str(report)
    assert {f.kind for f in load_recordings(report.folder, chunk=4).faults} == {"throttle_no_pulse"}


@pytest.mark.parametrize(("how", "says"), [("dies_s", "plugged in"), ("silent_s", "no status")])
def test_an_unplugged_arduino_keeps_what_there_is(tmp_path, virtual, monkeypatch, how, says):
    report = record_a_human(tmp_path, virtual, monkeypatch, **{how: 0.5})
    assert says in report.fault and report.controls > 20 and report.seconds < 3
    assert content_of(report.folder)["metadata"]["fault"] == report.fault


@pytest.mark.parametrize(
    ("number", "when", "episodes"),
    [
        (signal.SIGINT, "recording", 3),
        (signal.SIGTERM, "recording", 1),
        (signal.SIGINT, "pause", 1),
        (None, "fault", 1),
    ],
)
def test_signals_and_faults_end_an_episode_or_all(tmp_path, monkeypatch, number, when, episodes):
    begun = []

    def record_one(*_, stop, **options):
        begun.append(options)
        if when == "recording" and len(begun) == 1:
            signal.raise_signal(number)
            assert stop.is_set()
        return module.RecordReport(tmp_path, 3, 3, 0.1, (0, 0), "unplugged" if when == "fault" else None)

    def pause(stop, _):
        if when == "pause":
            signal.raise_signal(number)
        return stop.is_set()

    monkeypatch.setattr(module, "record", record_one)
    monkeypatch.setattr(module.SignalEvent, "wait", pause)
    for device in ("Camera", "ServoLink"):
        monkeypatch.setattr(module, device, lambda *_, **options: nullcontext())
    done = rover("record", "--episodes", "3", "--label", "to the left", tmp_path)
    assert done.exit_code == (when == "fault") and done.stdout.count("recorded: ") == len(begun) == episodes
    assert begun[0]["label"] == "to the left"

"""The recorder beside a loop, and the loop for a human: what is recorded, and what is left when something fails."""

import csv
import json
import os
import pty
import signal
import subprocess
import sys
import threading
import time
import tty
from collections import namedtuple
from contextlib import contextmanager
from itertools import pairwise
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from needs import until

from rover_lib.onboard.car.camera import Camera, CameraError, Frame
from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.servo_link import LinkError, ServoLink, State, Telemetry, frame
from rover_lib.onboard.errors import EpisodeError
from rover_lib.onboard.recording import recorder as module
from rover_lib.onboard.recording.episode import About, EpisodeWriter
from rover_lib.onboard.recording.recorder import Recorder, record
from rover_lib.workshop.recordings.episodes import load_recordings

PICTURE = np.full((36, 64, 3), (30, 90, 200), np.uint8)


class FakeCamera:
    """Frames when they are pushed; or, while it is filming, 100 a second."""

    source = "fake camera"
    wanted_hz = 100.0

    def __init__(self, clock=time.monotonic):
        self._clock = clock
        self._changed = threading.Condition()
        self._frame = self._failure = None
        self._taken = 0  # number of the last frame that somebody has seen

    def push(self, image=PICTURE):
        with self._changed:
            number = self._frame.number + 1 if self._frame else 1
            self._frame = Frame(image, self._clock(), number, 0, 100.0, 40.0)
            self._changed.notify_all()
        return number

    def fail(self):
        with self._changed:
            self._failure = CameraError("fake camera: it ended; is the camera unplugged?")
            self._changed.notify_all()

    def latest(self):
        with self._changed:
            if self._failure:
                raise self._failure
            return self._frame

    def wait(self, after, timeout_s):
        with self._changed:
            self._taken = after
            self._changed.wait_for(lambda: self._failure or (self._frame and self._frame.number > after), timeout_s)
            if self._failure:
                raise self._failure
            return self._frame if self._frame and self._frame.number > after else None

    @contextmanager
    def filming(self):
        done = threading.Event()

        def run():
            while not done.wait(0.01):
                self.push()

        thread = threading.Thread(target=run)
        thread.start()
        try:
            yield self
        finally:
            done.set()
            thread.join()


class Stepped(threading.Event):
    """Virtual time, and the event that a loop waits for: waiting moves time on, and a picture is taken and seen."""

    def __init__(self):
        super().__init__()
        self.now_s = 50.0
        self.camera = FakeCamera(lambda: self.now_s)

    def wait(self, timeout):
        self.now_s += timeout
        number = self.camera.push()
        until(lambda: self.camera._taken >= number)


class FakeLink:
    """An Arduino with a status every 20 ms of the clock; every fourth throttle pulse is lost."""

    port = "fake port"
    car = Car()

    def __init__(self, clock=time.monotonic):
        self.start, self._clock = clock(), clock
        self.dies_s = self.silent_s = 1e9

    def latest(self):
        now = self._clock() - self.start
        if now > self.dies_s:
            raise LinkError("fake port: reading failed; is it still plugged in?")
        n = int(min(now, self.silent_s) / 0.02)
        return status_of(n, self.start + 0.02 * n)


def status_of(n, host_s=0.0):
    throttle = (None, None) if n % 4 == 3 else (120 + n % 5 * 4, 1016)
    steering = 1456 + n % 50 * 4, 21316
    return Telemetry(
        host_s, 7, 20 * n, 0, "-", State.MANUAL, "r", "-", 1456, 120, 238, *steering, *throttle, 0, 0, 0, 0
    )


def content_of(folder):
    return json.loads((folder / "episode_data.json").read_text())


def left_in(folder):
    return sorted(p.name for p in folder.iterdir())


# ---- beside a loop ---------------------------------------------------------------------------------------


def test_an_episode_beside_a_loop(tmp_path):
    virtual = Stepped()
    virtual.camera.push()
    before_s = time.time()
    about = About("driven", arduino_port="/dev/x", source="rover drive")
    recorder = Recorder(tmp_path / "new", virtual.camera, about, rate_hz=50, clock=lambda: virtual.now_s)
    for i in range(5):
        virtual.wait(0.025)
        age_ms = None if i < 2 else 80.5
        recorder.control(virtual.now_s, 20 * i, 1500, 136, 21316, 1016, mode="static", plan_age_ms=age_ms)
    folder = recorder.close()
    assert folder == recorder.folder == recorder.path
    assert recorder.failure is None
    assert recorder.close() == folder
    assert left_in(tmp_path / "new") == [folder.name]
    assert abs(time.mktime(time.strptime(folder.name, "episode_%Y%m%d_%H%M%S")) - before_s) <= 2
    content = content_of(folder)
    assert content["action_label"] == "driven"
    assert (
        content["metadata"]
        | {
            "camera_fps": 50,
            "camera_resolution": [64, 36],
            "arduino_port": "/dev/x",
            "total_control_samples": 5,
            "total_frames": 5,  # not the one from before the start
            "source": "rover drive",
        }
        == content["metadata"]
    )
    assert "fault" not in content["metadata"]
    assert [c["plan_age_ms"] for c in content["control_samples"]] == [None, None, 80.5, 80.5, 80.5]
    assert {c["mode"] for c in content["control_samples"]} == {"static"}
    assert all(c["throttle_measured"] is True for c in content["control_samples"])
    times = [c["system_timestamp"] for c in content["control_samples"]]
    times += [f["timestamp"] for f in content["frame_samples"]]
    assert before_s <= min(times) <= max(times) <= time.time() + 0.125
    with (folder / "control_data.csv").open(newline="") as f:
        rows = list(csv.DictReader(f))
    assert [r["plan_age_ms"] for r in rows] == ["", "", "80.5", "80.5", "80.5"]
    assert len(load_recordings(folder, chunk=2).samples) == 5


def test_a_faster_camera_is_thinned(tmp_path):
    virtual = Stepped()
    with Recorder(tmp_path, virtual.camera, About(), rate_hz=20, clock=lambda: virtual.now_s) as recorder:
        recorder.control(virtual.now_s, 0, 1500, 136, 21316, 1016)
        for _ in range(60):
            virtual.wait(0.01)
    times = [f["timestamp"] for f in content_of(recorder.path)["frame_samples"]]
    assert len(times) == 15 and np.diff(times) == pytest.approx(0.04, abs=1e-3)


def test_two_in_one_second(tmp_path, monkeypatch):
    monkeypatch.setattr(time, "time", lambda: 1_760_000_000.0)
    camera = FakeCamera()
    with (
        Recorder(tmp_path, camera, About()) as a,
        Recorder(tmp_path, camera, About()) as b,
    ):  # the second while the first is recording
        for r in (a, b):
            r.control(time.monotonic(), 0, 1500, 136, 21316, 1016)
        camera.push()
        until(lambda: a.frames and b.frames)
    with Recorder(tmp_path, camera, About()) as c:  # and after both are done
        c.control(time.monotonic(), 0, 1500, 136, 21316, 1016)
        camera.push()
        until(lambda: c.frames)
    assert sorted([a.path.name, b.path.name, c.path.name]) == left_in(tmp_path)
    assert len(left_in(tmp_path)) == 3


@pytest.mark.parametrize("recorded", [True, False])
def test_an_unplugged_camera_keeps_what_there_is(tmp_path, recorded, caplog):
    camera = FakeCamera()
    recorder = Recorder(tmp_path, camera, About())
    if recorded:
        recorder.control(time.monotonic(), 0, 1500, 136, 21316, 1016)
        camera.push()
        until(lambda: recorder.frames)
    camera.fail()
    until(lambda: recorder.failure)
    recorder.control(time.monotonic(), 20, 1500, 136, 21316, 1016)  # the loop goes on
    folder = recorder.close()
    assert "unplugged" in recorder.failure
    assert [r.message for r in caplog.records] == [f"recording ended: {recorder.failure}"]  # once
    if recorded:
        assert content_of(folder)["metadata"]["fault"] == recorder.failure
        assert left_in(tmp_path) == [folder.name]
    else:
        assert folder is None
        assert left_in(tmp_path) == []


def test_an_exception_of_the_loop_keeps_what_there_is(tmp_path):
    camera = FakeCamera()
    with pytest.raises(ZeroDivisionError), Recorder(tmp_path, camera, About()) as recorder:
        recorder.control(time.monotonic(), 0, 1500, 136, 21316, 1016)
        camera.push()
        until(lambda: recorder.frames)
        raise ZeroDivisionError("in the loop")
    assert content_of(recorder.path)["metadata"]["fault"] == "ZeroDivisionError: in the loop"


def disk_with(free):
    return lambda path: SimpleNamespace(f_bavail=free, f_frsize=1)


def test_a_full_disk_is_seen_before_it_is_full(tmp_path, monkeypatch):
    camera = FakeCamera()
    monkeypatch.setattr(os, "statvfs", disk_with(1_000_000))
    with pytest.raises(EpisodeError, match=r"full.*1\.0 MB free"):
        Recorder(tmp_path, camera, About())
    assert left_in(tmp_path) == []
    monkeypatch.setattr(os, "statvfs", disk_with(1e9))
    recorder = Recorder(tmp_path, camera, About())
    recorder.control(time.monotonic(), 0, 1500, 136, 21316, 1016)
    camera.push()
    until(lambda: recorder.frames)
    monkeypatch.setattr(os, "statvfs", disk_with(1_000_000))
    camera.push()
    time.sleep(0.05)
    camera.push()
    until(lambda: recorder.failure)
    folder = recorder.close()
    assert "as good as full" in recorder.failure
    assert len(load_recordings(folder, chunk=2).samples) == 1


def test_episodes_take_no_more_than_they_may(tmp_path, monkeypatch):
    picture = np.random.default_rng(0).integers(0, 256, (360, 640, 3), np.uint8)  # 500 kB as JPEG
    camera = FakeCamera()
    (tmp_path / "episode_before" / "frames").mkdir(parents=True)
    (tmp_path / "episode_before" / "frames" / "frame_000001.jpg").write_bytes(bytes(2_000_000))
    room = module.room_for(tmp_path, 6.0)
    assert 3_900_000 < room <= 4_000_000
    with monkeypatch.context() as m:
        m.setattr(os, "statvfs", disk_with(30_000_000))
        assert module.room_for(tmp_path, 2000.0) == 15_000_000  # room to be packed is left
    recorder = Recorder(tmp_path, camera, About(), most_bytes=room)
    recorder.control(time.monotonic(), 0, 1500, 136, 21316, 1016)
    for _ in range(20):
        camera.push(picture)
        time.sleep(0.03)
    until(lambda: recorder.failure)
    folder = recorder.close()
    assert "no room is left of what episodes may take here; fetch them" in recorder.failure
    taken = sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())
    assert 1_500_000 < taken < 4_000_000 and recorder.frames < 20
    assert content_of(folder)["metadata"]["fault"] == recorder.failure
    with pytest.raises(EpisodeError, match="or delete some"):
        Recorder(tmp_path, camera, About(), most_bytes=module.room_for(tmp_path, 6.0))
    assert left_in(tmp_path) == [folder.name, "episode_before"]


def test_a_car_that_was_not_armed_leaves_no_episode(tmp_path, caplog):
    camera = FakeCamera()
    with camera.filming(), pytest.raises(LinkError), Recorder(tmp_path, camera, About()) as recorder:
        until(lambda: recorder.frames)
        raise LinkError("arming was refused")
    assert left_in(tmp_path) == [] and (recorder.path, recorder.failure) == (None, None) and not caplog.records


def test_a_disk_that_takes_nothing_leaves_nothing(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    camera = FakeCamera()
    recorder = Recorder(tmp_path, camera, About())
    recorder.control(time.monotonic(), 0, 1500, 136, 21316, 1016)
    camera.push()
    until(lambda: recorder.frames)
    monkeypatch.setattr(EpisodeWriter, "_write", full)
    for i in range(1000):
        recorder.control(time.monotonic(), i, 1500, 136, 21316, 1016)
    assert recorder.close() is None
    assert "No space left on device" in recorder.failure
    assert "\n" not in recorder.failure
    assert left_in(tmp_path) == []


def test_a_disk_that_hangs_holds_up_nothing(tmp_path, monkeypatch):
    hanging = threading.Event()
    monkeypatch.setattr(EpisodeWriter, "frame", lambda *_: hanging.wait(20))
    monkeypatch.setattr(module, "QUEUE_MOST", 50)
    monkeypatch.setattr(module, "CLOSE_S", 0.1)
    camera = FakeCamera()
    recorder = Recorder(tmp_path, camera, About())
    camera.push()
    time.sleep(0.05)
    start = time.monotonic()
    for i in range(1000):
        recorder.control(time.monotonic(), i, 1500, 136, 21316, 1016)
    assert recorder.close() is None
    assert time.monotonic() - start < 2
    assert "has not taken" in recorder.failure
    assert len(recorder._queue) <= 50
    hanging.set()
    recorder._thread.join(5)


# ---- a human drives --------------------------------------------------------------------------------------


def test_a_human_is_recorded(tmp_path):
    virtual = Stepped()
    link = FakeLink(lambda: virtual.now_s)
    options = {"rate_hz": 100, "max_seconds": 0.8, "label": "left", "stop": virtual, "clock": lambda: virtual.now_s}
    report = record(virtual.camera, link, tmp_path, **options)
    assert report.fault is None
    assert report.seconds == pytest.approx(0.8, abs=0.02)
    content = content_of(report.folder)
    controls = content["control_samples"]
    assert len(controls) == report.controls
    assert 38 <= len(controls) <= 41  # each status once, though the loop ran twice as often
    stamps = [c["arduino_timestamp"] for c in controls]
    assert stamps == sorted(set(stamps))
    steps = {round(1000 * (b["system_timestamp"] - a["system_timestamp"])) for a, b in pairwise(controls)}
    assert min(steps) >= 19  # and no burst
    assert all(c["throttle_measured"] is not (c["arduino_timestamp"] // 20 % 4 == 3) for c in controls)
    assert report.not_measured == (0, sum(not c["throttle_measured"] for c in controls))
    assert "throttle was not measured" in str(report)
    recordings = load_recordings(report.folder, chunk=4)
    assert {f.kind for f in recordings.faults} == {"throttle_no_pulse"}
    assert min(s.chunk[:, 0].min() for s in recordings.samples) > 0


@pytest.mark.slow
@pytest.mark.parametrize(("how", "says"), [("dies_s", ("plugged in",)), ("silent_s", ("no status",))])
def test_an_unplugged_arduino_keeps_what_there_is(tmp_path, monkeypatch, how, says):
    monkeypatch.setattr(module, "SILENT_S", 0.3)
    link = FakeLink()
    setattr(link, how, 1.0)
    with FakeCamera().filming() as camera:
        report = record(camera, link, tmp_path, max_seconds=5)
    assert report.seconds < 3
    assert report.controls > 3
    metadata = content_of(report.folder)["metadata"]
    assert metadata["fault"] == report.fault
    assert any(word in report.fault for word in says)


Arduino = namedtuple("Arduino", "port unplug")


@pytest.fixture
def arduino():
    """A pty that talks as the firmware does, every 20 ms, and had been talking for a second before anyone listened."""
    master, slave = pty.openpty()
    tty.setraw(slave)
    done = threading.Event()

    def status(n):
        throttle = "- -" if n % 10 == 9 else f"{120 + n % 5 * 4} 1016"
        return frame(f"<S 7 {20 * n} 0 - M r - 1456 120 238 {1456 + n % 50 * 4} 21316 {throttle} 0 0 0 0")

    def run():
        os.write(master, b"".join(status(n) for n in range(40)))  # what waits in the buffer
        n, said = 40, False
        while not done.wait(0.02):
            if n % 25 == 0 or not said:
                os.write(master, frame(f"<H 4 4.1.1 7 0 e {Car().id}"))
                said = True
            os.write(master, status(n))
            n += 1
        os.close(master)

    thread = threading.Thread(target=run)
    thread.start()
    yield Arduino(os.ttyname(slave), done.set)
    done.set()
    thread.join()
    os.close(slave)


@pytest.fixture
def pictures(tmp_path):
    folder = tmp_path / "pictures"
    folder.mkdir()
    ok, jpeg = cv2.imencode(".jpg", PICTURE)
    assert ok
    for i in range(300):
        (folder / f"{i:04d}.jpg").write_bytes(jpeg)
    return folder


@pytest.mark.slow
def test_a_real_link_has_no_burst(tmp_path, arduino, pictures):
    with Camera(pictures) as camera, ServoLink(arduino.port) as link:
        report = record(camera, link, tmp_path / "out", max_seconds=0.7)
    assert report.fault is None
    recordings = load_recordings(report.folder, chunk=4)
    found = {f.kind for f in recordings.faults}
    assert "throttle_no_pulse" in found
    assert not any("burst" in kind for kind in found)
    assert len(recordings.samples) > 5


def rover_record(out, arduino, pictures, *options):
    command = [sys.executable, "-m", "rover_lib.cli", "record", "--camera", str(pictures), "--port", arduino.port]
    return subprocess.Popen(
        [*command, *options, str(out)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def recording_in(out):
    """A second of an episode is on the disk."""
    return len(list(out.glob(".episode_*/frames/*.jpg"))) > 10


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_an_episode_properly(tmp_path, arduino, pictures, number):
    out = tmp_path / "out"
    more = () if number == signal.SIGINT else ("--episodes", "2")  # they end all, and not one after the other
    run = rover_record(out, arduino, pictures, "--label", "to the left", *more)
    until(lambda: recording_in(out), 20)
    run.send_signal(number)
    said, errors = run.communicate(timeout=20)
    assert run.returncode == 0, errors
    (folder,) = out.iterdir()
    assert str(folder) in said
    assert content_of(folder)["action_label"] == "to the left"
    assert len(load_recordings(out, chunk=4).samples) > 5


@pytest.mark.slow
def test_several_episodes(tmp_path, arduino, pictures):
    out = tmp_path / "out"
    run = rover_record(out, arduino, pictures, "--episodes", "3", "--max-seconds", "0.5")
    until(lambda: len(list(out.glob("episode_*"))) == 1, 20)
    time.sleep(0.3)  # in the pause
    run.send_signal(signal.SIGINT)
    said, errors = run.communicate(timeout=20)
    assert run.returncode == 0
    assert "episode 2 of 3" in errors
    assert said.count("recorded: ") == 1
    assert len(list(out.iterdir())) == 1

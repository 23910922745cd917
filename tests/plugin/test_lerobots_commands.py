"""LeRobot's own commands, as processes, with the rover: on the emulated Arduino, and in the balloon world."""

import contextlib
import functools
import importlib
import inspect
import os
import pty
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import threading
import time
import typing
import zipfile
from pathlib import Path
from types import SimpleNamespace

import needs
import numpy as np
import pandas as pd
import pytest
from test_lerobots_way import TINY, lerobot_train, rover

from balloon_world.car import CameraFeed, VirtualCar
from balloon_world.simulated_arduino import REST_US
from lab.arduino.emulator import NICE, EmulatedArduino
from lab.driving.pins import CONTINUES, HUMAN, STOPPED, Command, Gates, Observation, judge
from lab.driving.policy import PLAIN, make_artifact, pictures
from lerobot_robot_rover.line import ENDING, FEATURES
from rover_lib.onboard.car.pwm import ARDUINO_STEP_US, PwmCalibration
from rover_lib.onboard.drive.flight_log import read_log

ROOT = Path(__file__).parents[2]
BIN = Path(sys.executable).parent
GATES = Gates.of_params()
START_S = 150.0  # LeRobot imports for 5 s, or 20 on a busy machine
HELD_S = 0.4
STICKS = ((1600.0, 150.0), (1300.0, 173.0), (1480.0, 140.0), (1750.0, 160.0))  # within what the host may ask for, too
with_firmware = [pytest.mark.emulated, pytest.mark.slow, needs.simavr]


@pytest.fixture(scope="session")
def plugin(made_once):
    """A folder with the package as pip would install it: LeRobot looks for the distribution."""

    def make(folder):
        build = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", folder / "wheel"]
        subprocess.run(build, cwd=ROOT / "lerobot_robot_rover", check=True, capture_output=True)
        (wheel,) = (folder / "wheel").glob("*.whl")
        with zipfile.ZipFile(wheel) as z:
            z.extractall(folder)

    return made_once("plugin", make)


class LeRobot:
    """One of LeRobot's commands, in a process of its own, and what it says."""

    def __init__(self, name, plugin, folder, stdin=subprocess.DEVNULL, **options):
        words = [f"--{key.replace('__', '.')}={value}" for key, value in options.items()]
        offline = {"HF_HUB_OFFLINE": "1", "HF_DATASETS_CACHE": str(folder / "cache"), "HF_LEROBOT_HOME": str(folder)}
        env = {**os.environ, **offline, "OMP_NUM_THREADS": "1", "PYTHONPATH": f"{plugin}{os.pathsep}{ROOT}"}
        env.pop("DISPLAY", None)
        self.process = subprocess.Popen(
            [BIN / name, *words],
            env=env,
            cwd=folder,
            stdin=stdin,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            # A shell's & would have it ignored.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
        self.text = ""
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGCONT)
            self.process.kill()
        self.process.wait()
        self._reader.join(10)

    def _read(self):
        for line in self.process.stdout:
            self.text += line

    def wait_for(self, words, seconds=START_S):
        end = time.monotonic() + seconds
        while words not in self.text:
            assert self.process.poll() is None and time.monotonic() < end, f"{words!r} not said:\n{self.text[-3000:]}"
            time.sleep(0.005)

    def over(self, end_s):
        """Whether it has ended, which it has to in time. Raises Late where its loop was too slow for the car."""
        if waits_for_a_human(self):
            raise needs.Late(f"LeRobot's loop was late:\n{self.text[-1500:]}")
        assert time.monotonic() < end_s, self.text[-3000:]
        return self.process.poll() is not None

    def ended(self, seconds=60.0):
        """Its exit status."""
        self.process.wait(seconds)
        self._reader.join(10)
        return self.process.returncode

    def children(self):
        stats = [p.read_text().rpartition(")") for p in Path("/proc").glob("[0-9]*/stat") if _readable(p)]
        return [int(head.split()[0]) for head, _, rest in stats if int(rest.split()[1]) == self.process.pid]


def waits_for_a_human(command):
    """To drive again, after it drove."""
    return "before the car can drive" in command.text.partition(" armed\n")[2]


def _readable(path):
    with contextlib.suppress(OSError):
        return bool(path.read_text())
    return False


def robot(port, folder, **more):
    given = {"port": port, "camera": folder / "camera", "film": True, "width": 96, "height": 48} | more
    given |= {"log": folder / "flight.log", "calibration_dir": folder}
    return {"robot__type": "rover"} | {f"robot__{key}": value for key, value in given.items()}


def dataset(folder, name, **more):
    given = {"repo_id": f"local/{name}", "root": folder / name, **more}
    return {f"dataset__{key}": value for key, value in given.items()}


def recording(folder, name, **more):
    codec = "rgb_encoder__vcodec" if ENDING else "vcodec"
    given = {"single_task": "drive", "push_to_hub": False, codec: "h264", "fps": 30} | more
    return dataset(folder, name, **given) | {"play_sounds": False, "display_data": False}


def driving(folder, artifact, seconds):
    """The command by which this LeRobot lets a policy drive for one episode, and its options."""
    policy = {"policy__type": "rover_artifact", "policy__artifact": artifact}
    if not ENDING:
        options = recording(folder, "eval_a", num_episodes=1, episode_time_s=seconds, reset_time_s=0)
        return "lerobot-record", policy | options
    options = recording(folder, "rollout_a", num_episodes=1, episode_time_s=seconds, reset_time_s=0)
    strategy = {"strategy__type": "episodic", "strategy__reset_to_initial_position": False}
    return "lerobot-rollout", policy | options | strategy


def rows(root):
    """A dataset's, in order."""
    files = sorted((root / "data").rglob("*.parquet"))
    return pd.concat([pd.read_parquet(file) for file in files]).sort_values("index")


def without_repeats(pairs):
    pairs = [tuple(pair) for pair in pairs]
    return [pair for i, pair in enumerate(pairs) if i == 0 or pair != pairs[i - 1]]


def pulses_of(actions):
    calibration = PwmCalibration()
    return np.array([[(p := calibration.pulses(*map(float, a))).steering_us, p.throttle_us] for a in actions])


@pytest.mark.slow
def test_lerobots_own_parser_takes_what_the_page_says(monkeypatch):
    """Those of this LeRobot: in 0.6 lerobot-record drives no policy, and in 0.4 there is no lerobot-rollout."""
    import draccus

    # It reads a class's source once more for each of its fields.
    once = SimpleNamespace(getsource=functools.cache(inspect.getsource))
    monkeypatch.setattr("draccus.wrappers.docstring.inspect", once)
    text, parsed = (ROOT / "docs" / "lerobot.md").read_text().replace("\\\n", " "), []
    for line in re.findall(r"^    (lerobot-\w+ .*)$", text, re.M):
        program, *words = shlex.split(line.partition(" # ")[0])
        if not (BIN / program).exists() or (ENDING and program == "lerobot-record" and "policy" in line):
            continue
        module = importlib.import_module(f"lerobot.scripts.{program.replace('-', '_')}")
        config = typing.get_type_hints(getattr(module, program.partition("-")[2]).__wrapped__)["cfg"]
        monkeypatch.setattr(sys, "argv", [program, *words])  # where LeRobot looks for a policy's path
        assert draccus.parse(config, args=words).robot.type == "rover"
        parsed.append(program)
    assert len(parsed) == (5 if ENDING else 3), parsed


@pytest.fixture(scope="module")
def eyes(tmp_path_factory):
    """A folder with a camera in it."""
    folder = tmp_path_factory.mktemp("lerobot")
    with CameraFeed(folder / "camera", *pictures(PLAIN)):
        yield folder


@pytest.fixture(scope="module")
def drives(eyes, plugin):
    """lerobot-record of three episodes: a human drives by the transmitter. Gives the dataset's folder."""
    with EmulatedArduino(every_pulse=False, transmitter=REST_US, nice=NICE) as board:
        given = robot(board.port, eyes) | {"teleop__type": "rover_transmitter", "teleop__port": board.port}
        given |= recording(eyes, "drives", num_episodes=3, episode_time_s=2, reset_time_s=0.5)
        with LeRobot("lerobot-record", plugin, eyes, **given) as record:
            record.wait_for("Recording episode 0")
            turn = 0
            end_s = time.monotonic() + START_S
            while not record.over(end_s):
                board.transmitter(*STICKS[turn % len(STICKS)])
                turn += 1
                time.sleep(HELD_S)
            assert record.ended() == 0, record.text[-3000:]
            assert "headless" in record.text.lower() and "armed" not in record.text
    return eyes / "drives"


class TestHuman:
    pytestmark = with_firmware

    def test_three_episodes_of_a_human(self, drives):
        table = rows(drives)
        assert sorted(set(table["episode_index"])) == [0, 1, 2]
        for _, episode in table.groupby("episode_index"):
            actions = np.stack(episode["action"])
            assert 20 <= len(actions) <= 61
            pulses = pulses_of(actions)
            for channel in (0, 1):
                sticks = np.array([us[channel] for us in STICKS])
                distance = np.abs(pulses[:, channel, None] - sticks)
                settled = distance.min(1) <= ARDUINO_STEP_US
                assert settled.mean() > 0.9  # a status in between two sticks' pulses is between them
                assert (distance.min(0) <= ARDUINO_STEP_US).all()  # each was there
            states = np.stack(episode["observation.state"])
            np.testing.assert_array_equal(states[1:], actions[:-1])

    def test_lerobots_loader_reads_it_and_ours(self, drives, monkeypatch):
        from lerobot.datasets.lerobot_dataset import LeRobotDataset

        from rover_lib.workshop.recordings.episodes import load_recordings

        monkeypatch.setenv("HF_HUB_OFFLINE", "1")
        data = LeRobotDataset("local/drives", root=drives, video_backend="pyav")
        assert (data.num_episodes, data.fps, data.meta.robot_type) == (3, 30, "rover")
        assert data.features["action"]["names"] == data.features["observation.state"]["names"] == list(FEATURES)
        picture = data[5]["observation.images.cam_front"]
        ours = load_recordings(drives, 8)
        assert len(ours.episodes) == 3 and not ours.faults
        assert tuple(picture.shape) == (3, 48, 96) and 0.3 < float(picture.mean()) < 0.6

    @needs.real_time
    def test_an_episode_is_replayed(self, drives, eyes, plugin):
        (eyes / "flight.log").unlink(missing_ok=True)
        with EmulatedArduino(transmitter=REST_US, ready=True, nice=NICE) as board:
            given = robot(board.port, eyes) | dataset(eyes, "drives", episode=1) | {"play_sounds": False}
            with LeRobot("lerobot-replay", plugin, eyes, **given) as replay:
                end_s = time.monotonic() + START_S
                events = watched(board, lambda: replay.over(end_s))
                assert replay.ended() == 0, replay.text[-3000:]
        table = rows(drives)
        actions = np.stack(table[table["episode_index"] == 1]["action"])
        flight = read_log(eyes / "flight.log")
        sent = np.stack([flight.ticks["steering_us"], flight.ticks["throttle_us"]], 1).astype(int)
        assert without_repeats(sent) == without_repeats(pulses_of(actions))
        times = flight.header["start_monotonic_s"] + flight.ticks["t_s"]
        commands = [Command(at_s, *us) for at_s, us in zip(times.tolist(), sent.tolist(), strict=True)]
        seen = Observation(events, commands, times[0] + 0.5, times[-1])
        wrong = judge(CONTINUES, seen, GATES).wrong
        if wrong and seen.stalled_ms():
            raise needs.Late(f"the emulated Arduino had no time for {seen.stalled_ms():.0f} ms: {wrong}")
        assert wrong == []
        for channel, pin in enumerate(("steering", "throttle")):
            errors = list(errors_us(seen, channel, pin))
            assert len(errors) >= 3 and max(errors) <= ARDUINO_STEP_US


def errors_us(seen, channel, pin):
    """How far a pin's pulses were from what was commanded, where that had been one stick for a quarter of a second."""
    for event in seen.pulses(pin):
        recent = [c[1 + channel] for c in seen.commands if event.monotonic_s - 0.25 < c.at_s <= event.monotonic_s]
        if recent and max(recent) - min(recent) <= 2:
            yield min(abs(event.pulse_us - us) for us in recent)


def watched(board, over, every_s=0.2):
    events = []
    while not over():
        events += board.pulses()
        time.sleep(every_s)
    return events + board.pulses()


# ---- a policy drives, and somebody ends it


@pytest.fixture(scope="module")
def artifact(tmp_path_factory):
    path = tmp_path_factory.mktemp("constant") / "policy_fp32.pt"
    make_artifact(path, camera="cam_front")
    return path


def interrupt(process, board):
    process.send_signal(signal.SIGINT)


def kill(process, board):
    process.kill()


def stop(process, board):
    process.send_signal(signal.SIGSTOP)


def take_over(process, board):
    board.ready(False)  # he does not wiggle the stick again
    board.transmitter(1700, REST_US[1])


@pytest.mark.emulated
@(pytest.mark.slow if ENDING else pytest.mark.release)  # .ci/run sees it with the newest LeRobot
@needs.simavr
@needs.real_time
def test_from_recordings_to_pins(eyes, plugin, tmp_path, monkeypatch):
    """export-dataset, LeRobot's own training, `rover run`, and LeRobot lets what that made drive."""
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_DATASETS_CACHE", str(tmp_path / "cache"))
    rover("world", "record", tmp_path / "mine", "--count", 3)
    rover("export-dataset", tmp_path / "mine", tmp_path / "dataset", "--size", "96x48")
    few = ("--policy.type=act", "--policy.pretrained_backbone_weights=null", "--steps=2", "--save_freq=2")
    last = lerobot_train(
        tmp_path / "dataset", tmp_path / "train", *few, "--batch_size=2", *TINY, cache=tmp_path / "cache"
    )
    small = ("--samples", 6, "--iterations", 2)
    rover("run", last, tmp_path / "dataset", "--name", "a", "--runs-dir", tmp_path, *small)
    (tmp_path / "drive").mkdir()
    command, given = driving(tmp_path / "drive", tmp_path / "a/policy_static.pt", 2)
    with (
        EmulatedArduino(transmitter=REST_US, ready=True, nice=NICE) as board,
        LeRobot(command, plugin, eyes, **robot(board.port, eyes), **given) as drive,
    ):
        end_s = time.monotonic() + START_S
        events = watched(board, lambda: drive.over(end_s))
        assert drive.ended() == 0, drive.text[-3000:]
    moved = {e.pulse_us for e in events if e.pin == "steering"}
    assert len(moved) > 1 and len(rows(tmp_path / "drive" / given["dataset__root"].name)) >= 30


@pytest.mark.emulated
@pytest.mark.slow
@needs.simavr
@pytest.mark.parametrize(
    "happens", [interrupt, *(pytest.param(what, marks=pytest.mark.release) for what in (kill, stop, take_over))]
)
@needs.real_time
def test_however_it_ends_the_car_is_stopped_or_the_humans(happens, eyes, artifact, plugin, tmp_path):
    folder = Path(tempfile.mkdtemp(dir=tmp_path))  # of this attempt
    with EmulatedArduino(transmitter=REST_US, ready=True, nice=NICE) as board:
        command, given = driving(folder, artifact, 60)
        with LeRobot(command, plugin, eyes, **robot(board.port, eyes), **given) as record:
            record.wait_for("Recording episode 0")
            moving_s, events = None, []
            end = time.monotonic() + 20
            while moving_s is None or time.monotonic() < moving_s + 0.8:
                assert not record.over(end), record.text[-3000:]
                events += board.pulses()
                if moving_s is None and any(e.pin == "throttle" and e.pulse_us > 190 for e in events):
                    moving_s = time.monotonic()
                time.sleep(0.02)
            children = record.children()
            at_s = time.monotonic()
            happens(record.process, board)
            end_s = at_s + 1.0
            events += watched(board, lambda: time.monotonic() > end_s)
            seen = Observation(events, [], at_s, end_s)
            expected, human_us = (HUMAN, (1700, REST_US[1])) if happens is take_over else (STOPPED, REST_US)
            verdict = judge(expected, seen, GATES, human_us=human_us)
            wrong = verdict.wrong
            if wrong and seen.stalled_ms():
                raise needs.Late(f"the emulated Arduino had no time for {seen.stalled_ms():.0f} ms: {wrong}")
            assert wrong == []
            if happens is stop:  # in the middle of a turn, or between two of them
                record.process.send_signal(signal.SIGCONT)
                needs.until(lambda: record.process.poll() is not None or waits_for_a_human(record), 30)
                record.process.send_signal(signal.SIGINT)
            status = record.ended()
            after: list[int] = []
            needs.until(lambda: after.extend(e.pulse_us for e in board.pulses() if e.pin == "throttle") or after, 30)
            assert after and max(after) <= GATES.throttle_max_us  # nothing drives it again
    if happens is interrupt and ENDING:  # lerobot-rollout takes a first Ctrl-C for the wish to end in order
        assert status == 0
    else:
        assert status == -signal.SIGKILL if happens is kill else status != 0
    asked_to_end = "Shutdown signal 2 received" if ENDING else "KeyboardInterrupt"
    wanted = {interrupt: asked_to_end, take_over: "TakenOver: the human took over"}
    assert wanted.get(happens, "") in record.text
    print(f"{happens.__name__}: {verdict.figures}")
    for pid in children:
        needs.until(lambda pid=pid: needs.ended(pid), 10)


@pytest.mark.emulated
@pytest.mark.slow
@needs.simavr
@needs.real_time
@pytest.mark.skipif(not ENDING, reason="LeRobot has had lerobot-rollout since 0.5")
def test_daggers_correction_is_a_takeover(eyes, artifact, plugin, tmp_path):
    """Space pauses the policy, Tab begins and ends the human's correction, which alone is recorded."""
    from rover_lib.workshop.recordings.episodes import load_recordings

    folder = Path(tempfile.mkdtemp(dir=tmp_path))  # of this attempt
    keyboard, terminal = pty.openpty()
    with EmulatedArduino(transmitter=REST_US, ready=True, nice=NICE) as board:
        throttles: list[int] = []

        def throttle():
            throttles.extend(e.pulse_us for e in board.pulses() if e.pin == "throttle")
            return throttles[-1] if throttles else 0

        given = {"policy__type": "rover_artifact", "policy__artifact": artifact, "strategy__type": "dagger"}
        given |= recording(folder, "rollout_d", num_episodes=1) | {"strategy__smooth_handover": False}
        given |= {"teleop__type": "rover_transmitter", "teleop__port": board.port}
        with LeRobot("lerobot-rollout", plugin, folder, stdin=terminal, **robot(board.port, eyes), **given) as rollout:
            needs.until(lambda: throttle() > 190 or rollout.process.poll() is not None, START_S)
            os.write(keyboard, b" ")
            needs.until(lambda: throttle() <= GATES.throttle_max_us, 5)
            time.sleep(0.5)
            assert throttle() <= GATES.throttle_max_us and rollout.process.poll() is None, rollout.text[-3000:]
            os.write(keyboard, b"\t")
            board.transmitter(*STICKS[0])
            time.sleep(1.5)
            os.write(keyboard, b"\t")
            rollout.wait_for("Correction 1/1 saved", 60)
            board.transmitter(*REST_US)
            assert rollout.ended() == 0, rollout.text[-3000:]
    table = rows(folder / "rollout_d")
    assert len(table) > 10 and np.stack(table["intervention"]).all()
    pulses = pulses_of(np.stack(table["action"]))
    assert (np.abs(pulses - STICKS[0]).max(1) <= ARDUINO_STEP_US).mean() > 0.5  # from when they were moved
    (episode,) = load_recordings(folder / "rollout_d", 8).episodes
    assert episode.by_policy and {sample.driver for sample in episode.samples} == {"human"}


# ---- in the balloon world


@pytest.mark.release  # ten seconds in which a busy machine must never be late by a tenth of one
@needs.real_time
def test_the_demos_policy_hits_balloons(demo_run, plugin, tmp_path):
    """By a packed folder, two episodes, each after a gesture, which the stand-in's human has always just made."""
    folder = Path(tempfile.mkdtemp(dir=tmp_path))  # of this attempt
    packing = [sys.executable, "-m", "lerobot_robot_rover", demo_run / "policy_static.pt", folder / "packed"]
    subprocess.run(packing, check=True, env={**os.environ, "PYTHONPATH": f"{plugin}{os.pathsep}{ROOT}"})
    with VirtualCar() as car:
        given = robot(car.port, folder, camera=car.camera, width=128, height=72)
        name = "rollout_world" if ENDING else "eval_world"
        given |= recording(folder, name, num_episodes=2, episode_time_s=5, reset_time_s=0)
        if ENDING:
            given |= {"strategy__type": "episodic", "strategy__reset_to_initial_position": False}
        command = "lerobot-rollout" if ENDING else "lerobot-record"
        with LeRobot(command, plugin, folder, policy__path=folder / "packed", **given) as record:
            end_s = time.monotonic() + START_S
            needs.until(lambda: record.over(end_s), START_S + 1)
            assert record.ended() == 0, record.text[-3000:]
        report = car.report()
    assert report.hits >= 1, report.outcomes
    table = rows(folder / name)
    assert sorted(set(table["episode_index"])) == [0, 1]
    assert read_log(folder / "flight.log").drives == 2

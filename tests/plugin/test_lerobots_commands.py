"""LeRobot's own commands, as processes, with the rover: on the emulated Arduino, and in the balloon world."""

import importlib
import inspect
import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
import zipfile
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from balloon_world.car import CameraFeed
from balloon_world.simulated_arduino import REST_US
from lab.arduino.emulator import NICE, EmulatedArduino
from lab.driving.pins import STOPPED, Observation, judge, most_throttle_us
from lab.driving.policy import pictures
from lerobot_robot_rover.line import ENDING
from rover_lib.onboard.car.pwm import ARDUINO_STEP_US, PwmCalibration
from rover_lib.onboard.drive.flight_log import read_log
from rover_lib.workshop.recordings.episodes import load_recordings
from tests.helpers import needs

ROOT = Path(__file__).parents[2]
BIN = Path(sys.executable).parent
START_S = 150.0  # LeRobot imports for 5 s, or 20 on a busy machine
STICKS = ((1600.0, 150.0), (1300.0, 173.0), (1480.0, 140.0), (1750.0, 160.0))  # within what the host may ask for, too


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

    def __init__(self, name, plugin, folder, **options):
        words = [f"--{key.replace('__', '.')}={value}" for key, value in options.items()]
        offline = {"HF_HUB_OFFLINE": "1", "HF_DATASETS_CACHE": str(folder / "cache"), "HF_LEROBOT_HOME": str(folder)}
        env = {**os.environ, **offline, "OMP_NUM_THREADS": "1", "PYTHONPATH": f"{plugin}{os.pathsep}{ROOT}"}
        env.pop("DISPLAY", None)
        self._said = folder / f"{name}.txt"
        heeds = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # a shell's & would have it ignored
        with self._said.open("w") as file:
            pipes = {"stdin": subprocess.DEVNULL, "stdout": file, "stderr": subprocess.STDOUT}
            self.process = subprocess.Popen([BIN / name, *words], env=env, cwd=folder, preexec_fn=heeds, **pipes)

    def __enter__(self):
        return self

    def __exit__(self, *exc):
        self.process.kill()
        self.process.wait()

    @property
    def text(self):
        return self._said.read_text()

    def wait_for(self, words):
        needs.until(lambda: words in self.text or self.process.poll() is not None, START_S)
        assert words in self.text, self.text[-3000:]

    def over(self):
        """Whether it has ended. Raises Late where its loop was too slow for the car, and waits for a human again."""
        if "before the car can drive" in self.text.partition(" armed\n")[2]:
            raise needs.Late("LeRobot's loop was late")
        return self.process.poll() is not None

    def ended(self):
        """Its exit status."""
        return self.process.wait(60.0)


def robot(port, folder, **more):
    given = {"port": port, "camera": folder / "camera", "width": 96, "height": 48} | more
    given |= {"log": folder / "flight.log", "calibration_dir": folder}
    return {"robot__type": "rover"} | {f"robot__{key}": value for key, value in given.items()}


def recording(folder, name, **more):
    codec = "rgb_encoder__vcodec" if ENDING else "vcodec"
    given = {"repo_id": f"local/{name}", "root": folder / name, "single_task": "drive", "push_to_hub": False}
    given |= {codec: "h264", "fps": 30} | more
    return {f"dataset__{k}": v for k, v in given.items()} | {"play_sounds": False, "display_data": False}


def driving(folder, name, **more):
    """The command by which this LeRobot lets a policy drive, and its options. name: of the dataset, less its prefix."""
    if not ENDING:
        return "lerobot-record", recording(folder, f"eval_{name}", reset_time_s=0, **more)
    options = recording(folder, f"rollout_{name}", reset_time_s=0, **more)
    return "lerobot-rollout", options | {"strategy__type": "episodic", "strategy__reset_to_initial_position": False}


def rows(root):
    """A dataset's, in order."""
    files = sorted((root / "data").rglob("*.parquet"))
    return pd.concat([pd.read_parquet(file) for file in files]).sort_values("index")


def pulses_of(actions):
    calibration = PwmCalibration()
    return np.array([[(p := calibration.pulses(*map(float, a))).steering_us, p.throttle_us] for a in actions])


@pytest.mark.slow
def test_lerobots_own_parser_takes_what_the_pages_say(monkeypatch):
    """Those of this LeRobot: in 0.6 lerobot-record drives no policy, and in 0.4 there is no lerobot-rollout."""
    import draccus

    text, parsed = "".join(p.read_text() for p in (ROOT / "docs").glob("*.md")).replace("\\\n", " "), []
    for line in re.findall(r"^    (lerobot-\w+ .*)$", text, re.M):
        program, *words = shlex.split(line.partition(" # ")[0])
        if not (BIN / program).exists() or (ENDING and program == "lerobot-record" and "policy" in line):
            continue
        module = importlib.import_module(f"lerobot.scripts.{program.replace('-', '_')}")
        config = inspect.unwrap(getattr(module, program.partition("-")[2])).__annotations__["cfg"]
        config = eval(config, vars(module)) if isinstance(config, str) else config
        monkeypatch.setattr(sys, "argv", [program, *words])  # where LeRobot looks for a policy's path
        # Else LeRobot speaks by a program of Debian's that few have, and ends in FileNotFoundError.
        assert getattr(draccus.parse(config, args=words), "play_sounds", False) is False, line
        parsed.append(program)
    assert len(parsed) == 4, parsed


@pytest.fixture(scope="module")
def eyes(tmp_path_factory):
    """A folder with a camera in it."""
    folder = tmp_path_factory.mktemp("lerobot")
    with CameraFeed(folder / "camera", *pictures()):
        yield folder


@pytest.mark.emulated
@pytest.mark.slow
@needs.simavr
@needs.real_time
def test_a_humans_episodes_are_recorded_read_and_replayed(eyes, plugin, tmp_path):
    folder = Path(tempfile.mkdtemp(dir=tmp_path))  # of this attempt
    (folder / "camera").symlink_to(eyes / "camera")
    with EmulatedArduino(every_pulse=False, transmitter=REST_US, nice=NICE) as board:
        given = robot(board.port, folder) | {"teleop__type": "rover_transmitter", "teleop__port": board.port}
        given |= recording(folder, "drives", num_episodes=2, episode_time_s=2, reset_time_s=0.5)
        with LeRobot("lerobot-record", plugin, folder, **given) as record:
            record.wait_for("Recording episode 0")
            turn = 0
            while not record.over():
                board.transmitter(*STICKS[turn % len(STICKS)])
                turn += 1
                time.sleep(0.4)
            assert record.ended() == 0 and "armed" not in record.text, record.text[-3000:]
    table = rows(folder / "drives")
    for _, episode in table.groupby("episode_index"):
        actions = np.stack(episode["action"])
        distance = np.abs(pulses_of(actions)[:, None] - np.array(STICKS)).max(2)  # to each of the sticks' positions
        assert len(actions) >= 20 and (distance.min(1) <= ARDUINO_STEP_US).mean() > 0.8  # a status may be in between
        np.testing.assert_array_equal(np.stack(episode["observation.state"])[1:], actions[:-1])
    ours = load_recordings(folder / "drives", 8)
    assert len(ours.episodes) == 2 and not ours.faults and 60 < ours.samples[5].frame_bgr().mean() < 160
    (folder / "flight.log").unlink()
    with EmulatedArduino(every_pulse=False, transmitter=REST_US, ready=True, nice=NICE) as board:
        given = robot(board.port, folder) | {"dataset__repo_id": "local/drives", "dataset__root": folder / "drives"}
        given |= {"dataset__episode": 1, "play_sounds": False}
        with LeRobot("lerobot-replay", plugin, folder, **given) as replay:
            needs.until(replay.over, START_S)
            assert replay.ended() == 0, replay.text[-3000:]
    ticks = read_log(folder / "flight.log").ticks
    sent = np.stack([ticks["steering_us"], ticks["throttle_us"]], 1).astype(int)
    recorded = pulses_of(np.stack(table[table["episode_index"] == 1]["action"]))
    changes = [pulses[np.r_[True, (np.diff(pulses, axis=0) != 0).any(1)]] for pulses in (sent, recorded)]
    np.testing.assert_array_equal(*changes)


@pytest.mark.emulated
@pytest.mark.slow
@needs.simavr
@pytest.mark.parametrize("happens", ["SIGINT", pytest.param("SIGKILL", marks=pytest.mark.release)])
@needs.real_time
def test_however_it_ends_the_car_is_stopped(happens, eyes, artifact, plugin, tmp_path):
    folder = Path(tempfile.mkdtemp(dir=tmp_path))  # of this attempt
    command, given = driving(folder, "a", num_episodes=1, episode_time_s=60)
    given |= {"policy__type": "rover_artifact", "policy__artifact": artifact}
    with EmulatedArduino(transmitter=REST_US, ready=True, nice=NICE) as board:
        events = []

        def throttle():
            time.sleep(0.02)
            events.extend(new := board.pulses())
            return max((e.pulse_us for e in new if e.pin == "throttle"), default=0)

        with LeRobot(command, plugin, eyes, **robot(board.port, eyes), **given) as record:
            needs.until(lambda: throttle() > 190 or record.over(), START_S)
            time.sleep(0.8)
            at_s = time.monotonic()
            record.process.send_signal(getattr(signal, happens))
            time.sleep(1.0)
            throttle()  # all that came since
            seen = Observation(events, [], at_s, at_s + 1.0)
            if seen.stalled_ms() or not seen.was_driving(most_throttle_us()):
                raise needs.Late("the car had stopped before the fault")  # as it must, after a late command or picture
            figures, wrong = judge(STOPPED, seen)
            assert wrong == []
            print(f"{happens}: {figures}")
            status = record.ended()
            throttle()
            time.sleep(0.5)
            assert 0 < throttle() <= most_throttle_us()  # nothing drives it again
    # lerobot-rollout takes a first Ctrl-C for the wish to end in order
    assert (status == 0) == (happens == "SIGINT" and bool(ENDING))

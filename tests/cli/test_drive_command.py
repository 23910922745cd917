"""`rover drive` whole, as a user calls it: a car of its own process, a camera, a serial line, exit codes, files."""

import contextlib
import json
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from needs import real_time, until

from balloon_world.car import VirtualCar
from lab.driving.policy import make_artifact, pictures
from rover_lib.cli import main
from rover_lib.onboard.car.servo_link import ServoLink
from rover_lib.onboard.drive.flight_log import read_log
from rover_lib.workshop.recordings.episodes import load_recordings

pytestmark = pytest.mark.slow
ROVER = [str(Path(sys.executable).parent / "rover"), "drive"]


@pytest.fixture(scope="module")
def artifact(tmp_path_factory):
    """A policy with one plan, for `pictures`."""
    path = tmp_path_factory.mktemp("artifact") / "policy_constant.pt"
    make_artifact(path)
    return path


def fresh(folder):
    """A folder of an attempt's own: see needs.real_time."""
    return Path(tempfile.mkdtemp(dir=folder))


@pytest.fixture(scope="module")
def world_drive(demo_run, tmp_path_factory):
    """One drive in the balloon world, recorded."""

    @real_time
    def drive():
        folder = fresh(tmp_path_factory.mktemp("drive"))
        options = ["--world", "--ticks", "60", "--latency-ms", "50", "--log", folder / "flight.log"]
        options += ["--json", folder / "drive.json", "--record", folder / "episodes"]
        policy = demo_run / "policy_static.pt"
        done = subprocess.run([*ROVER, policy, *map(str, options)], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return folder, done.stderr

    return drive()


def test_a_drive_leaves_its_report(world_drive):
    report = json.loads((world_drive[0] / "drive.json").read_text())
    assert (report["ticks"], report["ended"]) == (60, "60 ticks")
    assert {"missed", "jitter_p50_ms", "jitter_p99_ms", "jitter_max_ms", "plan_age_p95_ms", "hits", "trials"} <= set(
        report
    )
    assert 50 <= report["latency_p50_ms"] < 150
    assert report["memory_mb"] > 50


def test_a_drive_leaves_its_log(world_drive):
    flight = read_log(world_drive[0] / "flight.log")
    assert len(flight.ticks["t_s"]) == 60
    assert set(flight.ticks["state"]) == {"A"}
    assert any(e.text == "armed" for e in flight.events)
    assert any("neutral: stopped" in e.text for e in flight.events)
    assert "armed" in world_drive[1]


def test_a_recorded_drive_is_an_episode(world_drive):
    recordings = load_recordings(world_drive[0] / "episodes")
    (episode,) = recordings.episodes
    assert len(episode.samples) > 30
    data = json.loads(next((world_drive[0] / "episodes").glob("*/episode_data.json")).read_text())
    assert len(data["control_samples"]) == 60
    assert {"mode", "plan_age_ms"} <= set(data["control_samples"][0])
    assert {row["driver"] for row in data["control_samples"]} == {s.driver for s in episode.samples} == {"policy"}
    assert "takeover" not in data["metadata"]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
@real_time
def test_a_signal_stops_the_car_and_is_no_fault(demo_run, tmp_path, number):
    folder = fresh(tmp_path)
    options = ["--world", "--log", folder / "flight.log", "--json", folder / "drive"]
    command = [*ROVER, str(demo_run / "policy_static.pt"), *map(str, options)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    for line in process.stderr:
        if line.strip() == "rover: armed":
            break
    time.sleep(0.5)
    process.send_signal(number)
    _, stderr = process.communicate(timeout=20)
    assert process.returncode == 0, stderr
    assert f"{number.name}: stopping" in stderr
    assert json.loads((folder / "drive").read_text())["ended"] == "told to stop"


@contextlib.contextmanager
def watched(demo_run, folder):
    """A drive of 300 ticks in the world, its view's server, and an open page that shows it."""
    pytest.importorskip("aiohttp", reason="needs the extra view")
    from lab.driving.page import Page, ViewServer

    options = ["--world", "--ticks", "300", "--view", folder / "view", "--log", folder / "flight.log"]
    options += ["--json", folder / "drive"]
    with ViewServer(folder / "view") as server, Page(server.url) as page:
        command = [*ROVER, str(demo_run / "policy_static.pt"), *map(str, options)]
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
            try:
                until(lambda: page.newest["phase"] == "driving", 120)
                yield server, page, process
            finally:
                process.kill()


def ending(process, folder):
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 0, stderr
    return json.loads((folder / "drive").read_text())


@real_time
def test_a_page_shows_the_flight_log_and_its_button_ends_the_drive(demo_run, tmp_path):
    folder = fresh(tmp_path)
    with watched(demo_run, folder) as (_, page, process):
        until(lambda: len(page.messages) > 20)
        page.stop()
        until(lambda: page.newest["phase"] == "ended")
        assert page.newest["stopped"] and page.newest["pins"][1] == 120
        assert ending(process, folder)["ended"] == page.newest["text"] == "stopped from the view (127.0.0.1)"
    flight = read_log(folder / "flight.log")
    assert "ended: stopped from the view (127.0.0.1)" in [e.text for e in flight.events]
    shown = [m for m in page.messages if m["phase"] == "driving"]
    assert len(shown) > 15 and all(m["jpeg_bytes"] > 1000 and m["size"] == [640, 360] for m in shown)
    for message in shown:
        row = int(np.argmin(np.abs(flight.ticks["t_s"] - message["tick"]["t_s"])))
        assert flight.ticks["t_s"][row] == pytest.approx(message["tick"]["t_s"], abs=1e-3)
        for name in ("steering_us", "throttle_us", "pins_steering_us", "pins_throttle_us", "plan", "frame"):
            assert message["tick"][name] == flight.ticks[name][row]
        assert message["pins"] == [message["tick"]["pins_steering_us"], message["tick"]["pins_throttle_us"]]


@real_time
def test_a_fault_is_exit_code_3_and_leaves_its_report(artifact, tmp_path):
    """A camera of some seconds, which torch may take to load, the car being another world's."""
    folder = fresh(tmp_path)
    (folder / "short.mjpeg").write_bytes(b"".join(pictures(0) * 14))
    with VirtualCar() as car:
        options = ["--film", "--camera", folder / "short.mjpeg", "--port", car.port]
        options += ["--log", folder / "l", "--json", folder / "j"]
        done = subprocess.run([*ROVER, artifact, *map(str, options)], capture_output=True, text=True)
    assert done.returncode == 3, done.stderr
    assert "is the camera unplugged?" in done.stderr
    assert "Traceback" not in done.stderr
    assert "unplugged" in json.loads((folder / "j").read_text())["ended"]


def test_a_dry_run_needs_no_arduino(artifact, tmp_path):
    (tmp_path / "drive.mjpeg").write_bytes(b"".join(pictures(0) * 50))
    options = [
        "--camera",
        tmp_path / "drive.mjpeg",
        "--dry-run",
        "--ticks",
        "30",
        "--log",
        tmp_path / "l",
        "--json",
        "-",
    ]
    done = subprocess.run([*ROVER, artifact, *map(str, options)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["ticks"] == 30


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        ([], 2, "ARTIFACT"),
        (["policy.pt", "--latency-ms", "50"], 2, "belongs to --world"),
        (["policy.pt", "--hz", "5"], 2, "--hz"),
        (["policy.pt", "--throttle-limit", "1.5"], 2, "--throttle-limit"),
        (["policy.pt", "--port", "/dev/nothing"], 1, "/dev/nothing: cannot be opened"),
        (["nope.pt", "--port", "/dev/nothing"], 1, "nope.pt: not found"),
        (["policy.pt", "--dry-run", "--camera", "/dev/video77"], 1, "/dev/video77: no such camera"),
        (["policy.pt", "--camera", "."], 1, ".: recorded pictures know nothing of where the car is; give the camera's"),
    ],
)
def test_what_cannot_begin(options, code, message, artifact, tmp_path):
    options = [str(artifact) if option == "policy.pt" else option for option in options]
    result = CliRunner().invoke(main, ["drive", *options, "--log", str(tmp_path / "flight.log")])
    assert result.exit_code == code
    assert message in result.output
    assert "Traceback" not in result.output


@real_time
def test_the_car_stands_after_it(artifact, tmp_path):
    folder = fresh(tmp_path)
    with VirtualCar() as car:
        (folder / "drive.mjpeg").write_bytes(b"".join(pictures(0) * 50))
        options = ["--film", "--camera", folder / "drive.mjpeg", "--port", car.port, "--ticks", "20"]
        options += ["--log", folder / "l"]
        done = subprocess.run([*ROVER, artifact, *map(str, options)], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        with ServoLink(car.port) as link:
            time.sleep(0.1)
            assert link.latest().throttle_us == 120

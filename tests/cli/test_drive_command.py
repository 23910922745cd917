"""`rover drive` whole, as a user calls it: a car of its own process, a camera, a serial line, exit codes, files."""

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


def test_a_drive_leaves_its_report_its_log_and_an_episode(world_drive):
    folder, said = world_drive
    report = json.loads((folder / "drive.json").read_text())
    assert (report["ticks"], report["ended"]) == (60, "60 ticks")
    assert {"missed", "jitter_p99_ms", "plan_age_p95_ms", "hits", "trials"} <= set(report)
    assert 50 <= report["latency_p50_ms"] < 150 and report["memory_mb"] > 50
    flight = read_log(folder / "flight.log")
    assert len(flight.ticks["t_s"]) == 60 and set(flight.ticks["state"]) == {"A"}
    texts = [e.text for e in flight.events]
    assert "armed" in texts and any("neutral: stopped" in text for text in texts) and "armed" in said
    (episode,) = load_recordings(folder / "episodes").episodes
    assert len(episode.samples) > 30 and {s.driver for s in episode.samples} == {"policy"}
    data = json.loads(next((folder / "episodes").glob("*/episode_data.json")).read_text())
    assert len(data["control_samples"]) == 60 and {"mode", "plan_age_ms"} <= set(data["control_samples"][0])
    assert "takeover" not in data["metadata"]


@real_time
def test_a_signal_stops_the_car_and_is_no_fault(demo_run, tmp_path, number=signal.SIGINT):
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


@real_time
def test_a_page_shows_the_flight_log_and_its_button_ends_the_drive(demo_run, tmp_path):
    pytest.importorskip("aiohttp", reason="needs the extra view")
    from view_page import Page, ViewServer

    folder = fresh(tmp_path)
    options = ["--world", "--ticks", "300", "--view", folder / "view", "--log", folder / "flight.log"]
    command = [*ROVER, demo_run / "policy_static.pt", *options, "--json", folder / "drive"]
    with ViewServer(folder / "view") as server, Page(server.url) as page:
        with subprocess.Popen(list(map(str, command)), stderr=subprocess.PIPE, text=True) as process:
            try:
                until(lambda: sum(m["phase"] == "driving" for m in page.messages) > 20, 120)
                page.stop()
                until(lambda: page.newest["phase"] == "ended")
                _, stderr = process.communicate(timeout=60)
                assert process.returncode == 0, stderr
            finally:
                process.kill()
        assert page.newest["stopped"] and page.newest["pins"][1] == 120
        ended = json.loads((folder / "drive").read_text())["ended"]
        assert ended == page.newest["text"] == "stopped from the view (127.0.0.1)"
    flight = read_log(folder / "flight.log")
    shown = [m for m in page.messages if m["phase"] == "driving"]
    assert all(m["jpeg_bytes"] > 1000 and m["size"] == [640, 360] for m in shown)
    for message in shown:
        row = int(np.argmin(np.abs(flight.ticks["t_s"] - message["tick"]["t_s"])))
        assert flight.ticks["t_s"][row] == pytest.approx(message["tick"]["t_s"], abs=1e-3)
        for name in ("steering_us", "throttle_us", "pins_steering_us", "pins_throttle_us", "plan", "frame"):
            assert message["tick"][name] == flight.ticks[name][row]


@real_time
def test_a_fault_is_exit_code_3_and_leaves_its_report(artifact, tmp_path):
    """A camera of some seconds, which torch may take to load, the car being another world's."""
    folder = fresh(tmp_path)
    for i, picture in enumerate(pictures(0) * 14):
        (folder / f"{i:05}.jpg").write_bytes(picture)
    with VirtualCar() as car:
        options = ["--film", "--camera", folder, "--port", car.port]
        options += ["--log", folder / "l", "--json", folder / "j"]
        done = subprocess.run([*ROVER, artifact, *map(str, options)], capture_output=True, text=True)
        with ServoLink(car.port) as link:  # the car stands after it
            until(lambda: link.latest() and link.latest().throttle_us == 120)
    assert done.returncode == 3, done.stderr
    assert "is the camera unplugged?" in done.stderr
    assert "Traceback" not in done.stderr
    assert "unplugged" in json.loads((folder / "j").read_text())["ended"]


def test_a_dry_run_needs_no_arduino(artifact, tmp_path):
    for i, picture in enumerate(pictures(0) * 50):
        (tmp_path / f"{i:05}.jpg").write_bytes(picture)
    options = ["--camera", tmp_path, "--dry-run", "--ticks", 30, "--log", tmp_path / "l", "--json", "-"]
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

"""`rover drive` whole, as a user calls it: a car of its own process, a camera, a serial line, exit codes, files."""

import asyncio
import json
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

from balloon_world.car import CameraFeed, VirtualCar
from lab.driving.policy import make_artifact, pictures
from rover_lib.onboard.car.servo_link import ServoLink
from rover_lib.onboard.drive.flight_log import read_log
from rover_lib.workshop.recordings.episodes import load_recordings
from tests.helpers.needs import real_time, until

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


def in_world(demo_run, folder, *options):
    """The command that drives the demo's policy in the balloon world, and leaves its log and summary in `folder`."""
    files = ["--log", folder / "flight.log", "--json", folder / "drive.json"]
    return [*ROVER, *map(str, [demo_run / "policy_static.pt", "--world", *options, *files])]


@real_time
def test_a_signal_ends_a_drive_which_leaves_its_report_its_log_and_an_episode(demo_run, tmp_path):
    folder = fresh(tmp_path)
    command = in_world(demo_run, folder, "--latency-ms", 50, "--record", folder / "episodes")
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    for line in process.stderr:
        if line.strip() == "rover: armed":
            break
    time.sleep(2)
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate(timeout=20)
    assert process.returncode == 0 and "SIGINT: stopping" in stderr, stderr
    report = json.loads((folder / "drive.json").read_text())
    assert report["ended"] == "told to stop" and 50 <= report["latency_p50_ms"] < 150
    assert {"missed", "jitter_p99_ms", "plan_age_p95_ms", "hits", "trials"} <= set(report)
    flight = read_log(folder / "flight.log")
    assert len(flight.ticks["t_s"]) == report["ticks"] > 40 and set(flight.ticks["state"]) == {"A"}
    assert any("neutral: stopped" in event.text for event in flight.events)
    (episode,) = load_recordings(folder / "episodes").episodes
    assert len(episode.samples) > 30 and {s.driver for s in episode.samples} == {"policy"}
    data = json.loads(next((folder / "episodes").glob("*/episode_data.json")).read_text())
    assert len(data["control_samples"]) == report["ticks"]
    assert {"mode", "plan_age_ms"} <= set(data["control_samples"][0])


async def watch_and_stop(url: str) -> list[dict]:
    """Show a drive's page, confirm each message, click on stop after 20 of the drive, and return all of them."""
    import aiohttp

    base, _, token = url.partition("/?token=")
    heads: list[dict] = []
    async with aiohttp.ClientSession() as browser, browser.ws_connect(f"{base}/ws?token={token}") as page:
        while not heads or heads[-1]["phase"] != "ended":
            message = await page.receive(timeout=120)
            if message.type == aiohttp.WSMsgType.BINARY:
                heads.append(json.loads(message.data.partition(b"\n")[0]))
                await page.send_str(f"shown {heads[-1]['n']}")
                if sum(head["phase"] == "driving" for head in heads) == 20:
                    await page.send_str("stop")
    return heads


@real_time
def test_a_page_shows_the_flight_log_and_its_button_ends_the_drive(demo_run, tmp_path):
    pytest.importorskip("aiohttp", reason="needs the extra look")
    folder = fresh(tmp_path)
    served = [*ROVER[:1], "view", "--web-port", "0", "--feed", str(folder / "view")]
    with subprocess.Popen(served, stdout=subprocess.PIPE, text=True) as view:
        url = view.stdout.readline().strip()
        with subprocess.Popen(in_world(demo_run, folder, "--ticks", 300, "--view", folder / "view")) as process:
            heads = asyncio.run(watch_and_stop(url))
            assert process.wait(60) == 0
        view.terminate()
    ended = json.loads((folder / "drive.json").read_text())["ended"]
    assert ended == heads[-1]["text"] == "stopped from the view (127.0.0.1)"
    assert heads[-1]["stopped"] and heads[-1]["pins"][1] == 120
    assert any(head["ribbon"] for head in heads if head["phase"] == "driving")


@real_time
def test_a_fault_is_exit_code_3_and_leaves_its_report(artifact, tmp_path):
    """A camera that is unplugged, the car being another world's."""
    folder = fresh(tmp_path)
    with VirtualCar() as car, CameraFeed(folder / "camera", *pictures()) as feed:
        options = ["--camera", folder / "camera", "--port", car.port, "--log", folder / "l", "--json", folder / "j"]
        with subprocess.Popen([*ROVER, artifact, *map(str, options)], stderr=subprocess.PIPE, text=True) as process:
            for line in process.stderr:
                if line.strip() == "rover: armed":
                    break
            feed.close()
            _, stderr = process.communicate(timeout=20)
        with ServoLink(car.port) as link:  # the car stands after it
            until(lambda: link.latest() and link.latest().throttle_us == 120)
    assert process.returncode == 3 and "Traceback" not in stderr, stderr
    assert "unplugged" in json.loads((folder / "j").read_text())["ended"]

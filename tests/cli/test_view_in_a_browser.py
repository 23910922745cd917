"""`rover view` as a user sees it, in a real browser: its pictures, its button, several pages, and a phone's."""

import asyncio
import os
import signal
import subprocess
import sys
from urllib.parse import quote

import pytest

pytest.importorskip("aiohttp", reason="needs the extra view")

from browser import Browser, chromium  # it needs aiohttp

from rover_lib.onboard.drive.flight_log import read_log

pytestmark = chromium
GREEN = """(() => {  // pixels of the picture that are of the ribbon's colour
  const c = document.getElementById('picture'), d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;
  let n = 0;
  for (let i = 0; i < d.length; i += 4) n += d[i + 1] > d[i] + 60 && d[i + 1] > d[i + 2] + 40;
  return n;
})()"""


def start(*words, tmp_path):
    env = {**os.environ, "XDG_STATE_HOME": str(tmp_path), "DISPLAY": ""}
    command = [sys.executable, "-m", "rover_lib.cli", *map(str, words)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=env)


def end(*processes):
    for process in processes:
        process.send_signal(signal.SIGINT)
        process.wait(120)  # Python takes a second of processor to end, and may get little
        process.stdout.close()


@pytest.fixture
def view(demo_run, tmp_path):
    """The demo's policy that drives a simulated car in real time, with another process's view of it: the page's URL."""
    place = tmp_path / "place"
    shown = start("view", "--web-port", "0", "--feed", place, tmp_path=tmp_path)
    url = shown.stdout.readline().strip()
    driving = start("drive", demo_run / "policy_static.pt", "--world", "--view", place, tmp_path=tmp_path)
    yield url
    end(driving, shown)


@pytest.fixture
def simulation(demo_run, tmp_path):
    """What `make watch` shows: the page's URL."""
    shown = start("view", demo_run / "policy_static.pt", "--web-port", "0", tmp_path=tmp_path)
    yield shown.stdout.readline().strip()
    end(shown)


@pytest.mark.slow
def test_a_simulation_lives_through_a_busy_machine(simulation, tmp_path, seconds=15):
    """Beside four processes that compute without end, the car drives world after world, and a phone shows it whole."""

    async def scene():
        async with Browser(tmp_path / "profile") as browser:
            tab = await browser.open(quote(simulation, safe=""))
            await tab.be_a_phone()
            await tab.until("newest.world")
            old = 0
            for _ in range(seconds):
                await asyncio.sleep(1)
                old += await tab.value("document.body.classList.contains('old')")
            assert old < seconds / 10
            assert await tab.sideways("body") == {"cut": [], "scrolls": []}
            await tab.until("newest.world.results.INT8[1] > 0")
            await tab.click("drive FP32")
            await tab.until("newest.world.drives === 'FP32'")
            await tab.click("stop")
            await tab.until("newest.phase === 'ended' && newest.text.startsWith('stopped here')")
            await tab.click("next")
            await tab.until("newest.phase === 'driving'")

    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(4)]
    try:
        asyncio.run(scene())
    finally:
        for process in busy:
            process.kill()
            process.wait()


@pytest.mark.release
def test_a_click_on_one_of_three_pages_stops_the_car(view, tmp_path):
    """And a phone's page fits, and says so when the view is gone."""

    async def scene():
        async with Browser(tmp_path / "profile") as browser:
            tabs = [await browser.open(quote(view, safe="")) for _ in range(3)]
            for tab in tabs:
                await tab.until("document.getElementById('phase').textContent === 'driving'")
            await tabs[0].until(f"newest.ribbon.length > 3 && {GREEN} > 100")  # where the plan leads
            await tabs[1].be_a_phone()
            assert await tabs[1].sideways("body") == {"cut": [], "scrolls": []}
            assert await tabs[1].value("document.getElementById('stop').getBoundingClientRect().bottom") <= 844
            await tabs[1].value("wire.close(); connect = () => {}; true")
            await tabs[1].until("document.getElementById('phase').textContent.startsWith('no news for')")
            await tabs[1].click("stop")
            assert "NO CONNECTION: stop the car with the transmitter" in await tabs[1].text("answer")
            await tabs[2].click("stop")
            await tabs[2].until("document.getElementById('answer').textContent.startsWith('stopped: ')")
            await tabs[0].until("document.getElementById('phase').textContent !== 'driving'")
            return await tabs[2].text("answer")

    assert "throttle pin at 120 us" in asyncio.run(scene())
    flight = read_log(tmp_path / "rover" / "flight.log")
    assert any(e.text == "ended: stopped from the view (127.0.0.1)" for e in flight.events)

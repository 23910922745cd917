"""`rover view` as a user sees it, in a real browser of a phone's size: its pictures, its buttons, a lost connection."""

import asyncio
import signal
import subprocess
import sys
from urllib.parse import quote

import pytest

pytest.importorskip("aiohttp", reason="needs the extra look")

from browser import Browser, chromium  # it needs aiohttp

pytestmark = [chromium, pytest.mark.slow]


@pytest.fixture
def simulation(demo_run):
    """What `make watch` shows: the page's URL."""
    words = ["-m", "rover_lib.cli", "view", demo_run / "policy_static.pt", "--web-port", "0"]
    shown = subprocess.Popen([sys.executable, *words], stdout=subprocess.PIPE, text=True)
    yield shown.stdout.readline().strip()
    shown.send_signal(signal.SIGINT)
    shown.communicate(timeout=120)  # Python takes a second of processor to end, and may get little


def test_a_simulation_on_a_phone(simulation, tmp_path):
    async def scene():
        async with Browser(tmp_path / "profile") as browser:
            tab = await browser.open(quote(simulation, safe=""))
            await tab.be_a_phone()
            await tab.until("newest.world")
            assert await tab.sideways("body") == {"cut": [], "scrolls": []}
            await tab.until("newest.world.results.INT8[1] > 0")
            await tab.click("drive FP32")
            await tab.until("newest.world.drives === 'FP32'")
            await tab.click("stop")
            await tab.until("newest.phase === 'ended' && newest.text.startsWith('stopped here')")
            await tab.click("next")
            await tab.until("newest.phase === 'driving' && newest.ribbon.length > 3")  # where the plan leads
            key = {"type": "keyDown", "key": "ArrowLeft"}
            await tab.ask("Input.dispatchKeyEvent", **key)
            await tab.until("hint.textContent.includes('Recovered from')")
            await tab.value("wire.close(); connect = () => {}; true")
            await tab.until("document.getElementById('phase').textContent.startsWith('no news for')")
            await tab.click("stop")
            assert "NO CONNECTION: stop the car with the transmitter" in await tab.text("answer")

    asyncio.run(scene())

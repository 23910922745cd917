"""A real browser without a window: Debian's chromium, if it is installed, controlled through its debugging protocol."""

import asyncio
import json
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

import aiohttp
import pytest

CHROMIUM = shutil.which("chromium")
chromium = pytest.mark.skipif(not CHROMIUM, reason="needs the Debian package chromium")
START_S = 60.0
PHONE_PX = 390
# What leaves the window sideways: in no box that scrolls ("cut"), or in one ("scrolls").
SIDEWAYS = """(within => {
  const scrolls = e => ['auto', 'scroll'].includes(getComputedStyle(e).overflowX), found = {cut: [], scrolls: []};
  const boxed = e => e.parentElement && (scrolls(e.parentElement) || boxed(e.parentElement));
  for (const e of document.querySelectorAll(within + ' *')) {
    const at = e.getBoundingClientRect(), seen = at.width > 1 && at.height > 1, text = e.tagName + ': ' + e.textContent;
    if (seen && (at.right > innerWidth + 1 || at.left < -1) && !boxed(e)) found.cut.push(text.slice(0, 60));
    if (seen && scrolls(e) && e.scrollWidth > e.clientWidth + 1) found.scrolls.push(text.slice(0, 60));
  }
  return found;
})"""


class Tab:
    """One open page."""

    def __init__(self, wire: aiohttp.ClientWebSocketResponse):
        self._wire, self._asked = wire, 0

    async def ask(self, method: str, **params: Any) -> dict[str, Any]:
        self._asked += 1
        await self._wire.send_json({"id": self._asked, "method": method, "params": params})
        while (answer := await self._wire.receive_json(timeout=START_S)).get("id") != self._asked:
            pass
        assert "error" not in answer, answer
        return answer["result"]

    async def value(self, expression: str) -> Any:
        """Evaluate JavaScript in the page and return its value."""
        found = await self.ask("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    async def text(self, name: str) -> str:
        """Return the text of the element with this id."""
        return await self.value(f"document.getElementById({name!r}).textContent")

    async def until(self, expression: str, seconds: float = 120.0) -> None:
        """Wait until a JavaScript expression is true.

        While it cannot be evaluated, because the page has not loaded, it counts as false.
        """
        end = time.monotonic() + seconds
        while not await self.value(f"(() => {{ try {{ return {expression}; }} catch (error) {{ return false; }} }})()"):
            assert time.monotonic() < end, f"{expression}: {await self.value('document.body.innerText')}"
            await asyncio.sleep(0.1)

    async def be_a_phone(self) -> None:
        """Give the page the width of a phone, before it is loaded."""
        size = {"width": PHONE_PX, "height": 844, "deviceScaleFactor": 2, "mobile": True}
        await self.ask("Emulation.setDeviceMetricsOverride", **size)

    async def sideways(self, within: str) -> dict[str, list[str]]:
        """Return what of the elements within a selector is "cut", and what only "scrolls" to be seen whole."""
        assert await self.value("document.documentElement.scrollWidth") <= PHONE_PX
        return await self.value(f"{SIDEWAYS}({within!r})")

    async def click(self, name: str) -> None:
        """Click with the mouse on the middle of the element with this id."""
        box = json.loads(
            await self.value(f"JSON.stringify(document.getElementById({name!r}).getBoundingClientRect().toJSON())")
        )
        at = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2, "button": "left", "clickCount": 1}
        for kind in ("mousePressed", "mouseReleased"):
            await self.ask("Input.dispatchMouseEvent", type=kind, **at)


class Browser:
    """Chromium with a profile of its own, which it keeps in `folder`. An async context manager."""

    def __init__(self, folder: Path):
        self._folder = folder

    async def __aenter__(self) -> "Browser":
        options = ["--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--mute-audio"]
        options += [f"--user-data-dir={self._folder}", "--remote-debugging-port=0", "about:blank"]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self._process = subprocess.Popen([str(CHROMIUM), *options], **quiet)
        port, end = self._folder / "DevToolsActivePort", time.monotonic() + START_S
        while not (port.exists() and port.read_text().count("\n")):
            assert time.monotonic() < end, "chromium did not start"
            await asyncio.sleep(0.1)
        self._base = f"http://127.0.0.1:{port.read_text().splitlines()[0]}"
        self._session = aiohttp.ClientSession()
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self._session.close()
        self._process.kill()
        self._process.wait()

    async def open(self, url: str) -> Tab:
        async with self._session.put(f"{self._base}/json/new?{url}") as answer:
            found = await answer.json(content_type=None)
        return Tab(await self._session.ws_connect(found["webSocketDebuggerUrl"], max_msg_size=0))

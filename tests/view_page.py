"""Open the view from outside: its server runs as a process, and pages without a browser speak its own protocol."""

import asyncio
import contextlib
import json
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

import aiohttp

from balloon_world.child_process import Child
from rover_lib.onboard.errors import RoverError

START_S = 60.0


class PageError(RoverError):
    """The view does not start, or it does not show a page."""


class ViewServer:
    """`rover view` as a process; a context manager. place: the path of its socket for drives. url: of its page."""

    def __init__(self, place: Path):
        options = ("view", "--web-port", "0", "--feed", place)
        self._process = Child("rover view", sys.executable, "-m", "rover_lib.onboard.cli", *options,
                              error=PageError, talks=True)  # fmt: skip
        self.pid = self._process.pid
        said, end_s = b"", time.monotonic() + START_S
        try:
            while b"\n" not in said:
                said += self._process.read(0.1)
                if time.monotonic() > end_s:
                    raise PageError(f"rover view printed no URL within {START_S:g} s", remedy="try it by hand")
        except BaseException:
            self.close()
            raise
        self.url = said.decode().split()[0]

    def __enter__(self) -> "ViewServer":
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def signal(self, number: int) -> None:
        self._process.process.send_signal(number)

    def close(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            self.signal(signal.SIGCONT)
            self.signal(signal.SIGTERM)
        self._process.wait(5.0)
        self._process.close()


class Page:
    """An open page in its own thread; a context manager. It confirms each message at once, as if it had shown it.

    messages: the head of each message that came, with "heard_s" (time.monotonic() when it came) and "jpeg_bytes".
    """

    def __init__(self, url: str):
        self._base, _, self._token = url.partition("/?token=")
        self.messages: list[dict[str, Any]] = []
        self._loop = asyncio.new_event_loop()
        self._wire: aiohttp.ClientWebSocketResponse | None = None
        self._open = threading.Event()
        self._thread = threading.Thread(target=self._loop.run_until_complete, args=(self._run(),), daemon=True)

    def __enter__(self) -> "Page":
        self._thread.start()
        if not self._open.wait(START_S) or self._wire is None:
            raise PageError(f"{self._base}: no page", remedy="try it in a browser")
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        if self._wire and self._thread.is_alive():
            asyncio.run_coroutine_threadsafe(self._wire.close(), self._loop)
        self._thread.join(10.0)

    def stop(self) -> float:
        """Click on stop; return when (time.monotonic())."""
        assert self._wire, "it is open"
        now_s = time.monotonic()
        asyncio.run_coroutine_threadsafe(self._wire.send_str("stop"), self._loop)
        return now_s

    @property
    def newest(self) -> dict[str, Any]:
        return self.messages[-1] if self.messages else {"phase": "", "stopped": False, "pins": None}

    async def _run(self) -> None:
        try:
            async with aiohttp.ClientSession() as browser:
                url = f"{self._base}/ws?token={self._token}"
                self._wire = await browser.ws_connect(url)
                self._open.set()
                async for message in self._wire:
                    if message.type == aiohttp.WSMsgType.BINARY:
                        line, _, jpeg = message.data.partition(b"\n")
                        head = json.loads(line)
                        self.messages.append(head | {"heard_s": time.monotonic(), "jpeg_bytes": len(jpeg)})
                        await self._wire.send_str(f"shown {head['n']}")
        except (aiohttp.ClientError, ConnectionError):  # the server is gone
            pass
        finally:
            self._open.set()

"""The view: a page in a browser that shows a drive and can stop it. It runs in its own process; no drive imports it.

Drives connect to a Unix socket and send the messages that feed.py describes. Browsers get the page over HTTP, and each
page opens a WebSocket. It receives the newest message, and the next one only after it has confirmed that it shows the
previous one: so no messages queue up. A page may send only "shown N" and "stop", and the view never sends a drive
anything but a stop. In a simulation, a page may also ask for the next world or another policy.

Whoever has the token may watch the drive and stop it. It is in each request's URL and in no cookie, so that no other
page in the same browser can use the view.
"""

import asyncio
import base64
import contextlib
import hashlib
import hmac
import json
import logging
import os
import pwd
import re
import signal
import socket
import struct
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from aiohttp import WSMsgType, web

from rover_lib.onboard.car.car import Car, this_car
from rover_lib.onboard.car.host import is_listened_at, throttled_means
from rover_lib.onboard.car.pwm import ARDUINO_STEP_US
from rover_lib.onboard.errors import RoverError
from rover_lib.onboard.stage import read_plain
from rover_lib.onboard.view.path_overlay import CarShape

PORT = 8470
MESSAGE_BYTES = 1 << 20  # no message of a drive is larger (MOST_BYTES in feed.py)
# Connections that have not shown the token yet: each is a file, of the unit's 256, which a page and a drive need too.
MOST_STRANGERS, STRANGER_S = 32, 3.0
BEAT_S = 5.0  # between two pings; a page that does not answer one is gone
AGAIN_S = 0.1
GONE = "gone"
PAGE = Path(__file__).with_name("view.html")
ASKED = re.compile(r"ask ([\w. ]{1,60})", re.ASCII)  # by the page of a simulation
SHOWN = re.compile(r"shown (\d{1,12})", re.ASCII)


@dataclass(frozen=True)
class Address:
    """Where browsers find the view. port: 0: any free one. interface: such as wlan0; "": only from this machine."""

    port: int = PORT
    interface: str = ""

    def open(self) -> socket.socket:
        """Return a listening socket. Raises RoverError if the port or the interface cannot be used."""
        wire = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            wire.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if self.interface:
                wire.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, self.interface.encode() + b"\0")
            wire.bind(("0.0.0.0" if self.interface else "127.0.0.1", self.port))
            wire.listen(64)
        except OSError as error:
            wire.close()
            problem = f"no page can be served at port {self.port} {self.interface} ({error.strerror})"
            raise RoverError(problem, remedy="another --web-port, or an --interface of `ip -brief address`") from None
        return wire


def read_token(path: Path) -> str:
    """Read the token from a file. Raises OSError, and RoverError if the token could be guessed."""
    token = read_plain(path, 4096).decode(errors="replace").strip()
    if not re.fullmatch(r"[A-Za-z0-9_-]{16,128}", token, re.ASCII):
        raise RoverError(f"{path}: no token of 16 letters or more is in it", remedy="provision the rover")
    return token


class View:
    """The web server of the view.

    address: where browsers reach it. place: the socket to which drives connect; None if a simulation is shown.
    drive_user: another user whose drives are accepted, besides this user's and root's. car: whose drives are shown;
    None means this machine's. ask: takes what a simulation's page asks for; None for a car. script: of such a page,
    after that of every page. Raises RoverError for an unknown user, and CarError and ParamsError like CarShape.of().
    """

    def __init__(
        self,
        address: Address,
        token: str,
        place: Path | None = None,
        drive_user: str | None = None,
        car: Car | None = None,
        ask: Callable[[str], object] | None = None,
        script: bytes = b"",
    ):
        self._address = address
        self._token = token
        self._place = place
        self._ask = ask
        self._users = {0, os.geteuid()}
        if drive_user:
            try:
                self._users.add(pwd.getpwnam(drive_user).pw_uid)
            except KeyError:
                raise RoverError(f"no user {drive_user!r} is known here", remedy="provision the rover") from None
        self._open_to_all = drive_user is not None  # the socket; _accept() checks who connects
        car = car or this_car()
        self._shape = CarShape.of(car)
        self._pwm = car.pwm
        self._drives: list[socket.socket] = []  # the last one, the newest, is shown
        self._number = 0
        self._head: dict[str, Any] = {"phase": "no drive", "text": "no drive has come yet"}
        self._picture = b""
        self._news = asyncio.Event()
        self._strangers: dict[Any, None] = {}  # connections without a token, the oldest first
        self._html = PAGE.read_bytes().replace(b"</script>", script + b"</script>")

    async def run(
        self, opened: Callable[[str], object], beside: Callable[["View"], Awaitable[object]] | None = None
    ) -> None:
        """Serve the view until SIGINT or SIGTERM.

        opened: called with the page's URL. beside: runs at the same time; an error in it ends the view and is raised.
        """
        ended = asyncio.Event()
        loop = asyncio.get_running_loop()
        for number in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(number, ended.set)
        async with contextlib.AsyncExitStack() as stack:
            opened(await self.open(stack))
            if beside:
                task = asyncio.ensure_future(beside(self))
                stack.push_async_callback(_end, task)
                task.add_done_callback(lambda task: None if task.cancelled() or not task.exception() else ended.set())
            await ended.wait()
            if beside and task.done():
                task.result()

    async def open(self, stack: contextlib.AsyncExitStack) -> str:
        """Start serving, until the stack is closed, and return the page's URL. Raises RoverError."""
        app = web.Application(middlewares=[self._guard], client_max_size=1024)
        app.router.add_get("/", self._give_page)
        app.router.add_get("/ws", self._talk)
        silent = logging.getLogger(f"{__name__}.library")
        silent.disabled = True  # it would write whole requests into the log, with the token and as often as they come
        asyncio.get_running_loop().set_exception_handler(lambda *_: None)
        runner = web.AppRunner(app, access_log=None, handle_signals=False, shutdown_timeout=0.5, logger=silent)
        wire = self._address.open()
        stack.callback(wire.close)
        if self._place:
            drives = self._listen(self._place)
            stack.callback(self._place.unlink, missing_ok=True)
            stack.callback(drives.close)
            stack.push_async_callback(_end, asyncio.create_task(self._accept(drives)))
        await runner.setup()
        stack.push_async_callback(runner.cleanup)
        loop = asyncio.get_running_loop()
        listening = await loop.create_server(lambda: self._meet(runner), sock=wire, backlog=64)
        stack.callback(listening.close)
        name = f"{socket.gethostname()}.local" if self._address.interface else "127.0.0.1"
        return f"http://{name}:{wire.getsockname()[1]}/?token={self._token}"

    def show(self, head: dict[str, Any], picture: bytes) -> None:
        """Show this on the pages from now on. head: a message as in feed.py. picture: a JPEG, or empty for none."""
        self._number += 1
        pins = head.get("pins")
        if pins and None in pins:
            pins = None
        plan = head.pop("plan", None)
        ribbon: list[tuple[float, float, float, float]] = []
        if plan and "size" in head:
            (width, height), rate_hz = head["size"], plan["rate_hz"]
            now = max(0, round((head["sent_s"] - plan["captured_s"]) * rate_hz))
            ribbon = self._shape.ribbon(plan["actions"][now : now + round(rate_hz)], 1 / rate_hz, width / height)
        means = throttled_means((head.get("machine") or {}).get("throttled"))
        channels = self._pwm.steering, self._pwm.throttle
        head |= {"n": self._number, "ribbon": ribbon, "left": self._shape.left, "pins": pins}
        head |= {
            "pins_actions": pins and [c.action(us) or 0.0 for c, us in zip(channels, pins, strict=True)],
            "stopped": pins is not None and abs(pins[1] - self._pwm.throttle.neutral_us) <= ARDUINO_STEP_US,
            "throttled": ", ".join(means) if means else "",
        }
        self._head = head
        self._picture = picture
        self._news.set()
        self._news = asyncio.Event()

    def stop(self, who: str) -> int:
        """Ask each drive to stop, and return how many were asked. who: the IP address that asks."""
        if self._ask:
            self._ask("stop")
            return 1
        count = 0
        for drive in tuple(self._drives):
            with contextlib.suppress(OSError):  # this drive no longer reads
                drive.send(f"stop {who}".encode())
                count += 1
        return count

    def _listen(self, place: Path) -> socket.socket:
        if is_listened_at(place) or (place.exists() and not place.is_socket()):
            raise RoverError(f"{place}: another view listens there, or a file lies there", remedy="give --feed")
        place.parent.mkdir(parents=True, exist_ok=True)
        place.unlink(missing_ok=True)  # left by a view that was killed
        wire = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_NONBLOCK)
        try:
            wire.bind(str(place))
            place.chmod(0o666 if self._open_to_all else 0o600)
            wire.listen(4)
        except OSError as error:
            wire.close()
            raise RoverError(f"{place}: no drive could reach a view there ({error})", remedy="give --feed") from None
        return wire

    async def _accept(self, wire: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        tasks = set()
        while True:
            try:
                drive, _ = await loop.sock_accept(wire)
            except OSError:  # no file is left for it now
                await asyncio.sleep(AGAIN_S)
                continue
            _, uid, _ = struct.unpack("3i", drive.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
            if uid not in self._users:
                drive.close()
                continue
            tasks.add(task := asyncio.create_task(self._hear(drive)))
            task.add_done_callback(tasks.discard)

    async def _hear(self, drive: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        self._drives.append(drive)
        phase = ""
        try:
            with contextlib.suppress(Exception):  # a message that makes no sense ends this connection, nothing else
                while data := await _received(loop, drive):
                    line, _, picture = data.partition(b"\n")
                    head = json.loads(line)
                    phase = head["phase"]
                    if drive is self._drives[-1]:
                        self.show(head, picture)
        finally:
            current = drive is self._drives[-1]
            self._drives.remove(drive)
            drive.close()
            if current and phase != "ended":
                text = "the drive has gone without a word; what the car does is not known"
                gone = {"phase": GONE, "text": text, "tick": None, "pins": None, "who": ""}
                self.show({**self._head, **gone}, self._picture)

    def _meet(self, runner: web.AppRunner) -> asyncio.Protocol:
        """Return a new connection's handler; without a token it has to leave soon, or as soon as many others come."""
        assert runner.server, "it was set up"
        loop = asyncio.get_running_loop()
        stranger = runner.server()
        self._strangers[stranger] = None
        loop.call_later(STRANGER_S, self._part, stranger)
        if len(self._strangers) > MOST_STRANGERS:
            oldest = next(iter(self._strangers))
            del self._strangers[oldest]
            loop.call_soon(oldest.force_close)  # not now: it may not be connected yet
        return stranger

    def _part(self, stranger: web.RequestHandler) -> None:
        if stranger in self._strangers:
            del self._strangers[stranger]
            stranger.force_close()

    @web.middleware
    async def _guard(self, request: web.Request, handler: Any) -> web.StreamResponse:
        if not hmac.compare_digest(request.query.get("token", "").encode(), self._token.encode()):
            return web.Response(status=403, text="this page needs its token: use the URL that `rover view` printed\n")
        self._strangers.pop(request.protocol, None)
        return await handler(request)

    async def _give_page(self, request: web.Request) -> web.Response:
        style, script = (_digest_of(tag, self._html) for tag in (b"style", b"script"))
        headers = {
            "Content-Security-Policy": f"default-src 'none'; style-src '{style}'; script-src '{script}'; "
            f"img-src blob:; connect-src ws://{request.host}; frame-ancestors 'none'; base-uri 'none'",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "Cache-Control": "no-store",
        }
        return web.Response(body=self._html, content_type="text/html", charset="utf-8", headers=headers)

    async def _talk(self, request: web.Request) -> web.StreamResponse:
        page = _Page()
        wire = web.WebSocketResponse(heartbeat=BEAT_S, max_msg_size=64, compress=False)
        await wire.prepare(request)
        sending = asyncio.create_task(self._send(wire, page))
        try:
            async for message in wire:
                if message.type != WSMsgType.TEXT:
                    break
                if message.data == "stop":
                    count = self.stop(request.remote or "0.0.0.0")
                    await wire.send_str("asked for a stop" if count else "no drive is there to be stopped")
                elif match := SHOWN.fullmatch(message.data):
                    page.was_shown(int(match[1]))
                elif self._ask and (question := ASKED.fullmatch(message.data)):
                    self._ask(question[1])
        finally:
            await _end(sending)
        return wire

    async def _send(self, wire: web.WebSocketResponse, page: "_Page") -> None:
        with contextlib.suppress(ConnectionError):
            while True:
                while page.sent == self._number:
                    await self._news.wait()
                page.sent = self._number
                page.captured_s = self._head.get("captured_s")
                page.showing.clear()
                head = json.dumps(self._head | {"n": page.sent, "delay_ms": page.delay_ms})
                await wire.send_bytes(head.encode() + b"\n" + self._picture)
                await page.showing.wait()


class _Page:
    """One page. sent: number of the last message. showing: set while the page shows it. captured_s: of its picture.

    delay_ms: from the capture of its last picture until it said that it shows it.
    """

    def __init__(self) -> None:
        self.sent = -1
        self.captured_s: float | None = None
        self.delay_ms: float | None = None
        self.showing = asyncio.Event()

    def was_shown(self, number: int) -> None:
        if number == self.sent:
            self.delay_ms = round((time.monotonic() - self.captured_s) * 1e3, 1) if self.captured_s else None
            self.showing.set()


def _digest_of(tag: bytes, html: bytes) -> str:
    """Return the digest of the page's style or script; the browser may apply and run no others."""
    part = re.search(rb"<%s>(.*?)</%s>" % (tag, tag), html, re.S)
    assert part, "view.html has one of each"
    return f"sha256-{base64.b64encode(hashlib.sha256(part[1]).digest()).decode()}"


async def _received(loop: asyncio.AbstractEventLoop, drive: socket.socket) -> bytes:
    """Return the drive's next message, b"" at the end."""
    with contextlib.suppress(ConnectionResetError):  # it closed with a second stop unread; its last message is here
        return await loop.sock_recv(drive, MESSAGE_BYTES)
    return await loop.sock_recv(drive, MESSAGE_BYTES)


async def _end(task: asyncio.Future) -> None:
    task.cancel()
    with contextlib.suppress(asyncio.CancelledError, Exception):
        await task

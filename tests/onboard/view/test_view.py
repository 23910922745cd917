"""The view's server, by the page's own protocol: who may look and stop, and that nothing else can be asked."""

import asyncio
import contextlib
import json
import os
import resource
import socket
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

aiohttp = pytest.importorskip("aiohttp", reason="needs the extra look")

from rover_lib.onboard.car.car import Car  # noqa: E402
from rover_lib.onboard.view import server as v  # noqa: E402

TOKEN = "a-token-of-the-tests"
JPEG = b"\xff\xd8 a picture \n \xff\xd9"
HEAD = {"phase": "driving", "text": "", "title": "policy.pt", "sent_s": 10.1, "who": "A", "why": "",
        "pins": [1456, 150], "tick": {"steering": 0.2, "throttle": 0.05},
        "machine": {"temperature_c": 61.0, "throttled": "0x50000"},
        "events": [[1.0, "armed"]], "frame": 7, "captured_s": 10.0, "size": [640, 360],
        "plan": {"captured_s": 10.0, "rate_hz": 30.0, "actions": [[0.1, 0.09]] * 32}}  # fmt: skip


class Drive:
    """The other end of a feed."""

    def __init__(self, place):
        self.wire = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.wire.connect(str(place))
        self.wire.setblocking(False)

    def send(self, head=HEAD, picture=JPEG):
        self.wire.send(json.dumps(head).encode() + b"\n" + picture)

    async def asked(self):
        """The next that the view asks."""
        return await asyncio.wait_for(asyncio.get_running_loop().sock_recv(self.wire, 1000), 5)

    def asked_nothing(self):
        with contextlib.suppress(BlockingIOError):
            return self.wire.recv(1000) == b""
        return True


class Bench:
    """A view, a browser, and drives; everything is closed with the context."""

    def __init__(self, folder, **options):
        self.place = folder / "view"
        self.view = v.View(v.Address(0), TOKEN, self.place, **options)
        self.stack = contextlib.AsyncExitStack()

    async def __aenter__(self):
        self.url = await self.view.open(self.stack)
        self.base = self.url.partition("/?")[0]
        self.browser = await self.stack.enter_async_context(aiohttp.ClientSession())
        return self

    async def __aexit__(self, *exc):
        await self.stack.aclose()

    def drive(self):
        drive = Drive(self.place)
        self.stack.callback(drive.wire.close)
        return drive

    async def page(self):
        return await self.browser.ws_connect(f"{self.base}/ws?token={TOKEN}")


def on_a_bench(test):
    """Run an async test with an open bench, its argument."""

    def run(tmp_path):
        async def scene():
            async with Bench(tmp_path) as bench:
                await test(bench)

        asyncio.run(scene())

    run.__name__, run.__doc__ = test.__name__, test.__doc__
    return run


async def message(page, shown=True):
    """The next whole message of a page: its head, and its picture."""
    while (got := await asyncio.wait_for(page.receive(), 5)).type != aiohttp.WSMsgType.BINARY:
        assert got.type == aiohttp.WSMsgType.TEXT, got
    line, _, picture = got.data.partition(b"\n")
    head = json.loads(line)
    if shown:
        await page.send_str(f"shown {head['n']}")
    return head, picture


async def driving(page):
    """The first message of a drive."""
    while (found := await message(page))[0]["phase"] != "driving":
        pass
    return found


@on_a_bench
async def test_a_page_shows_what_the_drive_says(bench):
    page = await bench.page()
    assert (await message(page))[0]["phase"] == "no drive"
    drive = bench.drive()
    drive.send()
    head, picture = await driving(page)
    assert picture == JPEG and head["n"] == 1
    assert all(head[name] == HEAD[name] for name in ("title", "who", "pins", "tick", "events"))
    assert head["throttled"] == "under-voltage since the start, throttled since the start"
    ahead = [[0.1, 0.09]] * (32 - 3)  # less the plan's actions of before it was sent
    assert head["ribbon"] == [[*points] for points in v.CarShape.of().ribbon(ahead, 1 / 30, 640 / 360)] != []
    assert not head["stopped"]
    assert head["pins_actions"][1] == pytest.approx(0.05, abs=0.01)
    drive.send(HEAD | {"phase": "ended", "pins": [1456, 120], "plan": None}, b"")
    head, picture = await message(page)
    assert picture == b"" and head["stopped"] and head["ribbon"] == [] and head["delay_ms"] is not None
    steering = {"period_us": 20000, "left_us": 2000, "neutral_us": 1500, "right_us": 1000}
    throttle = {"period_us": 20000, "forward_us": 2000, "neutral_us": 1500, "reverse_us": 1000}
    view = v.View(v.Address(0), TOKEN, car=Car.of({"steering": steering, "throttle": throttle}))
    for throttle_us, stands in ((120, False), (1500, True), (1440, False), (1503, True)):
        view.show(HEAD | {"pins": [1500, throttle_us]}, b"")
        assert view._head["stopped"] is stands


@on_a_bench
async def test_who_may_not_look_gets_a_sentence_and_reaches_no_drive(bench):
    drive = bench.drive()
    drive.send()
    for path in ("/", f"/?token={TOKEN}x", "/ws", "/ws?token=wrong"):
        async with bench.browser.get(bench.base + path) as answer:
            assert answer.status == 403
            text = await answer.text()
            assert len(text.splitlines()) == 1 and TOKEN not in text and "policy.pt" not in text
    async with bench.browser.post(f"{bench.base}/stop?token={TOKEN}") as answer:
        assert answer.status == 404
    assert drive.asked_nothing()

    async with bench.browser.get(bench.url) as answer:
        assert answer.status == 200 and answer.headers["Referrer-Policy"] == "no-referrer"
        policy = answer.headers["Content-Security-Policy"]
        for part in ("default-src 'none'", "frame-ancestors 'none'", f"connect-src ws://{bench.base[7:]};"):
            assert part in policy
        assert TOKEN not in await answer.text()


@on_a_bench
async def test_a_stop_from_each_page_reaches_each_drive_and_the_newest_is_shown(bench):
    pages = [await bench.page() for _ in range(3)]
    first, second = bench.drive(), bench.drive()
    for page in pages:
        second.send(HEAD | {"title": "second"})
        first.send(HEAD | {"title": "first"})
        while (await message(page))[0].get("title") != "second":
            pass
        await page.send_str("stop")
        assert await first.asked() == await second.asked() == b"stop 127.0.0.1"
    first.wire.close()
    second.wire.close()
    while (await message(page))[0]["phase"] != v.GONE:
        pass
    await page.send_str("stop")
    assert "no drive" in (await asyncio.wait_for(page.receive(), 5)).data


@on_a_bench
async def test_idle_connections_cost_no_page_and_no_drive_its_file(bench):
    """376 of them, which never show a token, took all files: no page opened, and no stop was heard."""
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    host, _, port = bench.base.removeprefix("http://").partition(":")
    page = await bench.page()
    taken = len([*Path("/proc/self/fd").iterdir()])
    idle = [socket.socket() for _ in range(120)]
    resource.setrlimit(resource.RLIMIT_NOFILE, (taken + 120 + 100, limits[1]))
    try:
        for wire in idle:
            wire.setblocking(False)
            wire.connect_ex((host, int(port)))
        most = taken + 120 + v.MOST_STRANGERS + 5
        async with asyncio.timeout(10):
            while len(bench.view._strangers) < v.MOST_STRANGERS or len([*Path("/proc/self/fd").iterdir()]) > most:
                await asyncio.sleep(0.05)
        drive, later = bench.drive(), await bench.page()
        drive.send()
        for each in (page, later):
            await driving(each)
            await each.send_str("stop")
            assert (await drive.asked()).startswith(b"stop ")
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)
        for wire in idle:
            wire.close()


@on_a_bench
async def test_who_shows_no_token_has_to_leave(bench):
    host, _, port = bench.base.removeprefix("http://").partition(":")
    reader, writer = await asyncio.open_connection(host, int(port))
    assert await asyncio.wait_for(reader.read(), 5) == b""
    writer.close()


@on_a_bench
async def test_a_page_can_say_nothing_else(bench):
    drive, page = bench.drive(), await bench.page()
    for said in ("arm", "STOP", "stop ", "shown -1", '{"ask": "arm"}'):
        drive.send()
        await driving(page)
        await page.send_str(said)
        drive.send()
        await message(page)  # it goes on
        assert drive.asked_nothing(), said
    await page.send_bytes(b"stop")  # no page of ours says this
    while (got := await asyncio.wait_for(page.receive(), 5)).type == aiohttp.WSMsgType.BINARY:
        pass
    assert got.type in (aiohttp.WSMsgType.CLOSE, aiohttp.WSMsgType.CLOSED)
    assert drive.asked_nothing()


@on_a_bench
async def test_nothing_waits_for_a_page_that_is_slow(bench):
    drive = bench.drive()
    slow, quick = await bench.page(), await bench.page()
    await message(slow, shown=False)
    await message(quick)
    for number in range(1, 40):
        drive.send(HEAD | {"frame": number})
        assert (await message(quick))[0]["frame"] == number
    with pytest.raises(asyncio.TimeoutError):
        await asyncio.wait_for(slow.receive(), 0.05)
    await slow.send_str("shown 0")
    head, _ = await message(slow)
    assert head["frame"] == 39  # the newest, and none of those between
    await slow.send_str("stop")
    assert await drive.asked() == b"stop 127.0.0.1"


@on_a_bench
async def send_what_is_broken(bench):
    for broken in (b"GET /?token=%s HTTP/9.x\r\n\r\n", b"%s" * 9000, b"POST /?token=%s"):
        reader, writer = await asyncio.open_connection("127.0.0.1", int(bench.base.rpartition(":")[2]))
        writer.write(broken.replace(b"%s", TOKEN.encode()) + b"\r\nContent-Length: x\r\n\r\n")
        with contextlib.suppress(ConnectionResetError):  # it need not read all of it
            await asyncio.wait_for(reader.read(), 5)
        writer.close()


def test_no_token_is_in_the_log(tmp_path, caplog, capsys):
    caplog.set_level("DEBUG", "aiohttp")
    send_what_is_broken(tmp_path)
    assert TOKEN not in caplog.text + "".join(capsys.readouterr())


@on_a_bench
async def test_a_second_click_hides_no_end(bench):
    """A drive that has ended closes its socket with the second stop unread."""
    page, drive = await bench.page(), bench.drive()
    drive.send()
    await driving(page)
    for _ in range(2):
        await page.send_str("stop")
        await page.receive()
    assert await drive.asked() == b"stop 127.0.0.1"
    drive.send(HEAD | {"phase": "ended", "text": "stopped from the view", "pins": [1456, 120]})
    drive.wire.close()
    head, _ = await message(page)
    assert (head["phase"], head["stopped"]) == ("ended", True)


NONSENSE = [b"[]\n", b"no json\n" + JPEG, b"[" * 100_000 + b"\n", b'{"phase": "driving", "pins": [1, 2, 3]}\n']


@on_a_bench
async def test_a_drive_that_talks_nonsense_ends_nothing_but_its_own_line(bench):
    for number, said in enumerate(NONSENSE):
        bench.drive().wire.send(said)
        page, drive = await bench.page(), bench.drive()
        for _ in range(20):
            drive.send(HEAD | {"frame": 77 + number})
            if (await message(page))[0].get("frame") == 77 + number:
                break
        else:
            raise AssertionError(f"the drive after {said[:30]!r} is not shown")
        await page.send_str("stop")
        assert await drive.asked() == b"stop 127.0.0.1"


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to be somebody else")
def test_another_user_feeds_nothing():
    script = "import os, socket, sys; os.setuid(65534); s = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)\n"
    script += "s.connect(sys.argv[1]); s.settimeout(5); print(s.recv(10))"

    async def scene():
        async with Bench(folder, drive_user="daemon") as bench:
            command = [sys.executable, "-c", script, str(bench.place)]
            done = await asyncio.to_thread(subprocess.run, command, capture_output=True, text=True, timeout=20)
            assert done.stdout == "b''\n" or "reset" in done.stderr.lower(), done  # closed at once
            assert bench.view.stop("127.0.0.1") == 0

    with tempfile.TemporaryDirectory() as name:  # not tmp_path, which lies below folders that are this user's alone
        folder = Path(name)
        folder.chmod(0o755)
        asyncio.run(scene())


def test_what_cannot_be_opened(tmp_path):
    async def both():
        async with Bench(tmp_path) as bench:
            assert (bench.place.stat().st_mode & 0o777) == 0o600
            with pytest.raises(v.RoverError):
                async with Bench(tmp_path):
                    pass
            with pytest.raises(v.RoverError):
                v.Address(int(bench.base.rpartition(":")[2])).open()

    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as left:  # by a view that was killed
        left.bind(str(tmp_path / "view"))
    asyncio.run(both())
    (tmp_path / "view").write_text("a user's")
    with pytest.raises(v.RoverError):
        asyncio.run(both())
    assert (tmp_path / "view").read_text() == "a user's"
    with pytest.raises(v.RoverError, match="nobody-of-that-name"):
        v.View(v.Address(0), TOKEN, drive_user="nobody-of-that-name")


def test_a_token_is_kept_and_one_that_could_be_guessed_is_refused(tmp_path):
    (tmp_path / "token").write_text(f"{TOKEN}\n")
    assert v.read_token(tmp_path / "token") == TOKEN
    for content in ("short", "with a blank in the middle", "ä" * 20):
        (tmp_path / "token").write_text(content)
        with pytest.raises(v.RoverError):
            v.read_token(tmp_path / "token")

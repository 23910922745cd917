"""The status line: on a terminal, elsewhere, and where nobody reads it."""

import io
import logging
import os
import pty
import select
import subprocess
import sys
import time

import pytest
from needs import until

from rover_lib.onboard.status_line import StatusLine


def record(text):
    return logging.makeLogRecord({"msg": text})


@pytest.fixture
def terminal():
    """A pty's stream, and a function that returns all that was written to it, or leaves it there if not called."""
    master, slave = pty.openpty()
    seen = []

    def read():
        while select.select([master], [], [], 0)[0]:
            seen.append(os.read(master, 65536).decode())
        return "".join(seen)

    with os.fdopen(slave, "w") as stream:
        yield stream, read
    os.close(master)


def test_a_terminal_has_one_line_that_is_overwritten(terminal):
    stream, read = terminal
    count = iter(range(1000))
    with StatusLine(lambda: f"tick {next(count)} " + "x" * 300, stream, every_s=0.02) as status:
        until(lambda: "tick 3" in read())
        status.handle(record("camera unplugged"))
        until(lambda: "camera unplugged" in read())
    assert read().count("\n") == 2  # the record's, and the end's
    assert "\r\x1b[Kcamera unplugged\r\n" in read() and read().endswith("\n")
    assert all(len(part) <= 80 for part in read().replace("\x1b[K", "").split("\r"))


def test_elsewhere_it_is_a_plain_line_now_and_then():
    with StatusLine(lambda: "all well", stream := io.StringIO(), every_s=0.02) as status:
        until(lambda: stream.getvalue().count("all well\n") >= 2)
        status.handle(record("camera unplugged"))
        until(lambda: "camera unplugged\n" in stream.getvalue())
    assert not set("\r\x1b") & set(stream.getvalue()) and stream.getvalue().endswith("all well\n")


@pytest.mark.slow
def test_a_program_ends_though_its_terminal_is_stuck():
    code = (
        "import logging, time\n"
        "from rover_lib.onboard.status_line import StatusLine\n"
        "with StatusLine(lambda: 'x' * 3000, every_s=0.001) as status:\n"
        "    time.sleep(0.3)\n"
        "    for _ in range(1000):\n"
        "        status.handle(logging.makeLogRecord({'msg': 'y' * 500}))\n"
        "    print('stuck', flush=True)\n"
        "print('ended', time.monotonic(), flush=True)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"stuck\n"
        start = time.monotonic()
        assert process.wait(10) == 0  # nobody read its errors until now
        assert time.monotonic() - start < 3

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


class Terminal:
    """A pty: what is written to `stream` can be read, or left there until the kernel takes no more."""

    def __init__(self):
        self.master, slave = pty.openpty()
        self.stream = os.fdopen(slave, "w")
        self.seen = ""

    def read(self):
        while select.select([self.master], [], [], 0)[0]:
            self.seen += os.read(self.master, 65536).decode()
        return self.seen

    def close(self):
        self.stream.close()
        os.close(self.master)


@pytest.fixture
def terminal():
    terminal = Terminal()
    yield terminal
    terminal.close()


def test_a_terminal_has_one_line_that_is_written_over(terminal):
    count = iter(range(1000))
    with StatusLine(lambda: f"tick {next(count)} " + "x" * 300, terminal.stream, every_s=0.02) as status:
        until(lambda: "tick 3" in terminal.read())
        status.say("camera unplugged")
        until(lambda: "camera unplugged" in terminal.read())
    text = terminal.read()
    assert text.count("\n") == 2  # what was said, and the end
    assert "\r\x1b[Kcamera unplugged\r\n" in text
    assert all(len(part) <= 80 for part in text.replace("\x1b[K", "").split("\r"))
    assert text.endswith("\n")


def test_elsewhere_it_is_a_plain_line_now_and_then():
    stream = io.StringIO()
    with StatusLine(lambda: "all well", stream, plain_every_s=0.05) as status:
        until(lambda: stream.getvalue().count("all well\n") >= 2)
        status.say("camera unplugged")
        until(lambda: "camera unplugged\n" in stream.getvalue())
    assert not set("\r\x1b") & set(stream.getvalue())
    with StatusLine(lambda: "all well", stream := io.StringIO()):
        time.sleep(0.05)
    assert stream.getvalue() == "all well\n"  # at its end


def test_log_records_go_above_the_line(terminal):
    logger = logging.getLogger("rover.test")
    logger.propagate = False
    with StatusLine(lambda: "status", terminal.stream, every_s=0.02) as status:
        logger.addHandler(status.handler)
        try:
            logger.warning("camera %s", "unplugged")
            until(lambda: "\r\x1b[Kcamera unplugged\r\n" in terminal.read())
        finally:
            logger.removeHandler(status.handler)


@pytest.mark.slow
def test_a_stuck_terminal_holds_up_nobody(terminal):
    with StatusLine(lambda: "x" * 70, terminal.stream, every_s=0.0001) as status:
        until(lambda: not select.select([], [terminal.stream.fileno()], [], 0)[1])  # nobody reads it
        start = time.monotonic()
        for _ in range(1000):
            status.say("camera unplugged")
        assert time.monotonic() - start < 0.2
        status.close()
        assert time.monotonic() - start < 1


@pytest.mark.slow
def test_a_pipe_that_blocks_holds_up_nobody():
    reading, writing = os.pipe()
    with os.fdopen(writing, "w") as stream:
        with StatusLine(lambda: "x" * 3000, stream, plain_every_s=0.0001) as status:
            until(lambda: not select.select([], [writing], [], 0)[1])
            start = time.monotonic()
            status.close()
            assert time.monotonic() - start < 1
        os.close(reading)  # lets go of the thread, with EPIPE
        status._thread.join(5)
        assert not status._thread.is_alive()


def test_a_status_that_raises_and_a_reader_that_leaves():
    stream = io.StringIO()
    with StatusLine(lambda: 1 / 0, stream, plain_every_s=0.01):
        until(lambda: "no status: ZeroDivisionError" in stream.getvalue())
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "w") as stream, StatusLine(lambda: "x", stream, plain_every_s=0.01) as status:
        status._thread.join(5)
        assert not status._thread.is_alive()
        status.say("nobody hears")


@pytest.mark.slow
def test_a_program_ends_though_its_terminal_is_stuck(tmp_path):
    code = (
        "import logging, sys, time\n"
        "from rover_lib.onboard.status_line import StatusLine\n"
        "from rover_lib.onboard.drive.flight_log import FlightLog\n"
        "with StatusLine(lambda: 'x' * 3000, plain_every_s=0.001) as status:\n"
        "    logging.getLogger('rover').addHandler(status.handler)\n"
        "    with FlightLog(sys.argv[1], header={}, max_bytes=1_000_000, keep=2) as log:\n"
        "        for k in range(100):\n"
        "            log.event('y' * 500, level=logging.WARNING)\n"
        "        time.sleep(0.3)\n"
        "        print('stuck', flush=True)\n"
        "print('ended', time.monotonic(), flush=True)\n"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "flight.log")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout.readline() == b"stuck\n"
        start = time.monotonic()
        assert process.wait(10) == 0  # nobody read its errors until now
        assert time.monotonic() - start < 3

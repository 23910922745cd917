"""The status line: on a terminal, elsewhere, and where nobody reads it."""

import logging
import os
import pty
import select
import subprocess
import sys
import time

import pytest

from rover_lib.onboard.status_line import StatusLine


def record(text):
    return logging.makeLogRecord({"msg": text})


def test_a_terminal_has_one_line_that_is_overwritten():
    master, slave = pty.openpty()
    seen = ""
    with os.fdopen(slave, "w") as stream:
        with StatusLine(lambda: "tick " + "x" * 300, stream, every_s=0.02) as status:
            time.sleep(0.2)
            status.handle(record("camera unplugged"))
        while select.select([master], [], [], 0.1)[0]:
            seen += os.read(master, 65536).decode()
    os.close(master)
    assert seen.count("\n") == 2  # the record's, and the end's
    assert "\r\x1b[Kcamera unplugged\r\n" in seen and seen.count("\r\x1b[Ktick") > 2
    assert all(len(part) <= 80 for part in seen.replace("\x1b[K", "").split("\r"))


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

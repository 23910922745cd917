"""The status line: on a terminal, elsewhere, and where nobody reads it."""

import subprocess
import sys
import time

import pytest


@pytest.mark.slow
def test_a_program_ends_though_its_terminal_is_stuck():
    code = (
        "import logging, time\n"
        "from rover_lib.onboard import status_line\n"
        "status_line.PLAIN_EVERY_S = 0.001\n"
        "with status_line.StatusLine(lambda: 'x' * 3000) as status:\n"
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

"""A `rover` command that serves pages, and a real browser beside it."""

import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from playwright.sync_api import Browser, expect, sync_playwright

CHROMIUM = shutil.which("chromium")
chromium = pytest.mark.skipif(not CHROMIUM, reason="needs the Debian package chromium")
PATIENT_MS = 120_000  # this machine may be busy


@contextmanager
def served_to_a_browser(*words: object, **streams: int) -> Iterator[tuple[subprocess.Popen, Browser]]:
    """Yield the running command, which is killed at the end, and the browser. streams: which of its own are piped."""
    expect.set_options(timeout=PATIENT_MS)
    command = [sys.executable, "-m", "rover_lib.cli", *map(str, words)]
    with (
        subprocess.Popen(command, text=True, **streams) as served,
        sync_playwright() as driver,
        driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"]) as browser,
    ):
        try:
            yield served, browser
        finally:
            served.kill()  # JupyterLab asks before it ends

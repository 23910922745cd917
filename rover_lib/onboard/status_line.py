"""The status line, for people. A thread of its own writes it, so that it never holds up the drive."""

import contextlib
import logging
import os
import queue
import shutil
import sys
import threading
from collections.abc import Callable

EVERY_S, PLAIN_EVERY_S = 0.25, 10.0  # on a terminal, and elsewhere
QUEUE_LINES = 256
CLOSE_S = 0.5  # longest wait for a terminal that was stopped


class StatusLine(logging.Handler):
    """One line of status (what callback returns) on standard error, overwritten on a terminal, inside the context.

    As a handler, it shows log records above it; of a terminal that was stopped, some are lost.
    """

    def __init__(self, callback: Callable[[], str]):
        super().__init__()
        self._callback = callback
        self._terminal = sys.stderr.isatty()
        self._every_s = EVERY_S if self._terminal else PLAIN_EVERY_S
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()  # None: the end
        self._thread = threading.Thread(target=self._run, name="status line", daemon=True)

    def __enter__(self) -> "StatusLine":
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._lines.put(None)
        self._thread.join(CLOSE_S)

    def emit(self, record: logging.LogRecord) -> None:
        if self._lines.qsize() < QUEUE_LINES:
            self._lines.put(self.format(record))

    def _run(self) -> None:
        line: str | None = ""
        while line is not None:
            try:
                line = self._lines.get(timeout=self._every_s)
                text = f"{self._status() if line is None else line}\n"
            except queue.Empty:
                text = self._status() + ("" if self._terminal else "\n")
            if self._terminal:
                text = f"\r\x1b[K{text}"
            with contextlib.suppress(OSError, ValueError):  # nobody reads standard error any more
                # Not through its buffer: if this thread got stuck with its lock, the program could not end.
                os.write(sys.stderr.fileno(), text.encode(errors="replace"))

    def _status(self) -> str:
        text = self._callback()
        return text[: shutil.get_terminal_size().columns - 1] if self._terminal else text

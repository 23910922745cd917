"""The status line, for people. A thread of its own writes it, so that it never holds up the drive."""

import contextlib
import logging
import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import TextIO

QUEUE_LINES = 256


class StatusLine:
    """One line of status on a stream, written by a thread of its own inside the context.

        with StatusLine(lambda: f"{speed} m/s") as status:
            logging.getLogger("rover").addHandler(status.handler)

    callback: returns the status. On a terminal the line is overwritten 4 times a second; any other stream gets a new
    line every 10 s. Log records that go to `handler` appear above the status. Whoever logs them waits for nothing: if
    the terminal was stopped, they appear later or never.
    """

    def __init__(
        self,
        callback: Callable[[], str],
        stream: TextIO | None = None,
        *,
        every_s: float = 0.25,
        plain_every_s: float = 10.0,
    ):
        self._callback = callback
        self._stream = stream if stream is not None else sys.stderr
        self._terminal = self._stream.isatty()
        try:
            self._fd: int | None = self._stream.fileno()
        except (OSError, AttributeError):
            self._fd = None
        self._every_s = every_s if self._terminal else plain_every_s
        self._lines: deque[str] = deque(maxlen=QUEUE_LINES)
        self._wake = threading.Event()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="status line", daemon=True)
        self.handler: logging.Handler = _StatusHandler(self)

    def __enter__(self) -> "StatusLine":
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def say(self, text: str) -> None:
        """Write a line that stays, above the status. Waits for nothing."""
        self._lines.append(text)
        self._wake.set()

    def close(self) -> None:
        """Write what is left and end the thread. Waits half a second at most."""
        self._closing = True
        self._wake.set()
        self._thread.join(0.5)

    def _run(self) -> None:
        due_s = time.monotonic() + self._every_s
        while True:
            self._wake.wait(max(0.0, due_s - time.monotonic()))
            self._wake.clear()
            closing = self._closing
            text = "".join(f"{self._clear}{self._lines.popleft()}\n" for _ in range(len(self._lines)))
            due = time.monotonic() >= due_s
            if closing or due or self._terminal:
                text += self._status() + ("\n" if closing or not self._terminal else "")
            if due:
                due_s = time.monotonic() + self._every_s
            try:
                self._write(text)
            except (OSError, ValueError):  # nobody reads the stream any more
                return
            if closing:
                return

    @property
    def _clear(self) -> str:
        return "\r\x1b[K" if self._terminal else ""

    def _status(self) -> str:
        try:
            text = self._callback()
        except Exception as error:
            text = f"no status: {type(error).__name__}: {error}"
        if self._terminal and self._fd is not None:
            with contextlib.suppress(OSError):
                text = text[: (os.get_terminal_size(self._fd).columns or 80) - 1]
        return self._clear + text

    def _write(self, text: str) -> None:
        if self._fd is None:
            self._stream.write(text)
            self._stream.flush()
            return
        # Not through the stream's buffer: if this thread got stuck with its lock, the program could not end.
        data = text.encode(errors="replace")
        while data:
            data = data[os.write(self._fd, data) :]


class _StatusHandler(logging.Handler):
    def __init__(self, status: StatusLine):
        super().__init__()
        self._status = status

    def emit(self, record: logging.LogRecord) -> None:
        try:
            self._status.say(self.format(record))
        except Exception:  # logging expects of a handler that a bad record does not end the program
            self.handleError(record)

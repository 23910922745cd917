"""Start a process beside this one, talk to it and end it. Errors quote the last lines that it printed."""

import contextlib
import fcntl
import os
import select
import signal
import subprocess
import tempfile
from collections.abc import Mapping
from typing import Any

from rover_lib.onboard.errors import RoverError
from rover_lib.workshop.run_program import last_words

STOP_S = 5.0


class Child:
    """A program that runs until it is closed.

    A terminal's ^C does not reach it. pid: of its process. What it prints on standard error is kept for the errors.
    """

    def __init__(
        self,
        name: str,
        *command: object,
        error: type[RoverError] = RoverError,
        talks: bool = False,
        env: Mapping[str, str] | None = None,
    ):
        """Start the command.

        name: for errors, such as 'the virtual car'. error: the class to raise. talks: by its standard input, whose end
        tells it to end, and output; otherwise it has neither, and SIGTERM tells it. env: further variables.
        """
        self.name = name
        self._error = error
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115, open until close()
        words = [str(part) for part in command]
        stream = subprocess.PIPE if talks else subprocess.DEVNULL
        streams: dict[str, Any] = {"stdin": stream, "stdout": stream, "stderr": self._errors, "bufsize": 0}
        self.process = subprocess.Popen(words, env={**os.environ, **(env or {})}, start_new_session=True, **streams)
        self.pid = self.process.pid

    @property
    def running(self) -> bool:
        return self.process.poll() is None

    def wait(self, within_s: float) -> int | None:
        """Wait for the end; return the exit code, or None if the process has not ended within that time."""
        try:
            return self.process.wait(within_s)
        except subprocess.TimeoutExpired:
            return None

    def send_line(self, text: str) -> None:
        """Write a line to its standard input. Raises the error of ended() if nobody reads that any more."""
        try:
            assert self.process.stdin
            self.process.stdin.write(f"{text}\n".encode())
        except (OSError, ValueError):
            raise self.ended() from None

    def read(self, within_s: float = 0.0) -> bytes:
        """Return what it printed on standard output since the last call; b"" if nothing comes within that time.

        Raises the error of ended() if the process has ended and everything it printed has been read.
        """
        assert self.process.stdout
        try:
            if not select.select([self.process.stdout], [], [], within_s)[0]:
                return b""
            data = os.read(self.process.stdout.fileno(), 1 << 16)
        except (OSError, ValueError):  # closed meanwhile
            data = b""
        if not data:
            raise self.ended()
        return data

    def keep_unread(self, size: int) -> None:
        """Let its standard output hold up to `size` bytes that nobody has read yet."""
        assert self.process.stdout
        fcntl.fcntl(self.process.stdout, fcntl.F_SETPIPE_SZ, size)

    def errors(self) -> list[str]:
        """Return the lines that it has printed on standard error."""
        size = os.fstat(self._errors.fileno()).st_size
        return os.pread(self._errors.fileno(), size, 0).decode(errors="replace").splitlines()

    def ended(self) -> RoverError:
        """Return the error that says how the process ended. Waits up to 5 s for that, if it is just about to."""
        if self._errors.closed:
            return self._error(f"{self.name} was closed", remedy="make a new one")
        code = self.wait(STOP_S)
        words = last_words("\n".join(self.errors()))
        return self._error(f"{self.name} has ended (exit status {code}): {words}", remedy="start a new one")

    def close(self) -> None:
        """End the process, with SIGKILL if it does not end within 5 s. Raises nothing, and may be called again."""
        if self.process.stdin:
            with contextlib.suppress(OSError):
                self.process.stdin.close()
        elif self.running:
            self.process.send_signal(signal.SIGCONT)  # a stopped process would not notice SIGTERM
            self.process.terminate()
        if self.wait(STOP_S) is None:
            self.process.kill()
            self.process.wait()
        if self.process.stdout:
            self.process.stdout.close()
        self._errors.close()

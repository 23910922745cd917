"""Start a process beside this one, talk to it and end it. Errors quote the last lines that it printed."""

import contextlib
import fcntl
import os
import select
import signal
import subprocess
import tempfile
import time
from collections.abc import Mapping
from typing import IO, Any

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

        name: for errors, such as 'the virtual car'. error: the class to raise. talks: whether it talks by lines on its
        standard input and output; then the end of its input tells it to end. Otherwise it has neither, and SIGTERM
        tells it. env: variables in addition to this process's own.
        """
        self.name, self._error = name, error
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115, open until close()
        words, stream = [str(part) for part in command], subprocess.PIPE if talks else subprocess.DEVNULL
        streams: dict[str, Any] = {"stdin": stream, "stdout": stream, "stderr": self._errors, "bufsize": 0}
        environment = {**os.environ, **(env or {})}
        self.process = subprocess.Popen(words, env=environment, start_new_session=True, **streams)
        self.pid = self.process.pid

    @property
    def running(self) -> bool:
        """Whether the process has not ended yet."""
        return self.process.poll() is None

    def check(self) -> None:
        """Raise the error of ended() if the process is not running. Costs almost nothing."""
        if not self.running:
            raise self.ended()

    def wait(self, within_s: float) -> int | None:
        """Wait for the end; return the exit code, or None if the process has not ended within that time."""
        try:
            return self.process.wait(within_s)
        except subprocess.TimeoutExpired:
            return None

    def send_line(self, text: str) -> None:
        """Write a line to its standard input. Raises the error of ended() if nobody reads that any more."""
        try:
            self._pipe(self.process.stdin).write(f"{text}\n".encode())
        except (OSError, ValueError):
            raise self.ended() from None

    def read(self, within_s: float = 0.0) -> bytes:
        """Return what it printed on standard output since the last call; b"" if nothing comes within that time.

        Raises the error of ended() if the process has ended and everything it printed has been read.
        """
        output = self._pipe(self.process.stdout)
        try:
            if not select.select([output], [], [], within_s)[0]:
                return b""
            data = os.read(output.fileno(), 1 << 16)
        except (OSError, ValueError):  # closed meanwhile
            data = b""
        if not data:
            raise self.ended()
        return data

    def read_line(self, within_s: float) -> str:
        """Return the next line that it prints; what comes of it within that time, if its end does not.

        An unbuffered Python writes a line and its end apart, so read() may return them one after the other.
        """
        line, end_s = b"", time.monotonic() + within_s
        while not line.endswith(b"\n") and (left_s := end_s - time.monotonic()) > 0:
            line += self.read(left_s)
        return line.decode()

    def keep_unread(self, size: int) -> None:
        """Let its standard output hold up to `size` bytes that nobody has read yet."""
        fcntl.fcntl(self._pipe(self.process.stdout), fcntl.F_SETPIPE_SZ, size)

    def errors(self) -> list[str]:
        """Return the lines that it has printed on standard error."""
        size = os.fstat(self._errors.fileno()).st_size
        return os.pread(self._errors.fileno(), size, 0).decode(errors="replace").splitlines()

    def last_words(self) -> str:
        """Return the last of these lines, joined to one."""
        return last_words("\n".join(self.errors()))

    def ended(self) -> RoverError:
        """Return the error that says how the process ended. Waits up to 5 s for that, if it is just about to."""
        if self._errors.closed:
            return self._error(f"{self.name} was closed", remedy="make a new one")
        code = self.wait(STOP_S)
        return self._error(f"{self.name} has ended (exit status {code}): {self.last_words()}", remedy="start a new one")

    def close(self) -> None:
        """End the process, with SIGKILL if it does not end within 5 s. Raises nothing, and may be called again."""
        if self.process.stdin:
            with contextlib.suppress(OSError):
                self.process.stdin.close()
        elif self.running:
            with contextlib.suppress(ProcessLookupError):
                self.process.send_signal(signal.SIGCONT)  # a stopped process would not notice SIGTERM
                self.process.terminate()
        if self.wait(STOP_S) is None:
            self.process.kill()
            self.process.wait()
        if self.process.stdout:
            self.process.stdout.close()
        self._errors.close()

    def _pipe(self, stream: IO[bytes] | None) -> IO[bytes]:
        assert stream is not None, f"{self.name} was not started with talks=True"
        return stream

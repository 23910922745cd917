"""A process beside this one: started, talked to and ended, with its last words in the errors."""

import contextlib
import fcntl
import os
import select
import signal
import subprocess
import tempfile
from collections.abc import Mapping
from typing import IO

from rover_lib.onboard.errors import RoverError
from rover_lib.workshop.program import last_words

STOP_S = 5.0


class Child:
    """A program that runs until it is closed.

    A terminal's ^C is not for it. pid: its process. What it prints on standard error is kept for the errors.
    """

    def __init__(
        self,
        name: str,
        *command: object,
        error: type[RoverError] = RoverError,
        talks: bool = False,
        env: Mapping[str, str] | None = None,
    ):
        """name: in errors, such as 'the virtual car'. error: what to raise.

        talks: by lines, on its standard input and output; the end of its input tells it to end. Otherwise it has
        neither, and SIGTERM tells it. env: variables beside this process's own.
        """
        self.name = name
        self._error = error
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115, open until close()
        stream = subprocess.PIPE if talks else subprocess.DEVNULL
        self.process: subprocess.Popen[bytes] = subprocess.Popen(
            [str(part) for part in command],
            env={**os.environ, **(env or {})},
            stdin=stream,
            stdout=stream,
            stderr=self._errors,
            bufsize=0,
            start_new_session=True,
        )
        self.pid = self.process.pid

    @property
    def running(self) -> bool:
        """Whether it has not ended yet."""
        return self.process.poll() is None

    def check(self) -> None:
        """Raises the error of ended() if it is not running. Costs nothing."""
        if not self.running:
            raise self.ended()

    def wait(self, within_s: float) -> int | None:
        """Its exit code; None if it has not ended by then."""
        try:
            return self.process.wait(within_s)
        except subprocess.TimeoutExpired:
            return None

    def send_line(self, text: str) -> None:
        """Writes a line to its standard input. Raises the error of ended() if nobody reads it any more."""
        try:
            self._pipe(self.process.stdin).write(f"{text}\n".encode())
        except (OSError, ValueError):
            raise self.ended() from None

    def read(self, within_s: float = 0.0) -> bytes:
        """What it has printed on standard output since the last call; b"" if nothing comes within that time.

        Raises the error of ended() once all is read of a process that has ended.
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

    def keep_unread(self, size: int) -> None:
        """Its standard output holds that many bytes that nobody has read yet."""
        fcntl.fcntl(self._pipe(self.process.stdout), fcntl.F_SETPIPE_SZ, size)

    def errors(self) -> list[str]:
        """The lines that it has printed on standard error."""
        size = os.fstat(self._errors.fileno()).st_size
        return os.pread(self._errors.fileno(), size, 0).decode(errors="replace").splitlines()

    def last_words(self) -> str:
        """The last of these lines, in one."""
        return last_words("\n".join(self.errors()))

    def ended(self) -> RoverError:
        """The error that says how it ended; waits for that if it is about to."""
        if self._errors.closed:
            return self._error(f"{self.name} was closed", remedy="make a new one")
        code = self.wait(STOP_S)
        return self._error(f"{self.name} has ended (exit status {code}): {self.last_words()}", remedy="start a new one")

    def close(self) -> None:
        """Ends it, with SIGKILL if it does not want to. Raises nothing, and may be called again."""
        if self.process.stdin:
            with contextlib.suppress(OSError):
                self.process.stdin.close()
        elif self.running:
            with contextlib.suppress(ProcessLookupError):
                self.process.send_signal(signal.SIGCONT)  # or it would not see the other
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

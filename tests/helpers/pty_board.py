"""An Arduino made of a pty and a thread, for tests of what speaks with one."""

import os
import pty
import select
import threading
import time
import tty
from contextlib import contextmanager

from rover_lib.onboard.car.car import Car
from rover_lib.onboard.car.protocol import frame

DEFAULT = Car().id

FIELDS = {
    "boot": 7, "ms": 999, "sequence": 0, "result": "k", "state": "M", "reason": "r", "missing": "-",
    "steering_us": 1456, "throttle_us": 120, "cap_us": 238,
}  # fmt: skip
STATUS_LINE = (
    "<S {boot} {ms} {sequence} {result} {state} {reason} {missing} {steering_us} {throttle_us} {cap_us} - - - - 0 0 0 0"
)


class Board:
    """The other end of a pty: says what it is told to, and records what the host says."""

    def __init__(self, hello=f"<H 4 4.2.0 7 0 e {DEFAULT}", answer=None):
        self.master, slave = pty.openpty()
        tty.setraw(slave)
        self.port = os.ttyname(slave)
        self._slave = slave
        self.heard: list[str] = []
        self.hello = hello
        self.answer = answer or (lambda board, body: None)
        self.reading = True
        self._closing = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        if hello:
            threading.Timer(0.1, self.greet).start()

    def greet(self):
        self.say(self.hello)
        self.status(result="-", boot=self.hello.split()[3] if self.hello.count(" ") == 5 else 7)

    def say(self, body):
        if not self._closing:
            os.write(self.master, frame(body))

    def status(self, state="M", reason="r", result="k", **fields):
        """Say a status line; fields: of the line, see FIELDS."""
        said = {"state": state, "reason": reason, "result": result, "sequence": self.sequence}
        assert fields.keys() <= FIELDS.keys()
        self.say(STATUS_LINE.format(**FIELDS | said | fields))

    @property
    def sequence(self):
        numbered = [int(b.split()[2]) for b in self.heard if b[1] not in "QS"]
        return numbered[-1] if numbered else 0

    def _run(self):
        pending = b""
        while not self._closing:
            if not self.reading or not select.select([self.master], [], [], 0.01)[0]:
                time.sleep(0.001)
                continue
            *lines, pending = (pending + os.read(self.master, 4096)).split(b"\n")
            for said in lines:
                body = said[said.rindex(b">") : -9].decode()  # as the firmware: a '>' starts a line
                assert said.endswith(frame(body)[:-1]), said
                self.heard.append(body)
                if body == ">Q" and self.hello:
                    self.greet()
                self.answer(self, body)

    def close(self):
        self._closing = True
        self._thread.join()
        os.close(self.master)
        os.close(self._slave)


def obedient(board, body):
    if body[1] == "A":
        board.status("A", "a")
    elif body[1] == "N":
        board.status("S", "n")
    elif body[1] == "D":
        board.status("A", "a", steering_us=body.split()[4], throttle_us=body.split()[5])


@contextmanager
def board_of(**options):
    board = Board(**options)
    try:
        yield board
    finally:
        board.close()

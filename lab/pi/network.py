"""Simulate the network between the laptop and a rover's sshd, so that it can be cut, go silent and garble its bytes.

with Network(pi) as network:
    playbooks.run("deploy", [network], ...)     # a host like the rover itself, with another port
    network.cut()
"""

import contextlib
import socket
import threading
from pathlib import Path

from lab.pi.playbooks import Host

AT_ONCE = 1 << 15  # bytes
CONNECT_S = 5.0


class Network:
    """Forwards a port of the loopback to a rover's; a context manager.

    name, port, key: make it a playbooks.Host. sent: how many bytes went to the rover so far, on all connections.
    """

    def __init__(self, pi: Host):
        self.name: str = pi.name
        self.key: Path = pi.key
        self.sent = 0
        self._pi = pi
        self._lock = threading.Lock()
        self._open: set[socket.socket] = set()
        self._cut = self._silent = False
        self._flip_after: int | None = None
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]

    def __enter__(self) -> "Network":
        threading.Thread(target=self._accept, name=f"network of {self.name}", daemon=True).start()
        return self

    def __exit__(self, *exc: object) -> None:
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._end_all()

    def cut(self) -> None:
        """End every connection now, and refuse new ones until mend()."""
        self._cut = True
        self._end_all()

    def silence(self) -> None:
        """Let nothing through any more, without ending a connection."""
        self._silent = True

    def flip(self, after: int = 0) -> None:
        """Flip one bit, once, of what goes to the rover, when `after` more bytes have gone there."""
        self._flip_after = self.sent + after

    def mend(self) -> None:
        """Restore the network, and end all earlier connections."""
        self._cut = self._silent = False
        self._flip_after = None
        self._end_all()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            try:
                if self._cut:
                    raise OSError
                far = socket.create_connection(("127.0.0.1", self._pi.port), CONNECT_S)
            except OSError:
                near.close()
                continue
            far.settimeout(None)
            with self._lock:
                self._open |= {near, far}
            for source, target in ((near, far), (far, near)):
                threading.Thread(target=self._carry, args=(source, target, target is far), daemon=True).start()

    def _carry(self, source: socket.socket, target: socket.socket, to_rover: bool) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(AT_ONCE):
                if self._silent:
                    continue
                target.sendall(self._counted(data) if to_rover else data)
        self._end(source, target)

    def _counted(self, data: bytes) -> bytes:
        with self._lock:
            self.sent += len(data)
            if self._flip_after is None or self.sent <= self._flip_after:
                return data
            self._flip_after = None
        return data[:-1] + bytes([data[-1] ^ 1])

    def _end_all(self) -> None:
        with self._lock:
            ended = list(self._open)
        self._end(*ended)

    def _end(self, *connections: socket.socket) -> None:
        for connection in connections:
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)  # wakes a thread that waits for it, which close() does not
            with self._lock:
                self._open.discard(connection)
            connection.close()

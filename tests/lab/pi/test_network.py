"""The network that can break, between two ends of this machine."""

import socket
import threading
from types import SimpleNamespace

import pytest

from lab.pi.network import Network


@pytest.fixture
def pi():
    """Answers what it is told, in capitals."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def answer(connection: socket.socket) -> None:
            with connection:
                while data := connection.recv(100):
                    connection.sendall(data.upper())

        def serve() -> None:
            while True:
                try:
                    connection, _ = server.accept()
                except OSError:
                    return
                threading.Thread(target=answer, args=(connection,), daemon=True).start()

        threading.Thread(target=serve, daemon=True).start()
        yield SimpleNamespace(name="pi", key=None, port=server.getsockname()[1])
        server.shutdown(socket.SHUT_RDWR)


def ask(connection: socket.socket, what: bytes) -> bytes:
    connection.settimeout(0.5)
    connection.sendall(what)
    return connection.recv(100)


def connected(network: Network) -> socket.socket:
    return socket.create_connection(("127.0.0.1", network.port), 5)


def test_it_carries_and_counts(pi):
    with Network(pi) as network, connected(network) as one, connected(network) as other:
        assert ask(one, b"abc") == b"ABC" and ask(other, b"de") == b"DE"
        assert network.sent == 5


def test_cut_ends_what_is_and_refuses_what_comes(pi):
    with Network(pi) as network, connected(network) as one:
        assert ask(one, b"abc") == b"ABC"
        network.cut()
        assert one.recv(100) == b""
        with connected(network) as another:
            another.settimeout(5)
            assert another.recv(100) == b""
        network.mend()
        with connected(network) as another:
            assert ask(another, b"abc") == b"ABC"


def test_silence_tells_nobody(pi):
    with Network(pi) as network, connected(network) as one:
        network.silence()
        with pytest.raises(TimeoutError):
            ask(one, b"abc")
        network.mend()
        assert one.recv(100) == b""
        with connected(network) as another:
            assert ask(another, b"abc") == b"ABC"


def test_one_bit_is_turned_once(pi):
    with Network(pi) as network, connected(network) as one:
        network.flip(after=4)
        assert [ask(one, b"aaa") for _ in range(3)] == [b"AAA", b"AA`", b"AAA"]


def test_nothing_listens_afterwards(pi):
    with Network(pi) as network:
        assert ask(connected(network), b"abc") == b"ABC"
    with pytest.raises(OSError):
        connected(network)

"""Simulate a USB camera: QEMU's usb-redir shows it to the machine as a UVC webcam that gives recorded JPEGs.

    with UsbCamera(jpegs, slow=10) as camera:
        pi.plug_camera(camera.path)         # /dev/video0 of the machine, by its kernel's uvcvideo

It speaks the usbredir protocol on a Unix socket, with one bulk endpoint for the video. A frame is one UVC payload.
"""

import contextlib
import select
import socket
import struct
import tempfile
import threading
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path

from rover_lib.onboard.errors import RoverError

VENDOR, PRODUCT = 0x1D6B, 0x0102  # the Linux Foundation's, for webcam gadgets
WIDTH, HEIGHT, RATE_HZ = 640, 360, 30
MAX_FRAME = WIDTH * HEIGHT * 2
ENDPOINT, PACKET = 0x81, 512
VIDEO, CONTROL_INTERFACE, STREAMING_INTERFACE = 14, 0, 1

# From usbredirproto.h
HELLO, CONNECT, INTERFACES, ENDPOINTS = 0, 1, 4, 5
SET_CONFIGURATION, GET_CONFIGURATION, CONFIGURATION = 6, 7, 8
SET_ALT, GET_ALT, ALT, CANCEL, CONTROL, BULK = 9, 10, 11, 21, 100, 101
CAPABILITIES = 1 << 1 | 1 << 4 | 1 << 5 | 1 << 6  # device version, packet sizes, 64-bit ids, long bulk packets
HEADER, FIRST_HEADER = struct.Struct("<IIQ"), struct.Struct("<III")  # greetings have the first
CONTROL_HEADER, BULK_HEADER = struct.Struct("<BBBBHHH"), struct.Struct("<BBHIH")
HIGH_SPEED, BULK_TYPE, NO_TYPE = 2, 2, 255
OK, CANCELLED, STALL = 0, 1, 4

# From the USB video class
GET_DESCRIPTOR, SET_CUR, GET_CUR, GET_LEN = 0x06, 0x01, 0x81, 0x85
PROBE = struct.Struct("<HBBIHHHHHII")
INTERVAL = 10_000_000 // RATE_HZ  # between frames, in units of 100 ns


def _descriptor(*content: int) -> bytes:
    return bytes([len(content) + 1, *content])


def _words(*values: int) -> bytes:
    return struct.pack(f"<{len(values)}I", *values)


def device_descriptor() -> bytes:
    """Return the device's descriptor: a composite device, whose interfaces say what it does."""
    return struct.pack("<BBHBBBBHHHBBBB", 18, 1, 0x0200, 0xEF, 2, 1, 64, VENDOR, PRODUCT, 0x0100, 1, 2, 0, 1)


def configuration_descriptor() -> bytes:
    """Return the descriptor of its only configuration: a camera, and an MJPEG stream of one size and rate."""
    camera = _descriptor(0x24, 0x02, 1, *(0x01, 0x02), 0, 0, *[0] * 6, 3, 0, 0, 0)
    screen = _descriptor(0x24, 0x03, 2, *(0x01, 0x01), 0, 1, 0)
    units = camera + screen
    control = _descriptor(0x24, 0x01, 0x00, 0x01, *(13 + len(units)).to_bytes(2, "little"), *_words(6_000_000), 1, 1)
    bits = WIDTH * HEIGHT * 16 * RATE_HZ
    size = struct.pack("<HH", WIDTH, HEIGHT)
    frame = _descriptor(0x24, 0x07, 1, 0, *size, *_words(bits, bits, MAX_FRAME, INTERVAL), 1, *_words(INTERVAL))
    formats = _descriptor(0x24, 0x06, 1, 1, 0, 1, 0, 0, 0, 0) + frame + _descriptor(0x24, 0x0D, 1, 1, 4)
    stream = _descriptor(0x24, 0x01, 1, *(14 + len(formats)).to_bytes(2, "little"), ENDPOINT, 0, 2, 0, 0, 0, 1, 0)
    body = _descriptor(0x0B, CONTROL_INTERFACE, 2, VIDEO, 3, 0, 0)
    body += _descriptor(0x04, CONTROL_INTERFACE, 0, 0, VIDEO, 1, 0, 0) + control + units
    body += _descriptor(0x04, STREAMING_INTERFACE, 0, 1, VIDEO, 2, 0, 0) + stream + formats
    body += _descriptor(0x05, ENDPOINT, BULK_TYPE, *PACKET.to_bytes(2, "little"), 0)
    return struct.pack("<BBHBBBBB", 9, 2, 9 + len(body), 2, 1, 0, 0x80, 250) + body


STRINGS = {0: b"\x09\x04", 1: "rover".encode("utf-16-le"), 2: "emulated camera".encode("utf-16-le")}


def probe() -> bytes:
    """Return the data of a probe or commit request, which describe the only stream that there is."""
    return PROBE.pack(1, 1, 1, INTERVAL, 0, 0, 0, 0, 0, MAX_FRAME, MAX_FRAME)


def control_answer(request_type: int, request: int, value: int, index: int, length: int) -> tuple[int, bytes]:
    """Answer a control request with (status, data)."""
    if request == GET_DESCRIPTOR and request_type & 0x80:
        kind, which = value >> 8, value & 0xFF
        if kind == 1:
            return OK, device_descriptor()[:length]
        if kind == 2:
            return OK, configuration_descriptor()[:length]
        if kind == 3 and which in STRINGS:
            text = STRINGS[which]
            return OK, bytes([len(text) + 2, 3, *text])[:length]
        return STALL, b""
    if request_type & 0x60 == 0x20:  # a request of the device class
        if index & 0xFF != STREAMING_INTERFACE or value >> 8 not in (1, 2):
            return STALL, b""
        if request == GET_LEN:
            return OK, PROBE.size.to_bytes(2, "little")[:length]
        return OK, probe()[:length] if request_type & 0x80 else b""
    return OK, b"\0" * length if request_type & 0x80 else b""


class UsbCamera:
    """A webcam that waits to be plugged in; a context manager. path: of its socket.

    jpegs: its frames, which it repeats, at RATE_HZ by a clock that runs `slow` times slower than this machine's.
    """

    def __init__(self, jpegs: Sequence[bytes], *, slow: float = 1.0):
        if not jpegs or max(map(len, jpegs)) + 12 > MAX_FRAME:
            raise RoverError(f"a camera needs frames of at most {MAX_FRAME} bytes, found {len(jpegs)} frames")
        self._jpegs, self._period_s = list(jpegs), slow / RATE_HZ
        self._folder = tempfile.TemporaryDirectory(prefix="rover-camera-")
        self.path = Path(self._folder.name) / "usb"
        self.frames = 0  # how many were sent completely
        self.failure: str | None = None
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(str(self.path))
        self._listener.listen(1)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="USB camera", daemon=True)

    def __enter__(self) -> "UsbCamera":
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        """End the camera. Raises nothing."""
        self._closing.set()
        if self._thread.is_alive():
            self._thread.join(2.0)
        self._listener.close()
        self._folder.cleanup()

    def _run(self) -> None:
        while not self._closing.is_set():
            if not select.select([self._listener], [], [], 0.1)[0]:
                continue
            connection, _ = self._listener.accept()
            with connection, contextlib.suppress(OSError, EOFError):  # it was pulled out
                _Plugged(connection, self).serve()


class _Plugged:
    """The camera while it is plugged in: one connection, from plugging in to pulling out."""

    def __init__(self, connection: socket.socket, camera: UsbCamera):
        self._connection, self._camera = connection, camera
        self._header_out = self._header_in = FIRST_HEADER  # the headers of what is sent, and of what comes
        self._received = bytearray()
        self._waiting: deque[tuple[int, int]] = deque()  # the driver's bulk requests as (id, bytes wanted)
        self._payload = b""  # what is left to send of the present frame
        self._whole = True  # whether a frame's last, short packet was sent, by which the driver knows that it ends
        self._number = 0
        self._due_s = 0.0

    def serve(self) -> None:
        version = b"rover".ljust(64, b"\0")
        self._send(HELLO, 0, version + _words(CAPABILITIES))
        self._header_out = HEADER
        while not self._camera._closing.is_set():
            wait_s = min(0.1, max(0.0, self._due_s - time.monotonic())) if self._waiting and self._whole else 0.1
            if select.select([self._connection], [], [], wait_s)[0]:
                data = self._connection.recv(1 << 16)
                if not data:
                    return
                self._received += data
                self._take()
            self._give()

    def _take(self) -> None:
        while len(self._received) >= self._header_in.size:
            kind, length, number = self._header_in.unpack_from(self._received)
            end = self._header_in.size + length
            if len(self._received) < end:
                return
            body = bytes(self._received[self._header_in.size : end])
            del self._received[:end]
            self._answer(kind, number, body)

    def _answer(self, kind: int, number: int, body: bytes) -> None:
        if kind == HELLO:
            self._header_in = HEADER
            self._introduce()
        elif kind in (SET_CONFIGURATION, GET_CONFIGURATION):
            self._send(CONFIGURATION, number, bytes([OK, 1]))
        elif kind in (SET_ALT, GET_ALT):
            self._send(ALT, number, bytes([OK, body[0], 0]))
        elif kind == CONTROL:
            endpoint, request, request_type, _, value, index, length = CONTROL_HEADER.unpack_from(body)
            status, data = control_answer(request_type, request, value, index, length)
            count = len(data) if request_type & 0x80 else len(data) or length
            head = CONTROL_HEADER.pack(endpoint, request, request_type, status, value, index, count)
            self._send(CONTROL, number, head + data)
        elif kind == BULK:
            endpoint, _, low, _, high = BULK_HEADER.unpack_from(body)
            if endpoint == ENDPOINT:
                self._waiting.append((number, low | high << 16))
            else:
                self._send(BULK, number, BULK_HEADER.pack(endpoint, STALL, 0, 0, 0))
        elif kind == CANCEL:
            waiting = [w for w in self._waiting if w[0] != number]
            if len(waiting) < len(self._waiting):
                self._waiting = deque(waiting)
                self._payload, self._whole = b"", True  # the driver stops, and begins with a new frame next time
                self._send(BULK, number, BULK_HEADER.pack(ENDPOINT, CANCELLED, 0, 0, 0))

    def _introduce(self) -> None:
        types, interfaces, sizes = bytearray([NO_TYPE] * 32), bytearray(32), [0] * 32
        types[0] = types[16] = 0  # control endpoints, out and in
        sizes[0] = sizes[16] = 64
        at = 16 + (ENDPOINT & 0x0F)
        types[at], interfaces[at], sizes[at] = BULK_TYPE, STREAMING_INTERFACE, PACKET

        def padded(*values: int) -> bytes:
            return bytes(values).ljust(32, b"\0")

        known = padded(CONTROL_INTERFACE, STREAMING_INTERFACE), padded(VIDEO, VIDEO), padded(1, 2), padded(0, 0)
        self._send(INTERFACES, 0, _words(2) + b"".join(known))
        self._send(ENDPOINTS, 0, bytes(types) + bytes(32) + bytes(interfaces) + struct.pack("<32H", *sizes))
        self._send(CONNECT, 0, struct.pack("<BBBBHHH", HIGH_SPEED, 0xEF, 2, 1, VENDOR, PRODUCT, 0x0100))

    def _give(self) -> None:
        """Answer the driver's requests with the frame that is due."""
        camera = self._camera
        while self._waiting:
            if self._whole:
                now = time.monotonic()
                if now < self._due_s:
                    return
                # A driver that was late misses frames, as with a real camera.
                self._due_s = max(self._due_s or now, now - camera._period_s) + camera._period_s
                jpeg = camera._jpegs[self._number % len(camera._jpegs)]
                flags = 0x80 | 0x02 | self._number & 1  # end of header, end of frame, which of two frames it is
                self._payload, self._whole = bytes([2, flags]) + jpeg, False
                self._number += 1
            number, wanted = self._waiting.popleft()
            data, self._payload = self._payload[:wanted], self._payload[wanted:]
            self._whole = len(data) < wanted
            camera.frames += self._whole
            header = BULK_HEADER.pack(ENDPOINT, OK, len(data) & 0xFFFF, 0, len(data) >> 16)
            self._send(BULK, number, header + data)

    def _send(self, kind: int, number: int, body: bytes) -> None:
        self._connection.sendall(self._header_out.pack(kind, len(body), number) + body)

"""A client's websocket connection, on which sending and receiving have a deadline.

The protocol is that of the library `websockets`, without its thread: a robot waits on the socket
itself, and goes on at its deadline.
"""

from __future__ import annotations

import socket
import ssl
import time
from collections import deque
from collections.abc import Mapping
from contextlib import suppress

from websockets.client import ClientProtocol
from websockets.exceptions import InvalidStatus
from websockets.frames import Close, Frame, Opcode
from websockets.protocol import State
from websockets.uri import parse_uri

from rn_backend_openpi.wire import MOST_BYTES
from roboneuron import ForeignDataError

_LEAST_S = 1e-3
_PART_BYTES = 1 << 16
_NO_HEADERS: Mapping[str, str] = {}


class HandshakeRefused(ConnectionError):
    """The server has answered the opening handshake with an HTTP status of refusal.

    Attributes:
        status: of HTTP.
        text: body of the answer.
    """

    def __init__(self, status: int, text: str) -> None:
        super().__init__(f"HTTP {status} {text}".rstrip())
        self.status, self.text = status, text


class PolicyConnection:
    """A connection, used from one thread, except `close`.

    Args:
        connected: owned by the connection from now on.
        url: "ws://host/path"; over TLS too.
        headers: further headers of the handshake.
    """

    def __init__(
        self, connected: socket.socket, url: str, headers: Mapping[str, str] = _NO_HEADERS
    ) -> None:
        self._socket = connected
        self._protocol = ClientProtocol(parse_uri(url), max_size=MOST_BYTES)
        self._headers = headers
        self._frames: deque[Frame] = deque()
        self._messages: deque[bytes | str] = deque()
        self._parts: list[bytes] = []
        self._is_text = False
        self._is_cut = False

    def open(self, deadline_s: float) -> None:
        """Do the opening handshake until a deadline (monotonic [s]).

        Raises:
            HandshakeRefused: the server refuses.
            OSError: it is gone, or does not answer in time.
            ForeignDataError: it is no websocket server.
        """
        request = self._protocol.connect()
        request.headers.update(self._headers)
        self._protocol.send_request(request)
        self._flush(deadline_s)
        while self._protocol.state is State.CONNECTING and not self._protocol.handshake_exc:
            self._read(deadline_s)
        error = self._protocol.handshake_exc
        if isinstance(error, InvalidStatus):
            body = bytes(error.response.body or b"").decode(errors="replace")
            raise HandshakeRefused(error.response.status_code, body.strip()[:1000])
        if error is not None:
            raise ForeignDataError(f"the other side is no policy server: {error}")

    def send(self, data: bytes, deadline_s: float) -> None:
        """Send a message.

        Raises:
            OSError: the other side is gone, or does not read in time; nothing more can be sent.
        """
        if self._is_cut or self._protocol.state is not State.OPEN:
            raise ConnectionError("an earlier message was sent only in part, or it is closed")
        self._protocol.send_binary(data)
        self._flush(deadline_s)

    def receive(self, deadline_s: float) -> bytes | str:
        """Receive the next message. One that is incomplete at the deadline (monotonic [s]) is
        continued by the next call.

        Raises:
            TimeoutError: no message until the deadline.
            OSError: the other side is gone.
            ForeignDataError: the other side sent something else.
        """
        while not self._has_message():
            self._read(deadline_s)
        return self._messages.popleft()

    def has_message(self) -> bool:
        """True if a message can be received without waiting. Raises as `receive`."""
        with suppress(BlockingIOError, ssl.SSLWantReadError):
            while not self._has_message():
                self._socket.settimeout(0.0)
                self._take(self._socket.recv(_PART_BYTES), time.monotonic())
        return bool(self._messages)

    @property
    def is_open(self) -> bool:
        """False if the other side is gone, or has closed the connection."""
        try:
            self.has_message()
        except (OSError, ForeignDataError):
            return False
        return self._protocol.state is State.OPEN

    def _has_message(self) -> bool:
        """True if a message is complete."""
        events = self._protocol.events_received()
        self._frames.extend(event for event in events if isinstance(event, Frame))
        while self._frames and not self._messages:
            frame = self._frames.popleft()
            if frame.opcode is Opcode.CLOSE:
                told = Close.parse(bytes(frame.data))
                raise ConnectionError(f"the other side has closed the connection: {told}")
            if frame.opcode not in (Opcode.TEXT, Opcode.BINARY, Opcode.CONT):
                continue
            if frame.opcode is not Opcode.CONT:
                self._is_text = frame.opcode is Opcode.TEXT
            self._parts.append(bytes(frame.data))
            if frame.fin:
                message = b"".join(self._parts)
                self._parts.clear()
                text = message.decode(errors="replace") if self._is_text else None
                self._messages.append(message if text is None else text)
        return bool(self._messages)

    def _read(self, deadline_s: float) -> None:
        left_s = deadline_s - time.monotonic()
        if left_s <= 0:
            raise TimeoutError("no data arrived in time")
        self._socket.settimeout(left_s)
        self._take(self._socket.recv(_PART_BYTES), deadline_s)

    def _take(self, data: bytes, deadline_s: float) -> None:
        """Handle received bytes, and answer pings."""
        if data:
            self._protocol.receive_data(data)
        else:
            self._protocol.receive_eof()
        with suppress(OSError):
            self._flush(deadline_s)
        broken = self._protocol.parser_exc
        if data and broken is not None:
            raise ForeignDataError(f"the other side sent no message: {broken}")
        if not data and self._protocol.handshake_exc is None:
            raise ConnectionError("the other side has closed the connection")

    def _flush(self, deadline_s: float) -> None:
        for part in self._protocol.data_to_send():
            self._is_cut = True
            rest = memoryview(part)
            while rest:
                self._socket.settimeout(max(deadline_s - time.monotonic(), _LEAST_S))
                rest = rest[self._socket.send(rest) :]
            self._is_cut = False

    def close(self) -> None:
        """Disconnect, which also unblocks a waiting thread; idempotent."""
        with suppress(OSError):
            # the method of SSLSocket would continue unencrypted
            socket.socket.shutdown(self._socket, socket.SHUT_RDWR)
        self._socket.close()

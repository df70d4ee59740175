"""A man in the middle of a TCP connection that records frames and replays them: frames of a
websocket, or TLS records, the only units that can be distinguished on encrypted connections.
"""

from __future__ import annotations

import socket
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from websockets.frames import Frame, Opcode

from rn_backend_openpi.wire import pack, unpack

_TLS_HEADER, _TLS_KINDS = 5, range(20, 25)
_MOST = 1 << 16
_HANDSHAKES = (b"GE", b"HT")
Cut = Callable[[socket.socket], bytes]
Send = Callable[["Recording", bytes], Sequence[bytes]]
"""Returns what is sent instead of a frame; called with the recording of its connection."""


@dataclass(eq=False)
class Recording:
    """Frames of a connection.

    Attributes:
        asked: sent by the client.
        answered: sent by the server.
    """

    asked: deque[bytes] = field(default_factory=deque)
    answered: deque[bytes] = field(default_factory=deque)


def as_it_is(recording: Recording, frame: bytes) -> Sequence[bytes]:
    """Change nothing."""
    return (frame,)


def _whole(source: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count:
        more = source.recv(count - len(data))
        if not more:
            raise ConnectionError("closed")
        data += more
    return data


def plain_frame(source: socket.socket) -> bytes:
    """The next frame of a websocket, or the head of its handshake. Raises OSError at the end."""
    head = _whole(source, 2)
    if head in _HANDSHAKES:
        while not head.endswith(b"\r\n\r\n"):
            head += _whole(source, 1)
        return head
    more = {126: 2, 127: 8}.get(head[1] & 0x7F, 0)
    head += _whole(source, more)
    size = int.from_bytes(head[2:], "big") if more else head[1] & 0x7F
    return head + _whole(source, size + (4 if head[1] & 0x80 else 0))


def message_of(frame: bytes) -> dict[str, Any]:
    """The message in a frame, by its keys; empty for anything else."""
    if frame[:2] in _HANDSHAKES or frame[0] != 0x82:
        return {}
    is_masked = bool(frame[1] & 0x80)
    start = {126: 4, 127: 10}.get(frame[1] & 0x7F, 2)
    data = frame[start:]
    if is_masked:
        key, data = data[:4], data[4:]
        data = bytes(byte ^ key[place % 4] for place, byte in enumerate(data))
    found = unpack(data)
    assert isinstance(found, dict)
    return {str(key): value for key, value in found.items()}


def frame_of(message: Mapping[str, object]) -> bytes:
    """A server's frame with a message."""
    return bytes(Frame(Opcode.BINARY, pack(message)).serialize(mask=False))


def tls_record(source: socket.socket) -> bytes:
    """The next TLS record, or the received bytes if they are none. Raises OSError at the end."""
    head = _whole(source, _TLS_HEADER)
    if head[0] not in _TLS_KINDS:
        return head + source.recv(_MOST)
    return head + _whole(source, int.from_bytes(head[3:], "big"))


class MiddleMan:
    """Forwards connections to a server.

    Args:
        port: port of the server on this machine.
        cut: reads the next frame of a stream.
        listen: address for clients; a free port of loopback by default.
        kept: number of newest frames recorded for each side of a connection; None for all.

    Attributes:
        ask, answer: treatment of the frames of clients and of the server; set from any thread.
        recordings: recordings of all connections so far.
    """

    def __init__(
        self,
        port: int,
        cut: Cut,
        listen: tuple[str, int] = ("127.0.0.1", 0),
        kept: int | None = None,
    ) -> None:
        self._there, self._cut, self._kept = port, cut, kept
        self.ask: Send = as_it_is
        self.answer: Send = as_it_is
        self.recordings: list[Recording] = []
        self._listener = socket.create_server(listen)
        self.port: int = self._listener.getsockname()[1]
        self._ends: list[socket.socket] = [self._listener]
        threading.Thread(target=self._accept, daemon=True).start()

    @property
    def address(self) -> str:
        """Address for clients."""
        return f"127.0.0.1:{self.port}"

    def honest(self) -> None:
        """Forward unchanged from now on."""
        self.ask = self.answer = as_it_is

    def close(self) -> None:
        """End all connections."""
        for end in self._ends:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                server = socket.create_connection(("127.0.0.1", self._there), 10.0)
                server.settimeout(None)
                self._ends += [client, server]
                recording = Recording(deque(maxlen=self._kept), deque(maxlen=self._kept))
                self.recordings.append(recording)
                for asks in (True, False):
                    ends = (client, server) if asks else (server, client)
                    words = (*ends, recording, asks)
                    threading.Thread(target=self._carry, args=words, daemon=True).start()

    def _carry(
        self, source: socket.socket, sink: socket.socket, recording: Recording, asks: bool
    ) -> None:
        with suppress(OSError):
            while True:
                frame = self._cut(source)
                sent = (self.ask if asks else self.answer)(recording, frame)
                (recording.asked if asks else recording.answered).append(frame)
                for part in sent:
                    sink.sendall(part)
        for end in (source, sink):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

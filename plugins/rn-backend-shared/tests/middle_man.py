"""A man in the middle of a TCP connection who records frames and sends them again: frames of the
protocol of shared models, or records of TLS, which is all that can be told apart there.
"""

from __future__ import annotations

import socket
import threading
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

from rn_backend_shared.frames import HEADER_BYTES, read_header

_TLS_HEADER, _TLS_KINDS = 5, range(20, 25)
_MOST = 1 << 16
Cut = Callable[[socket.socket], bytes]
Send = Callable[["Recording", bytes], Sequence[bytes]]
"""What is sent in place of a frame, with all that was recorded of its connection."""


@dataclass(eq=False)
class Recording:
    """What was sent over a connection, frame by frame.

    Attributes:
        asked: by the client.
        answered: by the server.
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
    """The next frame of the protocol of shared models. Raises OSError at the end."""
    head = _whole(source, HEADER_BYTES)
    return head + _whole(source, read_header(head).body_bytes)


def tls_record(source: socket.socket) -> bytes:
    """The next record of TLS, or what has come that is none. Raises OSError at the end."""
    head = _whole(source, _TLS_HEADER)
    if head[0] not in _TLS_KINDS:
        return head + source.recv(_MOST)
    return head + _whole(source, int.from_bytes(head[3:], "big"))


class MiddleMan:
    """Carries connections to a server.

    Args:
        port: of the server on this machine.
        cut: reads the next frame of a stream.
        listen: where clients connect; a free port of loopback by default.
        kept: frames of each side of a connection that are recorded, the newest; None: all.

    Attributes:
        ask, answer: what is done with frames of clients and of the server; set from any thread.
        recordings: of all connections so far.
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
        """Where clients connect."""
        return f"127.0.0.1:{self.port}"

    def honest(self) -> None:
        """Change nothing any longer."""
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

"""Frames over a connected socket, each sent and received within a time limit."""

from __future__ import annotations

import socket
import ssl
import struct
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import NamedTuple

from rn_backend_shared.frames import (
    HEADER_BYTES,
    Document,
    Header,
    decode,
    encode,
    read_header,
)
from roboneuron import ForeignDataError

Buffer = bytes | bytearray | memoryview
_LONG_S = 1e6
_LEAST_S = 1e-3


class Received(NamedTuple):
    """One frame.

    Attributes:
        header: header of the frame.
        body: document and arrays, as received.
    """

    header: Header
    body: bytearray

    def document(self) -> Document:
        """Decode the document. Raises ForeignDataError."""
        return decode(self.header, self.body)


class FrameChannel:
    """Frames over a connected socket. One thread reads; `send` may be called from any thread, one
    at a time, but over TLS only from the reading thread.

    Args:
        connected: owned by the channel from now on.
        most_bytes: longest accepted body, until changed.
    """

    def __init__(self, connected: socket.socket, most_bytes: int | None = None) -> None:
        self._in = connected
        self._is_tls = isinstance(connected, ssl.SSLSocket)
        # each direction has its own time limit; TLS has one state for both
        self._out = connected if self._is_tls else connected.dup()
        self._buffer, self._filled = bytearray(HEADER_BYTES), 0
        self._header: Header | None = None  # header of the frame that is being received
        self._begun_s: float | None = None
        self._is_cut = False
        self.most_bytes = most_bytes

    @property
    def begun_s(self) -> float | None:
        """Monotonic start time of the frame being received; None between frames."""
        return self._begun_s

    @property
    def is_cut(self) -> bool:
        """True if a frame was sent only in part, so that nothing more can be sent."""
        return self._is_cut

    def send(self, header: Header, document: Mapping[str, object], timeout_s: float) -> None:
        """Send a document.

        Raises:
            OSError: the other side is gone, or does not read in time.
            ValueError: the document cannot be sent.
        """
        self.send_parts(encode(header, document), timeout_s)

    def send_parts(self, parts: Sequence[Buffer], timeout_s: float) -> None:
        """Send an encoded frame; raises OSError as `send`."""
        if self._is_cut:
            raise ConnectionError("an earlier frame was sent only in part")
        end_s = time.monotonic() + timeout_s
        self._is_cut = True
        for part in parts:
            rest = memoryview(part)
            while rest:
                self._out.settimeout(max(end_s - time.monotonic(), _LEAST_S))
                rest = rest[self._out.send(rest) :]
        self._is_cut = False

    def receive(self, deadline_s: float | None) -> Received:
        """Receive the next frame. A frame that is incomplete at the deadline (monotonic [s]) is
        continued by the next call.

        Raises:
            TimeoutError: no frame until the deadline.
            OSError: the other side is gone.
            ForeignDataError: the other side sent something else.
        """
        if self._header is None:
            self._fill(deadline_s)
            try:
                header = read_header(self._buffer)
                if self.most_bytes is not None and header.body_bytes > self.most_bytes:
                    raise ForeignDataError(
                        f"a frame of {header.body_bytes} bytes is more than expected"
                    )
            except ForeignDataError:
                if not self._is_tls:
                    with suppress(OSError):  # unread bytes would reset the connection on close
                        self._in.recv(1 << 20, socket.MSG_DONTWAIT)
                raise
            self._header = header
            self._buffer, self._filled = bytearray(header.body_bytes), 0
        self._fill(deadline_s)
        received = Received(self._header, self._buffer)
        self._buffer, self._filled, self._header = bytearray(HEADER_BYTES), 0, None
        self._begun_s = None
        return received

    def _fill(self, deadline_s: float | None) -> None:
        """Receive until the buffer is full."""
        rest = memoryview(self._buffer)
        while self._filled < len(rest):
            left_s = _LONG_S if deadline_s is None else deadline_s - time.monotonic()
            if left_s <= 0:
                raise TimeoutError("no data arrived in time")
            self._in.settimeout(left_s)  # never None: it would make the other direction block
            count = self._in.recv_into(rest[self._filled :])
            if not count:
                raise ConnectionError("the other side has closed the connection")
            if self._begun_s is None:
                self._begun_s = time.monotonic()
            self._filled += count

    def interrupt(self) -> None:
        """Unblock every thread that waits for this channel; idempotent."""
        with suppress(OSError):
            # the method of SSLSocket would continue unencrypted
            socket.socket.shutdown(self._in, socket.SHUT_RDWR)

    def close(self) -> None:
        """Disconnect, which also unblocks a reading thread; idempotent."""
        self.interrupt()
        self._in.close()
        self._out.close()


_PEER = struct.Struct("3i")
"""Process, user and group of SO_PEERCRED."""


def peer_user(connected: socket.socket) -> int:
    """User id of the process at the other end of a local socket."""
    return _peer(connected)[1]


def peer_process(connected: socket.socket) -> int:
    """Id of the process at the other end of a local socket."""
    return _peer(connected)[0]


def _peer(connected: socket.socket) -> tuple[int, int]:
    told = connected.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size)
    process, user, _ = _PEER.unpack(told)
    return process, user

"""The encrypted connection to one other machine, which transports datagrams."""

from __future__ import annotations

import asyncio
import socket
import struct
import time
from collections import deque
from collections.abc import Callable

from rn_link.ports import PARTICIPANT_BYTES, ParticipantPort

SILENT_MS = 3000
"""Time without an answer of the other machine after which the kernel ends a connection."""
OLD_S = 0.5
"""Queueing time after which a message is dropped; reliable writers send it again."""
_MOST_WAITING = 1024
"""Limit of queued messages, of at most 64 kB each; the oldest one is dropped."""
_UNSENT_BYTES = 131_072
"""Limit of data in the transport; more waits in this queue, where it can expire, and not in the
kernel.
"""
_TCP = {
    socket.TCP_NOTSENT_LOWAT: _UNSENT_BYTES,
    socket.TCP_USER_TIMEOUT: SILENT_MS,
    socket.TCP_KEEPIDLE: 1,
    socket.TCP_KEEPINTVL: 1,
}
_HEADER = struct.Struct(f">{PARTICIPANT_BYTES}sHH")
Deliver = Callable[[ParticipantPort, bytes], None]


class LinkStream:
    """One connection, from `run` to `close`.

    Args:
        reader, writer: streams after the handshake.
        deliver: called with received messages.

    Raises:
        OSError: the connection has ended already.
    """

    def __init__(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, deliver: Deliver
    ) -> None:
        self._reader = reader
        self._writer = writer
        self._deliver = deliver
        self._waiting: deque[tuple[float, bytes]] = deque(maxlen=_MOST_WAITING)
        self._more = asyncio.Event()
        writer.transport.set_write_buffer_limits(high=_UNSENT_BYTES)
        raw: socket.socket | None = writer.get_extra_info("socket")
        if raw is None:  # asyncio has closed it already
            raise ConnectionError("the other side has ended it after the handshake")
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in _TCP.items():
            raw.setsockopt(socket.IPPROTO_TCP, option, value)

    async def run(self) -> None:
        """Transport messages until the connection ends.

        Raises:
            OSError, EOFError: the reason of its end.
        """
        writing = asyncio.ensure_future(self._write())
        try:
            while True:
                *place, length = _HEADER.unpack(await self._reader.readexactly(_HEADER.size))
                self._deliver(ParticipantPort(*place), await self._reader.readexactly(length))
        finally:
            writing.cancel()
            self.close()
            # an error of the writer ends the reader too
            await asyncio.gather(writing, return_exceptions=True)

    def send(self, place: ParticipantPort, message: bytes) -> None:
        """Queue a message; messages that wait too long are dropped."""
        self._waiting.append((time.monotonic(), _HEADER.pack(*place, len(message)) + message))
        self._more.set()

    def close(self) -> None:
        """End the connection at once; idempotent."""
        self._writer.transport.abort()

    async def _write(self) -> None:
        while True:
            await self._more.wait()
            self._more.clear()
            while self._waiting:
                since_s, frame = self._waiting.popleft()
                if time.monotonic() - since_s <= OLD_S:
                    self._writer.write(frame)
                    await self._writer.drain()

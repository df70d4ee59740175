"""The encrypted connection to one other machine, which transports datagrams."""

from __future__ import annotations

import asyncio
import socket
import struct
import time
from collections import deque
from collections.abc import Callable

from rn_link.ports import DISCOVERY, PARTICIPANT_BYTES, ParticipantPort

HEARTBEAT_S = 0.5
SILENT_BEATS = 6
"""Heartbeats without received data after which a connection is given up: 3 s."""
OLD_S = 0.5
"""Queueing time after which a message is dropped; reliable writers send it again."""
MOST_WAITING_BYTES = 8_388_608
_HEADER = struct.Struct(f">{PARTICIPANT_BYTES}sHH")
_UNSENT_BYTES = 131_072
"""Limit of data in the transport; more waits in this queue, where it can expire, and not in the
kernel.
"""
_BEAT = _HEADER.pack(*DISCOVERY, 0)
Deliver = Callable[[ParticipantPort, bytes], None]


class LinkStream:
    """One connection, from `run` to `close`."""

    def __init__(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, deliver: Deliver
    ) -> None:
        """Args: streams after the handshake; `deliver` is called with received messages.

        Raises:
            OSError: the connection has ended already.
        """
        self._reader = reader
        self._writer = writer
        self._deliver = deliver
        self._waiting: deque[tuple[float, bytes]] = deque()
        self._waiting_bytes = 0
        self._more = asyncio.Event()
        self._silent_beats = 0
        writer.transport.set_write_buffer_limits(high=_UNSENT_BYTES)
        raw: socket.socket | None = writer.get_extra_info("socket")
        if raw is None:  # asyncio has closed it already
            raise ConnectionError("the other side has ended it after the handshake")
        raw.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, _UNSENT_BYTES)

    async def run(self) -> None:
        """Transport messages until the connection ends.

        Raises:
            OSError, EOFError: the reason of its end.
        """
        tasks = [
            asyncio.ensure_future(one) for one in (self._receive(), self._write(), self._beat())
        ]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                await task
        finally:
            for task in tasks:
                task.cancel()
            self.close()
            await asyncio.gather(*tasks, return_exceptions=True)

    def send(self, place: ParticipantPort, message: bytes) -> None:
        """Queue a message; messages that wait too long are dropped."""
        self._waiting.append((time.monotonic(), _HEADER.pack(*place, len(message)) + message))
        self._waiting_bytes += len(message)
        while self._waiting_bytes > MOST_WAITING_BYTES:
            self._next()
        self._more.set()

    def close(self) -> None:
        """End the connection at once; idempotent."""
        self._writer.transport.abort()

    def _next(self) -> tuple[float, bytes]:
        since_s, frame = self._waiting.popleft()
        self._waiting_bytes -= len(frame) - _HEADER.size
        return since_s, frame

    async def _write(self) -> None:
        while True:
            await self._more.wait()
            self._more.clear()
            while self._waiting:
                since_s, frame = self._next()
                if self._writer.is_closing():
                    return
                if time.monotonic() - since_s <= OLD_S:
                    self._writer.write(frame)
                    await self._writer.drain()

    async def _receive(self) -> None:
        while True:
            *place, length = _HEADER.unpack(await self._reader.readexactly(_HEADER.size))
            message = await self._reader.readexactly(length)
            self._silent_beats = 0
            if message:
                self._deliver(ParticipantPort(*place), message)

    async def _beat(self) -> None:
        """Send heartbeats and count those without received data. Seconds are not counted, because a
        machine that was busy has not received anything either.
        """
        while self._silent_beats < SILENT_BEATS:
            self._waiting.append((time.monotonic(), _BEAT))
            self._more.set()
            await asyncio.sleep(HEARTBEAT_S)
            self._silent_beats += 1
        raise TimeoutError(f"nothing was received for {SILENT_BEATS * HEARTBEAT_S:g} s")

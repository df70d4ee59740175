"""The encrypted connection to one other machine, which transports datagrams."""

from __future__ import annotations

import asyncio
import socket
import ssl
import struct
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from rn_link.machine import PORT, Machine
from rn_link.ports import PARTICIPANT_BYTES, ParticipantPort
from rn_link.state import PeerConnection
from rn_link.tls import Handshakes, tls_context
from roboneuron import ConfigurationError

PAUSE_S = 0.5
"""Pause between two attempts to connect."""
ATTEMPT_S = 3.0
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
_OPTIONS = (
    (socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1),
    (socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, 1),
    (socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, 1),
    (socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, SILENT_MS),
    (socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, _UNSENT_BYTES),
)
_HEADER = struct.Struct(f">{PARTICIPANT_BYTES}sHH")


class PeerLink:
    """The connection to one machine, kept by `run`: the hub connects, a member listens.

    Args:
        machine, folder: this machine's part of the link.
        name: the other machine.
        deliver: called with received messages.
        tell: called with the state of the connection as it changes.
    """

    def __init__(
        self,
        machine: Machine,
        folder: Path,
        name: str,
        deliver: Callable[[str, ParticipantPort, bytes], None],
        tell: Callable[[str, PeerConnection], None],
    ) -> None:
        self._machine = machine
        self._folder = folder
        self._name = name
        self._deliver = deliver
        self._tell = tell
        self._writer: asyncio.StreamWriter | None = None
        self._waiting: deque[tuple[float, bytes]] = deque(maxlen=_MOST_WAITING)
        self._more = asyncio.Event()

    def send(self, place: ParticipantPort, message: bytes) -> None:
        """Queue a message; those that wait too long, or without a connection, are dropped."""
        if self._writer is not None:
            frame = _HEADER.pack(*place, len(message)) + message
            self._waiting.append((time.monotonic(), frame))
            self._more.set()

    async def run(self) -> None:
        """Keep the machine connected until cancelled, with endless retries."""
        self._fail(ConnectionError("it has not connected yet"))
        meet = self._connect if self._machine.role == "hub" else self._listen
        while True:
            try:
                await meet(tls_context(self._machine, self._folder, self._name))
            except ConfigurationError as error:
                self._tell(self._name, PeerConnection(error=error.message, hint=error.hint))
            except OSError as error:  # includes TLS errors and timeouts
                self._fail(error)
            await asyncio.sleep(PAUSE_S)

    def _fail(self, error: OSError | EOFError) -> None:
        name, address = self._name, self._machine.peers[self._name].address
        if isinstance(error, ssl.SSLError):
            hint = (
                f"Pair it again: `roboneuron link remove {name}` and `link add {name}` on the hub."
            )
        elif self._machine.role == "hub":
            hint = (
                f"Is {name} on, {address} its address, its TCP port {PORT} open, and RoboNeuron or "
                "`roboneuron link run` started there?"
            )
        else:
            hint = f"Start RoboNeuron on {name}; it has to reach TCP {PORT} here."
        told = "the other side has ended it" if isinstance(error, EOFError) else str(error)
        self._tell(name, PeerConnection(error=told or "no answer", hint=hint))

    async def _connect(self, context: ssl.SSLContext) -> None:
        """Connect to a member until the connection ends."""
        async with asyncio.timeout(ATTEMPT_S):
            address = self._machine.peers[self._name].address
            connection = await asyncio.open_connection(address, PORT, ssl=context)
        await self._carry(*connection)

    async def _listen(self, context: ssl.SSLContext) -> None:
        """Listen for the hub until cancelled."""
        handshakes = Handshakes()

        async def accept(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            with handshakes.begun(writer), suppress(OSError):
                await writer.start_tls(context, ssl_handshake_timeout=ATTEMPT_S)
            # a handshake that was ended has no certificate
            if not server.is_serving() or not writer.get_extra_info("peercert"):
                writer.transport.abort()
                return
            await self._carry(reader, writer)

        server = await asyncio.start_server(accept, "0.0.0.0", PORT)
        try:
            await asyncio.get_running_loop().create_future()
        finally:
            server.close()
            handshakes.end()
            if self._writer is not None:
                self._writer.transport.abort()

    async def _carry(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Transport messages until the connection ends."""
        # the hub reconnects after losing a connection that still looks alive on this side
        if self._writer is not None:
            self._writer.transport.abort()
        self._writer = writer
        self._waiting.clear()
        now = datetime.now(UTC).isoformat(timespec="seconds")
        self._tell(self._name, PeerConnection(since=now))
        writing = asyncio.ensure_future(self._write(writer))
        try:
            connected: socket.socket | None = writer.get_extra_info("socket")
            if connected is None:  # asyncio has closed it already
                raise ConnectionError("the other side has ended it after the handshake")
            for option in _OPTIONS:
                connected.setsockopt(*option)
            while True:
                *place, length = _HEADER.unpack(await reader.readexactly(_HEADER.size))
                message = await reader.readexactly(length)
                self._deliver(self._name, ParticipantPort(*place), message)
        except (OSError, EOFError) as error:
            if self._writer is writer:
                self._fail(error)
        finally:
            if self._writer is writer:
                self._writer = None
            writing.cancel()
            writer.transport.abort()
            # an error of the writer ends the reader too
            await asyncio.gather(writing, return_exceptions=True)

    async def _write(self, writer: asyncio.StreamWriter) -> None:
        writer.transport.set_write_buffer_limits(high=_UNSENT_BYTES)
        while True:
            await self._more.wait()
            self._more.clear()
            while self._waiting:
                since_s, frame = self._waiting.popleft()
                if time.monotonic() - since_s <= OLD_S:
                    writer.write(frame)
                    await writer.drain()

"""MCP transport over two descriptors: incoming messages in priority lanes, outgoing lines.

Reading and writing happen on daemon threads, so that neither a silent nor a stuck client can block
the server's exit. The SDK's own `stdio_server` reads on a thread that cannot be abandoned, does not
answer invalid messages, and delivers messages only in the order of their arrival.
"""

from __future__ import annotations

import asyncio
import os
import queue
import sys
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial

from anyio import EndOfStream
from anyio.abc import ObjectReceiveStream, ObjectSendStream
from mcp.shared.dispatcher import coerce_request_id
from mcp.shared.message import ServerMessageMetadata, SessionMessage
from mcp.types import (
    JSONRPCError,
    JSONRPCMessage,
    JSONRPCNotification,
    JSONRPCRequest,
    JSONRPCResponse,
)

from roboneuron.stdio.envelope import (
    INVALID_REQUEST,
    EnvelopeError,
    is_urgent,
    read_message,
)

MAX_LINE_BYTES = 16 * 1024 * 1024
"""Maximum line length; a longer line is refused and skipped to the next newline."""
_CHUNK = 65536
_FLUSH_S = 1.0
_URGENT, _OTHER, _PING = 0, 1, 2
"""Lanes of waiting messages, in the order of their priority."""
_CANCELLED = "notifications/cancelled"
_MOST_PINGS = 16
_MOST_WAITING = 1000
_MOST_WAITING_BYTES = 64 * 1024 * 1024


class LineWriter:
    """Writes to a descriptor on a thread; lines that the client has not read are dropped when the
    server ends.
    """

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._queue: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._write, name="mcp-stdout", daemon=True)

    def start(self) -> None:
        """Start the writing thread."""
        self._thread.start()

    def write(self, text: str) -> None:
        """Queue one line; never blocks, callable from any thread."""
        self._queue.put(text.encode("utf-8") + b"\n")

    def close(self) -> None:
        """Allow the client a bounded time to read the queued lines."""
        self._queue.put(None)
        self._thread.join(_FLUSH_S)

    def _write(self) -> None:
        while (data := self._queue.get()) is not None:
            view = memoryview(data)
            try:
                while view:
                    view = view[os.write(self._descriptor, view) :]
            except OSError as error:
                sys.stderr.write(f"The client is gone: {error}\n")
                return


class MessageStream(ObjectReceiveStream[SessionMessage], ObjectSendStream[SessionMessage]):
    """Both streams of a stdio server: incoming messages of a descriptor until its end, and outgoing
    lines.

    Invalid messages are answered here, as are requests whose id is in use, and those beyond the
    limit of waiting ones. An emergency stop and a cancellation overtake the rest; pings have the
    lowest priority, so that a flood of them delays nothing.

    Args:
        descriptor: read by a separate thread.
        answer: sends a line to the client without blocking; also called from that thread.
        most: maximum number of concurrent requests; further ones wait here, where others can
            overtake them.
        on_end: called from that thread when the client has disconnected.
    """

    last_context = None

    def __init__(
        self,
        descriptor: int,
        answer: Callable[[str], None],
        most: int,
        on_end: Callable[[], None] = lambda: None,
    ) -> None:
        self._descriptor = descriptor
        self._answer = answer
        self._on_end = on_end
        self._most = {_PING: _MOST_PINGS, _OTHER: most}
        # guards lanes, ids and counts between the thread that reads and the event loop; nothing is
        # written to the client while it is held
        self._lock = threading.Lock()
        self._waiting: dict[int, deque[tuple[JSONRPCMessage, int]]] = {
            lane: deque() for lane in (_URGENT, _OTHER, _PING)
        }
        self._waiting_bytes = 0
        self._ids: dict[int | str, int] = {}
        self._at_work = {_URGENT: 0, _OTHER: 0, _PING: 0}
        self._has_ended = False
        self._loop: asyncio.AbstractEventLoop  # set by `start`
        self._changed = asyncio.Event()

    def start(self) -> None:
        """Start reading; must be called with the event loop running."""
        self._loop = asyncio.get_running_loop()
        threading.Thread(target=self._read, name="mcp-stdin", daemon=True).start()

    async def receive(self) -> SessionMessage:
        """Return the next message. Raises anyio.EndOfStream at the end."""
        while True:
            self._changed.clear()
            message = self._next()
            if isinstance(message, JSONRPCRequest):
                settled = partial(self._settle, message.id)
                return SessionMessage(message, ServerMessageMetadata(on_request_unanswered=settled))
            if message is not None:
                return SessionMessage(message)
            if self._has_ended and not any(self._waiting.values()):
                raise EndOfStream
            await self._changed.wait()

    async def send(self, item: SessionMessage) -> None:
        """Write one message."""
        message = item.message
        self._answer(message.model_dump_json(by_alias=True, exclude_unset=True))
        if isinstance(message, JSONRPCResponse | JSONRPCError):
            await self._settle(message.id)

    async def _settle(self, request_id: int | str | None) -> None:
        """Release the id of a request that was answered, or never will be."""
        if request_id is None:
            return
        with self._lock:
            lane = self._ids.pop(coerce_request_id(request_id), None)
            if lane is not None:
                self._at_work[lane] -= 1
        self._changed.set()

    async def aclose(self) -> None:
        """Stop receiving messages."""
        self._has_ended = True
        self._changed.set()

    def _next(self) -> JSONRPCMessage | None:
        """The next message that may be processed, or None."""
        with self._lock:
            for lane, waiting in self._waiting.items():
                if waiting and self._at_work[lane] < self._most.get(lane, sys.maxsize):
                    message, size = waiting.popleft()
                    self._waiting_bytes -= size
                    if isinstance(message, JSONRPCRequest):
                        self._at_work[lane] += 1
                    return message
        return None

    def _read(self) -> None:
        goes_on = False  # within a line that was refused for its length
        try:
            with open(self._descriptor, "rb", _CHUNK, closefd=False) as wire:
                while line := wire.readline(MAX_LINE_BYTES + 1):
                    is_whole = line.endswith(b"\n")
                    if not goes_on and (is_whole or len(line) > MAX_LINE_BYTES) and line.strip():
                        self._take(line.removesuffix(b"\n"))
                        self._wake()
                    goes_on = not is_whole
        except OSError as error:
            sys.stderr.write(f"Reading from the client failed: {error}\n")
        finally:
            self._on_end()
            self._has_ended = True
            self._wake()

    def _take(self, line: bytes) -> None:
        """Put a message in its lane, or refuse an invalid or excess one."""
        try:
            if len(line) > MAX_LINE_BYTES:
                what = f"A line is longer than {MAX_LINE_BYTES} bytes."
                raise EnvelopeError(INVALID_REQUEST, what)
            message = read_message(line)
            method, params = getattr(message, "method", ""), getattr(message, "params", None)
            urgent = is_urgent(method, params)
            lane = _URGENT if urgent else _PING if method == "ping" else _OTHER
            with self._lock:
                self._add(message, len(line), lane)
        except EnvelopeError as error:
            self._answer(error.answer)

    def _add(self, message: JSONRPCMessage, size: int, lane: int) -> None:
        if isinstance(message, JSONRPCNotification) and message.method == _CANCELLED:
            self._drop((message.params or {}).get("requestId"))
        if isinstance(message, JSONRPCRequest):
            key = coerce_request_id(message.id)
            if key in self._ids:
                raise EnvelopeError.repeated(message.id)
            if (
                len(self._waiting[lane]) >= _MOST_WAITING
                or self._waiting_bytes + size > _MOST_WAITING_BYTES
            ):
                raise EnvelopeError(
                    EnvelopeError.BUSY, "Too many requests are waiting.", message.id
                )
            self._ids[key] = lane
        self._waiting[lane].append((message, size))
        self._waiting_bytes += size

    def _drop(self, request_id: object) -> None:
        """Remove a waiting request that was cancelled: it is neither processed nor answered."""
        if not isinstance(request_id, int | str):
            return
        key = coerce_request_id(request_id)
        for waiting in self._waiting.values():
            for entry in waiting:
                if isinstance(entry[0], JSONRPCRequest) and coerce_request_id(entry[0].id) == key:
                    waiting.remove(entry)
                    self._waiting_bytes -= entry[1]
                    del self._ids[key]
                    return

    def _wake(self) -> None:
        with suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(self._changed.set)

"""Standard input and output as the MCP wire, and nothing else on it.

The descriptors are moved away before anything is imported that might print: afterwards fd 1 is stderr and fd 0 is the
null device, also for child processes and C++ libraries. Reading and writing happen on daemon threads, so that neither a
silent nor a stuck client can keep the server from leaving.
"""

from __future__ import annotations

import asyncio
import json
import os
import queue
import sys
import threading
from collections.abc import AsyncIterator
from typing import Any

MAX_LINE_BYTES = 16 * 1024 * 1024
"""A longer line is not JSON-RPC that this server answers; it is dropped to the next newline."""
_CHUNK = 65536
_FLUSH_S = 1.0


def divert_standard_streams() -> tuple[int, int]:
    """Move the wire to private descriptors (stdin, stdout), not inherited by children; call it once, first of all."""
    wire_in = os.dup(0)
    wire_out = os.dup(1)
    os.set_inheritable(wire_in, False)
    os.set_inheritable(wire_out, False)
    null = os.open(os.devnull, os.O_RDONLY)
    os.dup2(null, 0)
    os.close(null)
    os.dup2(2, 1)
    sys.stdout = sys.stderr
    return wire_in, wire_out


class LineReader:
    """Asynchronous iterator over the lines of a descriptor; ends with it."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._lines: asyncio.Queue[str | None] = asyncio.Queue()

    def start(self) -> None:
        """Begin to read; must be called with the event loop running."""
        loop = asyncio.get_running_loop()
        threading.Thread(target=self._read, args=(loop,), name="mcp-stdin", daemon=True).start()

    def __aiter__(self) -> AsyncIterator[str]:
        return self

    async def __anext__(self) -> str:
        line = await self._lines.get()
        if line is None:
            raise StopAsyncIteration
        return line

    def _read(self, loop: asyncio.AbstractEventLoop) -> None:
        buffer, too_long = bytearray(), False
        try:
            while chunk := os.read(self._descriptor, _CHUNK):
                buffer += chunk
                *lines, rest = buffer.split(b"\n")
                for line in lines:
                    if not too_long and line.strip():
                        loop.call_soon_threadsafe(self._lines.put_nowait, line.decode("utf-8", errors="replace"))
                    too_long = False
                buffer = bytearray(rest)
                if len(buffer) > MAX_LINE_BYTES:
                    too_long = True
                    buffer.clear()
        except OSError as error:
            sys.stderr.write(f"Reading from the client failed: {error}\n")
        finally:
            if not loop.is_closed():
                loop.call_soon_threadsafe(self._lines.put_nowait, None)


class LineWriter:
    """Writes to a descriptor on a thread; what the client does not take is dropped when the server ends."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._queue: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._write, name="mcp-stdout", daemon=True)

    def start(self) -> None:
        """Begin to write."""
        self._thread.start()

    async def write(self, text: str) -> None:
        """Queue one message."""
        self._queue.put(text.encode("utf-8"))

    async def flush(self) -> None:
        """Messages are written as they come."""

    def close(self) -> None:
        """Give the client a bounded time to take what is queued."""
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


class ReadableMessages:
    """The read stream of a stdio server without what is no JSON-RPC message.

    That is answered with an error here, where the SDK only logs it: whoever sent it would wait for ever.
    """

    def __init__(self, stream: Any, writer: LineWriter) -> None:
        self._stream = stream
        self._writer = writer

    @property
    def last_context(self) -> Any:
        """As the SDK's own stream."""
        return self._stream.last_context

    async def receive(self) -> Any:
        """The next message."""
        while True:
            item = await self._stream.receive()
            if not isinstance(item, Exception):
                return item
            await self._writer.write(_unreadable(item) + "\n")

    async def aclose(self) -> None:
        """As the SDK's own stream."""
        await self._stream.aclose()

    def __aiter__(self) -> ReadableMessages:
        return self

    async def __anext__(self) -> Any:
        from anyio import EndOfStream

        try:
            return await self.receive()
        except EndOfStream:
            raise StopAsyncIteration from None

    async def __aenter__(self) -> ReadableMessages:
        return self

    async def __aexit__(self, *error: object) -> None:
        await self.aclose()


def _unreadable(error: Exception) -> str:
    """The answer to a line that is no message, with its id as far as it has one."""
    from pydantic import ValidationError  # heavy

    found: object = None
    is_json = True
    if isinstance(error, ValidationError):
        for entry in error.errors(include_url=False):
            is_json = is_json and entry["type"] != "json_invalid"
            whole = entry["input"]  # where a field is missing or unknown, the whole message
            if entry["type"] == "missing" and len(entry["loc"]) == 2 and isinstance(whole, dict):
                found = whole.get("id", found)
    answer = {"code": -32600, "message": "This is no JSON-RPC request."}
    if not is_json:
        answer = {"code": -32700, "message": "This is no JSON."}
    known = found if isinstance(found, int | str) and not isinstance(found, bool) else None
    return json.dumps({"jsonrpc": "2.0", "id": known, "error": answer})

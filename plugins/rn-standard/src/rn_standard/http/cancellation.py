"""Cancellation by `notifications/cancelled` of requests that belong to no session.

Protocol 2026-07-28 has no sessions: a client cancels a request by closing its response stream, and
the SDK drops a notification that is sent as a POST of its own. Some clients send it all the same,
and what their request moves has to stop.

Sources: protocol 2026-07-28, basic/patterns/cancellation and basic/transports/streamable-http
(Sending Messages, 5: a notification is accepted with 202, or answered with an HTTP error).
"""

from __future__ import annotations

import json
from collections import defaultdict, deque
from collections.abc import Iterator
from contextlib import contextmanager
from ipaddress import ip_address

import anyio
from mcp.server.streamable_http import REQUEST_CANCELLED
from mcp.shared.dispatcher import coerce_request_id
from mcp.types import INVALID_PARAMS
from starlette.datastructures import MutableHeaders
from starlette.requests import HTTPConnection
from starlette.responses import Response
from starlette.types import Message, Receive, Scope, Send

from rn_standard.http.peers import process_of
from roboneuron.feature import Holder
from roboneuron.stdio.envelope import EnvelopeError

_MOST_ENDED = 1024
_LOST: Message = {"type": "http.disconnect"}


class OpenRequest:
    """A request in progress; used on the event loop only.

    Attributes:
        receive, send: the ASGI channels for the application.
    """

    def __init__(self, request_id: int | str, scope: Scope, receive: Receive, send: Send) -> None:
        self.request_id = request_id
        self.connection = HTTPConnection(scope)
        self.holder: Holder = scope[Holder.KEY]
        self._scope = scope
        self._receive, self._send = receive, send
        self._waits: set[anyio.CancelScope] = set()
        self._is_cancelled = False
        self._is_stream: bool | None = None
        self._is_answered = False

    async def receive(self) -> Message:
        """The next message; a disconnect once the request is cancelled, which is how the SDK learns
        that a client wants no answer any more.
        """
        with anyio.CancelScope() as wait:
            self._waits.add(wait)
            try:
                return _LOST if self._is_cancelled else await self._receive()
            finally:
                self._waits.discard(wait)
        return _LOST

    async def send(self, message: Message) -> None:
        """Send a part of the answer."""
        if message["type"] == "http.response.start":
            kind = MutableHeaders(scope=message).get("content-type", "")
            self._is_stream = kind.startswith("text/event-stream")
        elif not message.get("more_body", False):
            self._is_answered = True
        await self._send(message)

    def cancel(self) -> None:
        """End the request as if its client had closed the response stream."""
        self._is_cancelled = True
        for wait in self._waits:
            wait.cancel()

    async def settle(self) -> None:
        """Answer a cancelled request as the protocol's sessions do: its client waits for the end of
        the stream, which it has left open.
        """
        if not self._is_cancelled or self._is_answered:
            return
        error = {"code": REQUEST_CANCELLED, "message": "Request cancelled"}
        text = json.dumps({"jsonrpc": "2.0", "id": self.request_id, "error": error})
        if self._is_stream is None:
            answer = Response(text, media_type="application/json")
            await answer(self._scope, self._receive, self._send)
        elif self._is_stream:
            body = f"event: message\r\ndata: {text}\r\n\r\n".encode()
            await self._send({"type": "http.response.body", "body": body, "more_body": False})


class OpenRequests:
    """The requests in progress that belong to no session, by their ids."""

    def __init__(self) -> None:
        self._open: defaultdict[int | str, list[OpenRequest]] = defaultdict(list)
        self._ended: deque[tuple[int | str, str, str]] = deque(maxlen=_MOST_ENDED)

    @contextmanager
    def opened(self, request: OpenRequest) -> Iterator[None]:
        """Register a request within the block."""
        key = coerce_request_id(request.request_id)
        self._open[key].append(request)
        try:
            yield
        finally:
            self._open[key].remove(request)
            if not self._open[key]:
                del self._open[key]
            self._ended.append((key, request.holder.who, _host(request.connection)))

    async def cancel(self, params: object, scope: Scope) -> None:
        """Cancel the request that a `notifications/cancelled` names. That of a client which has
        just been answered needs nothing.

        Raises:
            EnvelopeError: nothing was cancelled, because none or several requests in progress of
                this client have that id.
        """
        found = params.get("requestId") if isinstance(params, dict) else None
        if isinstance(found, bool) or not isinstance(found, int | str):
            raise EnvelopeError(
                INVALID_PARAMS, "`requestId` must be a text or an integer; nothing was cancelled."
            )
        key, connection = coerce_request_id(found), HTTPConnection(scope)
        holder: Holder = scope[Holder.KEY]
        own = [
            request
            for request in tuple(self._open.get(key, ()))
            if await _is_same_client(request, holder, connection)
        ]
        if len(own) > 1:  # "7" and 7 are different ids, unless a client writes both for the same
            own = [request for request in own if request.request_id == found] or own
        if len(own) == 1:
            own[0].cancel()
        elif own or (key, holder.who, _host(connection)) not in self._ended:
            shown = repr(found)[:80]
            raise EnvelopeError(
                INVALID_PARAMS,
                f"Nothing was cancelled: {len(own) or 'no'} request{'s' * (len(own) != 1)} of this "
                f"client with the id {shown} in progress. Close the response stream of the "
                "request, or call a stop tool.",
            )


async def _is_same_client(request: OpenRequest, holder: Holder, connection: HTTPConnection) -> bool:
    """True for the same token, or the same process without one, on the same machine and, as far as
    this can be seen, in the same process: clients that share a token use the same small ids.
    """
    if request.holder.who != holder.who or _host(request.connection) != _host(connection):
        return False
    if Holder.is_local(holder.who):
        return bool(holder.client)
    if not _is_loopback(_host(connection)):
        return True
    process, other = await process_of(request.connection), await process_of(connection)
    return not process or not other or process == other


def _host(connection: HTTPConnection) -> str:
    return connection.client.host if connection.client is not None else ""


def _is_loopback(host: str) -> bool:
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False

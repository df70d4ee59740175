"""Access middleware: checks hosts, origins, tokens and each client's share of connections."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace

from pydantic_core import from_json
from starlette.authentication import AuthenticationError
from starlette.datastructures import Headers
from starlette.middleware.authentication import AuthenticationMiddleware
from starlette.middleware.cors import CORSMiddleware
from starlette.requests import HTTPConnection
from starlette.responses import JSONResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from rn_standard.http.authentication import LocalBackend, TokenBackend, holder_of
from rn_standard.http.connections import ConnectionTable
from rn_standard.http.fairness import RequestShares
from rn_standard.http.local_clients import account_of
from rn_standard.http.origins import HostRules
from rn_standard.http.peers import protocol_of
from rn_standard.http.tokens import TokenTable
from roboneuron.feature import Holder
from roboneuron.stdio.envelope import EnvelopeError, is_urgent


class RequestConnection:
    """The connection of one HTTP request; used on the event loop only."""

    def __init__(self, receive: Receive) -> None:
        self._receive = receive
        self._listeners: list[Callable[[], object]] = []
        self._is_lost = False

    async def receive(self) -> Message:
        """The ASGI channel of the application; a streamed response always listens on it."""
        message = await self._receive()
        if message["type"] == "http.disconnect" and not self._is_lost:
            self._is_lost = True
            if self._listeners:
                log.warning("A client was lost while its call was at work.")
            for listener in self._listeners:
                listener()
        return message

    @contextmanager
    def watched(self, listener: Callable[[], object]) -> Iterator[None]:
        """Call `listener` if the connection is lost within the block, or was lost before."""
        self._listeners.append(listener)
        try:
            if self._is_lost:
                listener()
            yield
        finally:
            self._listeners.remove(listener)


log = logging.getLogger(__name__)
_MOST_STOP_BYTES = 65536
_CLOSE = {"Connection": "close"}
"""Headers of a refusal, which closes the connection."""


class AccessMiddleware:
    """ASGI middleware: checks Host and Origin, then authenticates the client, and stores its Holder
    in the scope. A client with an open request or stream is `present`.
    """

    def __init__(
        self,
        app: ASGIApp,
        rules: HostRules,
        tokens: TokenTable,
        connections: ConnectionTable | None = None,
        present: Callable[[str], AbstractContextManager[None]] = lambda who: nullcontext(),
    ) -> None:
        self._app = app
        self._rules = rules
        self._connections = connections or ConnectionTable()
        self._present = present
        self._shares = RequestShares()
        backend = TokenBackend(tokens) if tokens else LocalBackend(self._connections)
        known = AuthenticationMiddleware(self._admit, backend, _unauthorized)
        self._for_pages = _Pages(known, rules)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        origins = headers.getlist("origin")
        if not self._rules.allows_host(headers.getlist("host")):
            log.warning("Refused a request for the host %r.", headers.get("host", "")[:100])
            await Response("Invalid Host header", status_code=421, headers=_CLOSE)(
                scope, receive, send
            )
        elif origins and not (len(origins) == 1 and self._rules.allows_origin(origins[0])):
            log.warning("Refused a request of a page of %r.", origins[0][:100])
            await Response("Invalid Origin header", status_code=403, headers=_CLOSE)(
                scope, receive, send
            )
        else:
            await self._for_pages(scope, receive, send)

    async def _admit(self, scope: Scope, receive: Receive, send: Send) -> None:
        holder = holder_of(scope["user"])
        protocol = protocol_of(HTTPConnection(scope))
        if protocol is not None and not self._connections.prove(protocol, account_of(holder)):
            is_stop, receive = await _look_for_stop(receive)
            if not is_stop:
                log.warning(
                    "Refused a request of %r: it has too many connections.", account_of(holder)
                )
                await _too_many(holder)(scope, receive, send)
                return
            self._connections.prove(protocol, account_of(holder), is_stop=True)
        turn = self._shares.at_once(holder.who)
        if turn is None:
            is_stop, receive = await _look_for_stop(receive)
            turn = None if is_stop else await self._shares.wait(holder.who)
        connection = RequestConnection(receive)
        inner = {**scope, Holder.KEY: replace(holder, watched=connection.watched)}
        try:
            with self._present(holder.who):
                await self._app(inner, connection.receive, send)
        finally:
            if turn is not None:
                turn.end()


class _Pages(CORSMiddleware):
    """Answers preflight requests and adds the headers with which a browser lets an allowed page
    read the answer.
    """

    def __init__(self, app: ASGIApp, rules: HostRules) -> None:
        super().__init__(
            app,
            allow_origins=["null"],  # any entry but "*": the allowed ones are checked below
            allow_methods=["GET", "POST", "DELETE"],
            allow_headers=["*"],  # those of the preflight request: Authorization, Mcp-* and others
            expose_headers=["Mcp-Session-Id", "WWW-Authenticate"],
            allow_private_network=True,
        )
        self._rules = rules

    def is_allowed_origin(self, origin: str) -> bool:
        """See CORSMiddleware."""
        return self._rules.allows_origin(origin)


async def _look_for_stop(receive: Receive) -> tuple[bool, Receive]:
    """Detect an emergency stop in the body; return the result, and a channel with the whole
    body.
    """
    messages: list[Message] = []
    body = b""
    while True:
        message = await receive()
        messages.append(message)
        body += message.get("body", b"")
        if not message.get("more_body", False) or len(body) > _MOST_STOP_BYTES:
            break
    messages.reverse()

    async def replay() -> Message:
        return messages.pop() if messages else await receive()

    try:
        raw = from_json(body)
    except ValueError:
        return False, replay
    return isinstance(raw, dict) and is_urgent(raw.get("method"), raw.get("params")), replay


def _too_many(holder: Holder) -> JSONResponse:
    text = f"{account_of(holder)!r} has too many connections; emergency_stop is still taken."
    return JSONResponse(
        {
            "jsonrpc": "2.0",
            "id": None,
            "error": {"code": EnvelopeError.BUSY, "message": text},
        },
        status_code=503,
        headers=_CLOSE,
    )


def _unauthorized(conn: HTTPConnection, error: AuthenticationError) -> JSONResponse:
    log.warning("Refused a request without a valid token.")
    return JSONResponse(
        {"jsonrpc": "2.0", "id": None, "error": {"code": -32001, "message": str(error)}},
        status_code=401,
        headers={"WWW-Authenticate": 'Bearer realm="roboneuron"', **_CLOSE},
    )

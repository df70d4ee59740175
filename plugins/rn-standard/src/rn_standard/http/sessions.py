"""Sessions of the 2025 protocols over HTTP: a share for each holder, and unique ids of requests in
progress. Requests of later protocols pass through; they can be cancelled.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from mcp.server.context import CallNext, HandlerResult, ServerRequestContext
from mcp.server.streamable_http import GET_STREAM_KEY
from mcp.server.transport_security import RequestBodyLimitMiddleware
from mcp.shared.inbound import MCP_PROTOCOL_VERSION_HEADER
from mcp_types import HEADER_MISMATCH, PROTOCOL_VERSION_META_KEY
from mcp_types.version import HANDSHAKE_PROTOCOL_VERSIONS
from pydantic_core import from_json
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from rn_standard.http.cancellation import OpenRequest, OpenRequests
from rn_standard.http.local_clients import account_of
from roboneuron.feature import Holder
from roboneuron.stdio.envelope import EnvelopeError

log = logging.getLogger(__name__)
MOST_SESSIONS, MOST_SESSIONS_OF_ONE = 256, 64
IDLE_S = 600.0
SESSION_HEADER = "mcp-session-id"
_REQUEST_KEY = "roboneuron.request"
_MOST_IDS = 4096
_RETRY = b"retry: 1000\r\n"
"""How long a client of a lost stream waits before it connects again [ms]. Source: protocol
2025-11-25, basic/transports, Sending Messages to the Server.
"""


@dataclass(eq=False, slots=True)
class _HttpSession:
    holder: str
    used_s: float
    open: int = 0
    ids: dict[int | str, _SessionRequest] = field(default_factory=dict)


@dataclass(eq=False, slots=True)
class _SessionRequest:
    """A request of a session: in progress until it was answered, or its handler and its HTTP
    exchange have both ended.
    """

    free: Callable[[], object]
    is_handled: bool = False
    is_left: bool = False

    def handled(self) -> None:
        self.is_handled = True
        if self.is_left:
            self.free()

    def left(self, is_answered: bool) -> None:
        self.is_left = True
        if is_answered or self.is_handled:
            self.free()


class Sessions:
    """ASGI middleware around the SDK's application.

    Args:
        app: the SDK's application.
        most_bytes: largest body.
        most_of_one: maximum number of sessions of one holder.
        on_end: called with the id of an ended session.
    """

    def __init__(
        self,
        app: ASGIApp,
        most_bytes: int,
        most_of_one: int,
        on_end: Callable[[str], object] = lambda session: None,
    ) -> None:
        self._app = app
        self._with_body = RequestBodyLimitMiddleware(self._serve, most_bytes)
        self._most_of_one = most_of_one
        self._on_end = on_end
        self._sessions: dict[str, _HttpSession] = {}
        self._without = OpenRequests()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        is_post = scope["type"] == "http" and scope["method"] == "POST"
        await (self._with_body if is_post else self._serve)(scope, receive, send)

    async def _serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        self._forget_idle()
        try:
            if scope["method"] == "POST":
                message = await receive()
                posted = _parsed(message.get("body", b""))
                await self._serve_posted(scope, _again(message, receive), send, posted)
            else:
                await self._serve_session(scope, receive, send, None)
        except EnvelopeError as error:
            status = 503 if error.error["code"] == EnvelopeError.BUSY else 400
            await Response(error.answer, status_code=status, media_type="application/json")(
                scope, receive, send
            )

    async def _serve_posted(
        self, scope: Scope, receive: Receive, send: Send, posted: dict[str, object]
    ) -> None:
        headers = Headers(scope=scope)
        has_session = SESSION_HEADER in headers and _is_of_sessions(headers)
        method, request_id = posted.get("method"), posted.get("id")
        if method == "notifications/cancelled" and not has_session:
            await self._without.cancel(posted.get("params"), scope)
            await Response(status_code=202)(scope, receive, send)
            return
        _check_version(posted, headers)
        if method is None or not isinstance(request_id, int | str):
            await self._serve_session(scope, receive, send, None)
        elif has_session or _is_of_sessions(headers):
            await self._serve_session(scope, receive, send, request_id)
        else:
            request = OpenRequest(request_id, scope, receive, send)
            with self._without.opened(request):
                await self._app(scope, request.receive, request.send)
                await request.settle()

    async def _serve_session(
        self, scope: Scope, receive: Receive, send: Send, request_id: int | str | None
    ) -> None:
        holder: Holder = scope[Holder.KEY]
        name = Headers(scope=scope).get(SESSION_HEADER)
        session = self._sessions.get(name) if name is not None else None
        request = None
        if session is not None and session.holder == account_of(holder) and request_id is not None:
            request = _begin(session, request_id)
            scope = {**scope, _REQUEST_KEY: request}
        is_answered, is_first = False, scope["method"] == "POST"

        async def watch(message: Message) -> None:
            nonlocal is_answered, is_first
            if message["type"] == "http.response.start":
                self._note(scope["method"], name, message, account_of(holder))
            elif not message.get("more_body", False):
                is_answered = True
            if is_first and message.get("body", b"").startswith(b"event:"):
                # within the first event: clients take an event without data for a broken message
                message, is_first = {**message, "body": _RETRY + message["body"]}, False
            await send(message)

        if name is None and request_id is not None:
            self._check_share(account_of(holder))
        if session is not None:
            session.open += 1
        try:
            await self._app(scope, receive, watch)
        finally:
            if request is not None:
                request.left(is_answered)
            if session is not None:
                session.open -= 1
                session.used_s = time.monotonic()

    def _check_share(self, holder: str) -> None:
        """Raise EnvelopeError if a holder would open one session too many."""
        count = sum(session.holder == holder for session in self._sessions.values())
        if count >= self._most_of_one:
            raise EnvelopeError(
                EnvelopeError.BUSY,
                f"{holder!r} has {count} sessions open already; end one, or use those.",
            )

    def _note(self, method: str, name: str | None, message: Message, holder: str) -> None:
        if message["status"] >= 400:
            return
        opened = MutableHeaders(scope=message).get(SESSION_HEADER)
        if opened is not None and name is None:
            self._sessions[opened] = _HttpSession(holder=holder, used_s=time.monotonic())
        if method == "DELETE" and name is not None and self._sessions.pop(name, None) is not None:
            self._on_end(name)

    def _forget_idle(self) -> None:
        """Discard sessions that were idle for the SDK's idle time."""
        now_s = time.monotonic()
        idle = [n for n, s in self._sessions.items() if not s.open and now_s - s.used_s > IDLE_S]
        for name in idle:
            del self._sessions[name]
            self._on_end(name)


async def note_handled(ctx: ServerRequestContext, call_next: CallNext) -> HandlerResult:
    """Middleware of the SDK's server: notifies the Sessions that the handler of a request has
    ended.
    """
    try:
        return await call_next(ctx)
    finally:
        found = ctx.request.scope.get(_REQUEST_KEY) if ctx.request is not None else None
        if isinstance(found, _SessionRequest):
            found.handled()


def _begin(session: _HttpSession, request_id: int | str) -> _SessionRequest:
    """Register a request. Raises EnvelopeError for an id in use."""
    from mcp.shared.dispatcher import coerce_request_id

    key = coerce_request_id(request_id)
    if key in session.ids or key == GET_STREAM_KEY or len(session.ids) >= _MOST_IDS:
        raise EnvelopeError.repeated(request_id)
    request = session.ids[key] = _SessionRequest(free=lambda: session.ids.pop(key, None))
    return request


def _parsed(body: bytes) -> dict[str, object]:
    """A posted message; empty for a body that the SDK will refuse.

    Raises:
        EnvelopeError: it is a request with an invalid id.
    """
    try:
        raw = from_json(body)
    except ValueError:
        return {}
    EnvelopeError.raise_for_id(raw)
    return raw if isinstance(raw, dict) else {}


def _is_of_sessions(headers: Headers) -> bool:
    """True unless the header names a protocol without sessions."""
    return headers.get(MCP_PROTOCOL_VERSION_HEADER) in (None, *HANDSHAKE_PROTOCOL_VERSIONS)


def _check_version(posted: dict[str, object], headers: Headers) -> None:
    """Raise EnvelopeError if header and body of a message name different protocols, of which one
    has no sessions: the SDK goes by the header alone, and would miss a session.

    Source: protocol 2026-07-28, basic/transports/streamable-http, Protocol Version Header.
    """
    params = posted.get("params")
    meta = params.get("_meta") if isinstance(params, dict) else None
    body = meta.get(PROTOCOL_VERSION_META_KEY) if isinstance(meta, dict) else None
    header = headers.get(MCP_PROTOCOL_VERSION_HEADER)
    is_known = body in HANDSHAKE_PROTOCOL_VERSIONS and _is_of_sessions(headers)
    if isinstance(body, str) and body != header and not is_known:
        named = "is missing" if header is None else f"says {header[:40]!r}"
        raise EnvelopeError(
            HEADER_MISMATCH,
            f"Header mismatch: the header MCP-Protocol-Version {named}, the body's _meta says "
            f"{body[:40]!r}; both must name the same protocol.",
            posted.get("id"),
        )


def _again(message: Message, receive: Receive) -> Receive:
    """Return a `receive` that yields a message before the rest."""
    first: list[Message] = [message]

    async def replay() -> Message:
        return first.pop() if first else await receive()

    return replay

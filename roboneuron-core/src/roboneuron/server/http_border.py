"""The border of the HTTP server: which hosts and pages may knock, and whose token a request carries."""

from __future__ import annotations

import logging

from mcp.server.auth.middleware.bearer_auth import AuthenticatedUser
from mcp.server.auth.provider import AccessToken
from mcp.server.transport_security import TransportSecurityMiddleware, TransportSecuritySettings
from starlette.datastructures import Headers
from starlette.requests import Request
from starlette.responses import JSONResponse
from starlette.types import ASGIApp, Receive, Scope, Send

from roboneuron.config import ServerConfig
from roboneuron.errors import ConfigurationError
from roboneuron.server.access import HOLDER_KEY, LOCAL_PROCESS, Holder
from roboneuron.server.lost import CONNECTION_KEY, Connection
from roboneuron.server.tokens import TokenTable

log = logging.getLogger(__name__)
_LOOPBACK_NAMES = ("127.0.0.1", "localhost", "[::1]")
_ANY_ADDRESS = ("0.0.0.0", "::", "")


def security_settings(section: ServerConfig) -> TransportSecuritySettings:
    """Host and Origin headers that are accepted.

    Raises:
        ConfigurationError: the server listens on every address and no name of this machine is given.
    """
    if section.host in _ANY_ADDRESS and not section.allowed_hosts:
        raise ConfigurationError(
            f"host = {section.host!r} listens on every address, so [server] must name in allowed_hosts how clients "
            "call this machine.",
            hint='Such as allowed_hosts = ["robot.lan", "192.168.1.20"].',
        )
    names = [*_LOOPBACK_NAMES, *section.allowed_hosts]
    if section.host not in _ANY_ADDRESS:
        names.append(f"[{section.host}]" if ":" in section.host else section.host)
    return TransportSecuritySettings(
        enable_dns_rebinding_protection=True,
        allowed_hosts=[text for name in names for text in (name, f"{name}:*")],
        allowed_origins=[*(f"http://{name}:*" for name in _LOOPBACK_NAMES), *section.allowed_origins],
    )


class Border:
    """ASGI application around another: checks Host and Origin, then the token, and notes the Holder in the scope.

    Without tokens everybody who gets here is a local process with every role; `serve_http` sees to it that this is so
    on loopback only.
    """

    def __init__(self, app: ASGIApp, security: TransportSecuritySettings, tokens: TokenTable) -> None:
        self._app = app
        self._security = TransportSecurityMiddleware(security)
        self._tokens = tokens

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        refusal = await self._security.validate_request(Request(scope))
        if refusal is not None:
            await refusal(scope, receive, send)
            return
        holder = self._holder(Headers(scope=scope).getlist("authorization"))
        if holder is None:
            log.warning("Refused a request without a valid token.")
            await _unauthorized()(scope, receive, send)
            return
        # The SDK binds a session to this user: a session of one token cannot be used with another.
        user = AuthenticatedUser(AccessToken(token="", client_id=holder.who, scopes=[holder.role]))
        connection = Connection(receive)
        inner = {**scope, HOLDER_KEY: holder, CONNECTION_KEY: connection, "user": user}
        await self._app(inner, connection.receive, send)

    def _holder(self, headers: list[str]) -> Holder | None:
        if not self._tokens:
            return LOCAL_PROCESS
        if len(headers) != 1:
            return None
        scheme, _, token = headers[0].partition(" ")
        return self._tokens.find(token.strip()) if scheme.lower() == "bearer" else None


def _unauthorized() -> JSONResponse:
    text = "A valid bearer token is needed: send the header `Authorization: Bearer <token>`."
    return JSONResponse(
        {"jsonrpc": "2.0", "id": None, "error": {"code": -32001, "message": text}},
        status_code=401,
        headers={"WWW-Authenticate": 'Bearer realm="roboneuron"'},
    )

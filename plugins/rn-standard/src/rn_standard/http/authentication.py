"""Backends of starlette's AuthenticationMiddleware: clients with a token of `[[http.tokens]]`, or
without tokens clients of this machine.

Both return the SDK's AuthenticatedUser. The SDK binds a session to its `client_id`, so a session of
one token cannot be used with another.
"""

from __future__ import annotations

from mcp.server.auth.middleware.bearer_auth import AuthenticatedUser, BearerAuthBackend
from mcp.server.auth.provider import AccessToken, TokenVerifier
from starlette.authentication import AuthCredentials, AuthenticationBackend, AuthenticationError
from starlette.requests import HTTPConnection

from rn_standard.http.connections import ConnectionTable
from rn_standard.http.local_clients import account_of
from rn_standard.http.peers import process_of, protocol_of
from rn_standard.http.sessions import SESSION_HEADER
from rn_standard.http.tokens import TokenTable
from roboneuron.feature import Holder

_CLIENT = "client"
"""Claim of a client without a token: its session or process."""


class TableVerifier(TokenVerifier):
    """Verifies a token with a TokenTable, in constant time."""

    def __init__(self, tokens: TokenTable) -> None:
        self._tokens = tokens

    async def verify_token(self, token: str) -> AccessToken | None:
        """See TokenVerifier."""
        holder = self._tokens.find(token.strip())
        return None if holder is None else _access_token(holder)


class TokenBackend(BearerAuthBackend):
    """Requires a valid token for every request."""

    def __init__(self, tokens: TokenTable) -> None:
        super().__init__(TableVerifier(tokens))

    async def authenticate(self, conn: HTTPConnection) -> tuple[AuthCredentials, AuthenticatedUser]:
        """See AuthenticationBackend.

        Raises:
            AuthenticationError: no valid token. RequireAuthMiddleware of the SDK is not used,
                because its answer does not name the expected header, and keeps the connection open.
        """
        # of two headers the SDK reads the first, because it expects one; a proxy may read the other
        found: tuple[AuthCredentials, AuthenticatedUser] | None = None
        if len(conn.headers.getlist("authorization")) == 1:
            found = await super().authenticate(conn)
        if found is None:
            raise AuthenticationError(
                "A valid bearer token is needed: send the header `Authorization: Bearer <token>`."
            )
        return found


class LocalBackend(AuthenticationBackend):
    """Accepts every client as a process of this machine with every role; `server.listen` ensures
    that this is used on loopback only.

    Clients are distinguished by their session or, in protocols without sessions, by their process.

    Args:
        connections: notified that a connection must not be dropped in favour of others.
    """

    def __init__(self, connections: ConnectionTable) -> None:
        self._connections = connections

    async def authenticate(self, conn: HTTPConnection) -> tuple[AuthCredentials, AuthenticatedUser]:
        """See AuthenticationBackend."""
        protocol = protocol_of(conn)
        if protocol is not None:
            # before the look-up of its process, which takes milliseconds
            self._connections.keep(protocol)
        session = conn.headers.get(SESSION_HEADER)
        name = await process_of(conn) if session is None else session_name(session)
        user = AuthenticatedUser(_access_token(Holder.local(name)))
        return AuthCredentials(user.scopes), user


def holder_of(user: AuthenticatedUser) -> Holder:
    """Return the Holder that one of these backends has determined."""
    token = user.access_token
    if token.claims is not None:
        return Holder.local(token.claims[_CLIENT])
    return Holder(who=token.client_id, role=token.scopes[0])


def session_name(session: str) -> str:
    """Name of a client without a token, from its session."""
    return f"session {''.join(c for c in session[:8] if c.isalnum())}"


def _access_token(holder: Holder) -> AccessToken:
    claims = {_CLIENT: holder.client} if Holder.is_local(holder.who) else None
    return AccessToken(token="", client_id=account_of(holder), scopes=[holder.role], claims=claims)

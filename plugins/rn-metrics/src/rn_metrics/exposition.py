"""Metrics endpoint of a process: the metrics of its robots, each with the label `robot`."""

from __future__ import annotations

import asyncio
import ipaddress
import socket
import threading
from collections.abc import Iterator
from typing import ClassVar

from prometheus_client import CollectorRegistry
from prometheus_client.core import Metric
from prometheus_client.exposition import choose_encoder
from starlette.authentication import AuthenticationError
from starlette.datastructures import Headers
from starlette.middleware.authentication import AuthenticationMiddleware
from starlette.requests import HTTPConnection
from starlette.responses import PlainTextResponse, Response
from starlette.types import ASGIApp, Receive, Scope, Send

from rn_standard.http.addresses import bind
from rn_standard.http.authentication import TokenBackend
from rn_standard.http.bounded_server import BoundedServer
from rn_standard.http.connections import ConnectionTable
from rn_standard.http.listener import BoundedListener, other_bounds
from rn_standard.http.origins import HostRules
from rn_standard.http.tokens import TokenTable
from roboneuron import NotReadyError

PATH = "/metrics"
_BEGIN_S = 20.0
_JOIN_S = 5.0
_CONNECTIONS = 32
_CLOSE = {"Connection": "close"}
"""Headers of an answer: a scrape is one request, and a kept connection would only use a slot."""


class Exposition:
    """Serves registries at an address from the first `join` to the last `leave`; callable from any
    thread.

    The robots of a server share the configured address, because a port belongs to the process, as
    does the table of endpoints. Source of the format: one family for each name (Prometheus text
    format 0.0.4).
    """

    _in_use: ClassVar[dict[tuple[str, int], Exposition]] = {}
    _lock: ClassVar[threading.Lock] = threading.Lock()

    def __init__(self, host: str, port: int, rules: HostRules, tokens: TokenTable) -> None:
        """Listen. Raises ConfigurationError if the address cannot be used, NotReadyError if it
        takes too long.
        """
        self._address = (host, port)
        self._rules = rules
        self._robots: dict[str, CollectorRegistry] = {}
        bound = bind("metrics", host, port, tokens)
        self.port: int = bound.getsockname()[1]
        address = ipaddress.ip_address(bound.getsockname()[0].partition("%")[0])
        self._metrics: ASGIApp = (
            self._encode
            if address.is_loopback
            else AuthenticationMiddleware(self._encode, TokenBackend(tokens), _unauthorized)
        )
        self._own = CollectorRegistry()
        self._own.register(self)
        self._server = _ExpositionServer(self._answer, ConnectionTable())
        self._thread = threading.Thread(
            target=self._serve, args=(bound,), name="metrics-port", daemon=True
        )
        self._thread.start()
        if not self._server.has_begun.wait(_BEGIN_S):
            self._server.should_exit = True
            raise NotReadyError(
                f"The metrics of {host}:{self.port} were not served within {_BEGIN_S:g} s."
            )

    @classmethod
    def join(
        cls,
        host: str,
        port: int,
        robot: str,
        registry: CollectorRegistry,
        rules: HostRules,
        tokens: TokenTable,
    ) -> Exposition:
        """Serve the metrics of a robot at an address, together with those of other robots.

        Args:
            host, port: as configured; robots with port 0 share a free one.
            robot: its namespace.
            registry: its metrics.
            rules: permitted names of this machine.
            tokens: required if the address is not loopback.

        Raises:
            ConfigurationError: the address cannot be used, or needs a token.
        """
        with cls._lock:
            found = cls._in_use.get((host, port))
            if found is None:
                found = cls._in_use[host, port] = cls(host, port, rules, tokens)
            # a scrape may be reading the previous one
            found._robots = {**found._robots, robot: registry}
            return found

    def leave(self, robot: str) -> None:
        """Stop serving this robot; the last one ends the endpoint."""
        with self._lock:
            self._robots = {
                name: registry for name, registry in self._robots.items() if name != robot
            }
            if self._robots or self._in_use.get(self._address) is not self:
                return
            del self._in_use[self._address]
        self._server.should_exit = True
        self._thread.join(_JOIN_S)

    def collect(self) -> Iterator[Metric]:
        """See prometheus_client; on the thread of the endpoint."""
        families: dict[str, Metric] = {}
        for robot, registry in self._robots.items():
            for metric in registry.collect():
                family = families.setdefault(
                    metric.name, Metric(metric.name, metric.documentation, metric.type)
                )
                family.samples += [
                    sample._replace(labels={"robot": robot, **sample.labels})
                    for sample in metric.samples
                ]
        yield from families.values()

    def _serve(self, bound: socket.socket) -> None:
        with BoundedListener(bound, other_bounds(_CONNECTIONS)) as listener:
            asyncio.run(self._server.serve(sockets=[listener]))

    async def _answer(self, scope: Scope, receive: Receive, send: Send) -> None:
        await self._application(scope)(scope, receive, send)

    def _application(self, scope: Scope) -> ASGIApp:
        if not self._rules.allows_host(Headers(scope=scope).getlist("host")):
            return PlainTextResponse("Invalid Host header\n", 421, _CLOSE)
        if scope["path"] != PATH:
            return PlainTextResponse(f"Metrics are at {PATH}\n", 404, _CLOSE)
        if scope["method"] != "GET":
            return PlainTextResponse("Use GET\n", 405, {"Allow": "GET", **_CLOSE})
        return self._metrics

    async def _encode(self, scope: Scope, receive: Receive, send: Send) -> None:
        encode, content_type = choose_encoder(Headers(scope=scope).get("accept", ""))
        headers = {"Content-Type": content_type, **_CLOSE}
        await Response(encode(self._own), headers=headers)(scope, receive, send)


def _unauthorized(conn: HTTPConnection, error: AuthenticationError) -> Response:
    return PlainTextResponse(
        "A valid bearer token of [[http.tokens]] is needed.\n",
        401,
        {"WWW-Authenticate": "Bearer", **_CLOSE},
    )


class _ExpositionServer(BoundedServer):
    """Logs when it serves."""

    def __init__(self, app: ASGIApp, connections: ConnectionTable) -> None:
        super().__init__(app, connections)
        self.has_begun = threading.Event()

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        self.has_begun.set()

"""The network side of `roboneuron serve-policy`: admits robots, and forwards their messages to the
process of the model that they name.
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from http import HTTPStatus
from pathlib import Path
from typing import Protocol

from websockets.asyncio.server import Server, ServerConnection
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request

from rn_backend_openpi.description import READY
from rn_backend_openpi.listener import Listener
from rn_backend_openpi.messages import Document
from rn_backend_openpi.processes import ModelProcess
from rn_backend_openpi.security import Guard
from rn_backend_openpi.server_options import PolicyServerOptions, ServedModelOptions
from rn_backend_openpi.statistics import Times
from rn_backend_openpi.status_page import STATUS, page
from roboneuron import ConfigurationError, ForeignDataError

log = logging.getLogger(__name__)
HEALTH = "/healthz"
"""Page for a balancer: status 200 if every model is ready, otherwise 503."""
_LOOK_S = 0.1
_KEYS_LOOK_S = 0.5
_TELL_S = 10.0
"""Period of the log's summary of refused connections, so that strangers cannot fill the log [s]."""
_BACKLOG = 1024
_PROBE_S = 0.5


class RelayedModel(Protocol):
    """One model of a server, used from `start` to `close`."""

    name: str

    @property
    def state(self) -> str:
        """`LOADING`, `READY`, `FAILED` or `DEAD`."""

    def start(self) -> None:
        """Start loading; returns at once."""

    def stop(self) -> None:
        """Request the end."""

    def close(self) -> None:
        """End, and wait for it; idempotent."""

    def status(self) -> Document:
        """Statistics."""

    async def relay(self, robot: ServerConnection, note: Callable[[float], None]) -> int:
        """Answer a robot until it disconnects; returns the number of lost observations.

        Args:
            robot: its connection.
            note: called with the time of each answer [s].
        """


MakeModel = Callable[[str, ServedModelOptions, Path], RelayedModel]


class PolicyServer:
    """Serves several models to authenticated robots.

    Args:
        options: options of the server.
        folder: folder for sockets and logs, accessible only to this user.
        name: name of the server among others in the folder.
        tell: called with the port once all models are ready.
        make_model: creates a model from its name, its options, and the path of a socket.
    """

    def __init__(
        self,
        options: PolicyServerOptions,
        folder: Path,
        name: str,
        tell: Callable[[int], object] = lambda port: None,
        make_model: MakeModel = ModelProcess,
    ) -> None:
        self._options, self._tell = options, tell
        self._guard = Guard(options.listen)
        self.path = folder / f"{name}.sock"
        self.models: dict[str, RelayedModel] = {
            model: make_model(model, given, folder / f"{name}-{model}.sock")
            for model, given in options.models.items()
        }
        self._end = threading.Event()
        pages = {HEALTH: self._health_page}
        most = options.listen.robots
        self._robots = Listener(self._relay, most=most, admit=self._admit, pages=pages)
        self._local = Listener(
            self._relay, most=0, admit=self._refuse, pages={STATUS: self._status_page}
        )
        self._lost: Counter[str] = Counter()
        self._served = {name: Times() for name in options.models}
        self._told, self._told_s = 0, 0.0
        self.has_begun = threading.Event()
        self.port = self.metrics_port = 0

    def run(self) -> int:
        """Serve until `stop` is called; returns the exit status.

        Raises:
            ConfigurationError: the address cannot be used.
        """
        with self._metrics(), _network_listener(self._options) as network:
            _check_alone(self.path)
            self.port = network.getsockname()[1]
            for model in self.models.values():
                model.start()
            try:
                asyncio.run(self._serve(network))
            finally:
                self.path.unlink(missing_ok=True)
                for model in self.models.values():
                    model.stop()
                for model in self.models.values():
                    model.close()
        return 0

    def stop(self) -> None:
        """Request the end; callable from a signal handler."""
        self._end.set()

    def status(self) -> Document:
        """Statistics of the server and of its models; from any thread but the event loop's."""
        listen = self._options.listen
        models = {
            name: {
                **model.status(),
                "lost": self._lost[name],
                "served_times": self._served[name].document(),
            }
            for name, model in self.models.items()
        }
        return {
            "address": f"{listen.host}:{self.port}",
            "keys": listen.keys,
            "pid": os.getpid(),
            "robots": len(self._robots.clients),
            "metrics_port": self.metrics_port,
            "refused_connections": self._robots.refused,
            "models": models,
        }

    async def _serve(self, network: socket.socket) -> None:
        """Serve until the end; robots have to connect anew when the keys of the link change."""
        listen = self._options.listen
        async with await self._local.open_local(str(self.path)):
            log.info("Robots connect to %s:%d (keys: %s).", listen.host, self.port, listen.keys)
            opened = await self._open(network)
            self.has_begun.set()
            _notify_manager()
            looked_s, is_told = 0.0, False
            while not self._end.is_set():
                await asyncio.sleep(_LOOK_S)
                if not is_told and self._is_ready:
                    self._tell(self.port)
                    is_told = True
                now_s = time.monotonic()
                if now_s - looked_s < _KEYS_LOOK_S:
                    continue
                looked_s = now_s
                self._tell_refusals(now_s)
                if self._guard.has_changed():
                    log.warning("The keys of the link have changed; robots must reconnect.")
                    await self._close(opened)
                    opened = await self._open(network)
            await self._drain()
            await self._close(opened)

    async def _drain(self) -> None:
        """Answer the robots that are connected for a while, until they have left."""
        until_s = time.monotonic() + self._options.listen.drain_s
        while self._robots.clients and time.monotonic() < until_s:
            await asyncio.sleep(_LOOK_S)

    async def _open(self, network: socket.socket) -> Server | None:
        """Accept robots with the keys of now; None if this machine is paired with no other."""
        try:
            context = self._guard.context
        except ConnectionError as error:
            log.warning("No robot can connect: %s.", error)
            return None
        return await self._robots.open(network.dup(), context)

    def _admit(
        self, connection: ServerConnection, request: Request
    ) -> tuple[HTTPStatus, str] | None:
        if not self._guard.is_admitted(request.headers.get_all("Authorization")):
            return HTTPStatus.UNAUTHORIZED, ""
        if self._end.is_set():
            return HTTPStatus.SERVICE_UNAVAILABLE, "The server is being stopped."
        if self._model_of(request) is None:
            wanted = request.path.strip("/")
            told = f"This server has no model {wanted!r}." if wanted else "It has several models."
            return HTTPStatus.NOT_FOUND, f"{told} Name one with `model`: {', '.join(self.models)}."
        return None

    def _refuse(
        self, connection: ServerConnection, request: Request
    ) -> tuple[HTTPStatus, str] | None:
        return HTTPStatus.NOT_FOUND, ""

    def _model_of(self, request: Request) -> RelayedModel | None:
        """The model named by a path; that of a server with one model needs no name."""
        wanted = request.path.strip("/")
        if not wanted and len(self.models) == 1:
            return next(iter(self.models.values()))
        return self.models.get(wanted)

    async def _relay(self, robot: ServerConnection) -> None:
        """Let the model that a robot names answer it until it disconnects."""
        assert robot.request is not None
        model = self._model_of(robot.request)
        assert model is not None
        log.info("A robot at %s uses the model %s.", robot.remote_address, model.name)
        with suppress(ConnectionClosed):
            self._lost[model.name] += await model.relay(robot, self._served[model.name].note)
        log.info("A robot at %s has disconnected.", robot.remote_address)

    @property
    def _is_ready(self) -> bool:
        return all(model.state == READY for model in self.models.values())

    def _health_page(self) -> tuple[HTTPStatus, str]:
        if self._end.is_set():
            return HTTPStatus.SERVICE_UNAVAILABLE, "the server is being stopped\n"
        if self._is_ready:
            return HTTPStatus.OK, "OK\n"
        return HTTPStatus.SERVICE_UNAVAILABLE, "a model is not ready\n"

    def _status_page(self) -> tuple[HTTPStatus, str]:
        return HTTPStatus.OK, json.dumps(self.status())

    def _tell_refusals(self, now_s: float) -> None:
        refused = self._robots.refused
        if refused > self._told and now_s - self._told_s > _TELL_S:
            log.warning("%d connections were refused.", refused - self._told)
            self._told, self._told_s = refused, now_s

    async def _close(self, opened: Server | None) -> None:
        """Accept no more robots, and disconnect those that there are."""
        if opened is None:
            return
        for robot in list(self._robots.clients):
            robot.transport.abort()
        opened.close()
        await opened.wait_closed()

    @contextmanager
    def _metrics(self) -> Iterator[None]:
        """Serve the metrics within the context, if the options name a port. Raises as
        `MetricsEndpoint`.
        """
        listen = self._options.listen
        if listen.metrics_port is None:
            yield
            return
        from rn_backend_openpi.metrics import MetricsEndpoint

        endpoint = MetricsEndpoint(listen.metrics_host, listen.metrics_port, self.status)
        self.metrics_port = endpoint.port
        log.info("Metrics are at http://%s:%d/metrics.", listen.metrics_host, endpoint.port)
        try:
            yield
        finally:
            endpoint.close()


def _network_listener(options: PolicyServerOptions) -> socket.socket:
    """Create the listening TCP socket. Raises ConfigurationError if the address cannot be used."""
    listen = options.listen
    try:
        return socket.create_server((listen.host, listen.port), backlog=_BACKLOG)
    except OSError as error:
        raise ConfigurationError(
            f"The policy server cannot listen on {listen.host}:{listen.port}: "
            f"{error.strerror or error}.",
            hint="Is another one running? Choose another host or port in [listen].",
        ) from error


def _check_alone(path: Path) -> None:
    """Raise ConfigurationError if another server of the same file is running."""
    try:
        page(path, _PROBE_S)
    except (FileNotFoundError, ConnectionRefusedError):
        return
    except (OSError, ForeignDataError):
        pass
    raise ConfigurationError(
        "A policy server of this file is already running.",
        hint="See `roboneuron serve-policy status`.",
    )


def _notify_manager() -> None:
    """Notify systemd that the service is ready. Source: sd_notify(3)."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as told, suppress(OSError):
        told.connect(f"\0{address[1:]}" if address.startswith("@") else address)
        told.send(b"READY=1")

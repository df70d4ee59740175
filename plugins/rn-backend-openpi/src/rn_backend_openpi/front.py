"""The network side of `roboneuron policy serve`: admits robots, and forwards their messages to the
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
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, ExitStack, asynccontextmanager, suppress
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING

from websockets.asyncio.server import Server, ServerConnection
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request

from rn_backend_openpi.description import READY
from rn_backend_openpi.listener import Answer, Listener, address_of, listening
from rn_backend_openpi.messages import Document
from rn_backend_openpi.processes import ModelProcess
from rn_backend_openpi.security import Guard
from rn_backend_openpi.server_options import PolicyServerOptions, ServedModelOptions
from rn_backend_openpi.statistics import STATUS, Times, page
from roboneuron import ConfigurationError, ForeignDataError

if TYPE_CHECKING:
    from rn_backend_openpi.ray_engine import RayModel

log = logging.getLogger(__name__)
HEALTH = "/healthz"
"""Page for a balancer: status 200 if every model is ready, otherwise 503."""
_LOOK_S = 0.1
_KEYS_LOOK_S = 0.5
_TELL_S = 10.0
"""Period of the log's summary of refused connections, so that strangers cannot fill the log [s]."""
_PROBE_S = 0.5
MakeModel = Callable[[str, ServedModelOptions, Path], "ModelProcess | RayModel"]
"""Makes a model of a server: from its name, its options, and the path of a socket."""


class PolicyServer:
    """Serves several models to authenticated robots.

    Args:
        options: options of the server.
        folder: folder for sockets and logs, accessible only to this user.
        name: name of the server among others in the folder.
        tell: called with the port once all models are ready.
        make_model: see `MakeModel`.
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
        self.models = {
            model: make_model(model, given, folder / f"{name}-{model}.sock")
            for model, given in options.models.items()
        }
        self._end = threading.Event()
        self._robots = Listener(
            self._relay,
            most=options.listen.robots,
            admit=self._admit,
            pages={HEALTH: self._health_page},
        )
        self._local = Listener(self._relay, most=0, pages={STATUS: self._status_page})
        self._lost: Counter[str] = Counter()
        self._served = {name: Times() for name in options.models}
        self._told, self._told_s = 0, 0.0
        self.has_begun = threading.Event()
        self.port = self.metrics_port = 0

    def run(self) -> int:
        """Serve until `stop` is called; returns the exit status.

        Raises:
            ConfigurationError: an address cannot be used.
        """
        listen = self._options.listen
        with ExitStack() as undo:
            network = undo.enter_context(listening(listen.host, listen.port, "port"))
            scraped = list[socket.socket]()
            if listen.metrics_port is not None:
                place = listening(listen.metrics_host, listen.metrics_port, "metrics_port")
                scraped = undo.enter_context(place)
                self.metrics_port = scraped[0].getsockname()[1]
            _check_alone(self.path)
            self.port = network[0].getsockname()[1]
            for model in self.models.values():
                model.start()
            try:
                asyncio.run(self._serve(network, scraped))
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
            "address": address_of(listen.host, self.port),
            "keys": listen.keys,
            "pid": os.getpid(),
            "robots": len(self._robots.clients),
            "metrics_port": self.metrics_port,
            "refused_connections": self._robots.refused,
            "models": models,
        }

    async def _serve(self, network: list[socket.socket], scraped: list[socket.socket]) -> None:
        """Serve until the end; robots have to connect anew when the keys of the link change."""
        listen = self._options.listen
        async with AsyncExitStack() as opened:
            await opened.enter_async_context(await self._local.open_local(str(self.path)))
            if scraped:
                await opened.enter_async_context(self._scraped(scraped))
            name = address_of(listen.host, self.port)
            log.info("Robots connect to %s (keys: %s).", name, listen.keys)
            robots = await self._open(network)
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
                    await self._close(robots)
                    robots = await self._open(network)
            # those that are connected are answered for a while, until they have left
            until_s = time.monotonic() + listen.drain_s
            while self._robots.clients and time.monotonic() < until_s:
                await asyncio.sleep(_LOOK_S)
            await self._close(robots)

    async def _open(self, network: list[socket.socket]) -> list[Server]:
        """Accept robots with the keys of now; none if this machine is paired with no other."""
        try:
            context = self._guard.context
        except ConnectionError as error:
            log.warning("No robot can connect: %s.", error)
            return []
        return [await self._robots.open(one.dup(), context) for one in network]

    async def _close(self, opened: list[Server]) -> None:
        """Accept no more robots, and disconnect those that there are."""
        for robot in list(self._robots.clients):
            robot.transport.abort()
        for server in opened:
            server.close()
            await server.wait_closed()

    @asynccontextmanager
    async def _scraped(self, sockets: list[socket.socket]) -> AsyncIterator[None]:
        """Answer scrapes of the metrics within the context, several at a time."""
        from rn_backend_openpi.metrics import PolicyMetrics  # heavy

        metrics = PolicyMetrics(self.status)
        pages = {"/metrics": lambda: (HTTPStatus.OK, metrics.page())}
        scraped = Listener(self._relay, most=0, pages=pages)
        name = address_of(self._options.listen.metrics_host, self.metrics_port)
        log.info("Metrics are at http://%s/metrics.", name)
        async with AsyncExitStack() as opened:
            for one in sockets:
                await opened.enter_async_context(await scraped.open(one.dup(), None))
            yield

    def _admit(self, connection: ServerConnection, request: Request) -> Answer | None:
        if not self._guard.is_admitted(request.headers.get_all("Authorization")):
            return HTTPStatus.UNAUTHORIZED, ""
        if self._end.is_set():
            return HTTPStatus.SERVICE_UNAVAILABLE, "The server is being stopped."
        if self._model_of(request) is None:
            wanted = request.path.strip("/")
            told = f"This server has no model {wanted!r}." if wanted else "It has several models."
            return HTTPStatus.NOT_FOUND, f"{told} Name one with `model`: {', '.join(self.models)}."
        return None

    def _model_of(self, request: Request) -> ModelProcess | RayModel | None:
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

    def _health_page(self) -> Answer:
        if self._end.is_set():
            return HTTPStatus.SERVICE_UNAVAILABLE, "the server is being stopped\n"
        if self._is_ready:
            return HTTPStatus.OK, "OK\n"
        return HTTPStatus.SERVICE_UNAVAILABLE, "a model is not ready\n"

    def _status_page(self) -> Answer:
        return HTTPStatus.OK, json.dumps(self.status())

    def _tell_refusals(self, now_s: float) -> None:
        refused = self._robots.refused
        if refused > self._told and now_s - self._told_s > _TELL_S:
            log.warning("%d connections were refused.", refused - self._told)
            self._told, self._told_s = refused, now_s


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
        hint="See `roboneuron policy serve status`.",
    )


def _notify_manager() -> None:
    """Notify systemd that the service is ready. Source: sd_notify(3)."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as told, suppress(OSError):
        told.connect(f"\0{address[1:]}" if address.startswith("@") else address)
        told.send(b"READY=1")

"""The network side of `roboneuron serve-policy`: admits robots, and forwards their frames to the
process of the model that they name.
"""

from __future__ import annotations

import logging
import os
import socket
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rn_backend_shared.admission import AdmissionTable
from rn_backend_shared.channel import FrameChannel, peer_user
from rn_backend_shared.fields import text
from rn_backend_shared.frames import Document, FrameKind, Header
from rn_backend_shared.listening import (
    connections,
    local_listener,
    network_listener,
    notify_manager,
)
from rn_backend_shared.options import PolicyServerOptions
from rn_backend_shared.replicas import Replicas
from rn_backend_shared.security import Guard, is_same_token
from rn_backend_shared.statistics import Times
from rn_backend_shared.visitor import HELLO_BYTES, Patience, Visitor
from roboneuron import (
    ConfigurationError,
    ForeignDataError,
)

log = logging.getLogger(__name__)
_ADMIT_S = 5.0
"""Time limit of handshake and identification of a new connection [s]."""
_MOST_UNKNOWN = 64
"""Limit of unidentified connections; beyond it, the oldest one of the address with the most is
ended.
"""
_MOST_THREADS = 512
_FRAME_S = 10.0
"""Time limit for receiving one frame [s]."""
_LOOK_S = 0.1
_KEYS_LOOK_S = 0.5
_TELL_S = 10.0
"""Period of the log's summary of refused connections, so that strangers cannot fill the log [s]."""


class PolicyServer:
    """Serves several models, each in its own process, to authenticated robots.

    Args:
        options: options of the server.
        folder: folder for sockets and logs, accessible only to this user.
        name: name of the server among others in the folder.
    """

    def __init__(self, options: PolicyServerOptions, folder: Path, name: str) -> None:
        self._options = options
        self._guard = Guard(options.listen)
        self.path = folder / f"{name}.sock"
        self.models = {
            model: Replicas(model, given, folder, name) for model, given in options.models.items()
        }
        self._end = threading.Event()
        self._lock = threading.Lock()
        self._table = AdmissionTable(options.listen.robots)
        self._lost: Counter[str] = Counter()
        self._served = {name: Times() for name in options.models}
        self.has_begun = threading.Event()
        self.port = self.metrics_port = 0

    def run(self) -> int:
        """Serve until `stop` is called; returns the exit status.

        Raises:
            ConfigurationError: the address cannot be used.
        """
        listen = self._options.listen
        with (
            self._metrics(),
            network_listener(listen.host, listen.port) as network,
            local_listener(self.path) as local,
        ):
            self.port = network.getsockname()[1]
            for model in self.models.values():
                model.start()
            threads = [
                threading.Thread(target=self._accept, args=(network,), name="accept", daemon=True),
                threading.Thread(target=self._tell, args=(local,), name="status", daemon=True),
            ]
            for thread in threads:
                thread.start()
            self.has_begun.set()
            log.info("Robots connect to %s:%d (keys: %s).", listen.host, self.port, listen.keys)
            notify_manager()
            try:
                self._watch()
            finally:
                self._end.set()
                self.path.unlink(missing_ok=True)
                self._table.interrupt_all()
                for model in self.models.values():
                    model.stop()
                for model in self.models.values():
                    model.close()
        return 0

    def stop(self) -> None:
        """Request the end; callable from a signal handler."""
        self._end.set()

    def status(self) -> Document:
        """Statistics of the server and of its models."""
        listen = self._options.listen
        own: Document = {
            "address": f"{listen.host}:{self.port}",
            "keys": listen.keys,
            "pid": os.getpid(),
            "robots": self._table.robots,
            "metrics_port": self.metrics_port,
            "refused_connections": self._table.refusals[0],
        }
        with self._lock:
            own_numbers = {
                name: {"lost": self._lost[name], "served_times": self._served[name].document()}
                for name in self.models
            }
        own["models"] = {
            name: {**model.status(), **own_numbers[name]} for name, model in self.models.items()
        }
        return own

    def admit(self, visitor: Visitor, hello: Document) -> Replicas:
        """Admit an introduced robot; returns the model that it named.

        Raises:
            ConnectionError: its token is wrong.
            ConfigurationError: there is no such model, or there are too many robots.
        """
        shown = text(hello.get("token") or "", "token", 2048)
        if self._guard.token and not is_same_token(shown, self._guard.token):
            raise ConnectionError("a wrong token")
        wanted = hello.get("model")
        names = list(self.models)
        name = names[0] if wanted is None and len(names) == 1 else text(wanted or "", "model", 64)
        if name not in self.models:
            raise ConfigurationError(
                f"This server has no model {name!r}."
                if name
                else "This server has several models.",
                hint=f"Name one with `model`: {', '.join(names)}.",
            )
        self._table.admit(visitor)
        return self.models[name]

    def leave(self, visitor: Visitor, why: str) -> None:
        """Remove a disconnected robot."""
        if self._table.leave(visitor, why):
            log.info("A robot at %s has disconnected: %s", visitor.address, why)

    def note_served(self, model: str, took_s: float) -> None:
        """See `VisitorServer`."""
        with self._lock:
            self._served[model].note(took_s)

    def note_lost(self, model: str) -> None:
        """Count an observation that was lost because its model was not available."""
        with self._lock:
            self._lost[model] += 1

    @contextmanager
    def _metrics(self) -> Iterator[None]:
        """Serve the metrics within the context, if the options name a port. Raises as
        `MetricsEndpoint`.
        """
        listen = self._options.listen
        if listen.metrics_port is None:
            yield
            return
        from rn_backend_shared.metrics import MetricsEndpoint

        endpoint = MetricsEndpoint(listen.metrics_host, listen.metrics_port, self.status)
        self.metrics_port = endpoint.port
        log.info("Metrics are at http://%s:%d/metrics.", listen.metrics_host, endpoint.port)
        try:
            yield
        finally:
            endpoint.close()

    def _watch(self) -> None:
        """Until the end: disconnect those that exceed time limits, and all robots when keys
        change.
        """
        looked_s = told_s = 0.0
        told = 0
        while not self._end.wait(_LOOK_S):
            now_s = time.monotonic()
            self._table.interrupt_late(_ADMIT_S)
            count, newest = self._table.refusals
            if count > told and now_s - told_s > _TELL_S:
                told_s = now_s
                log.warning("%d connections were refused, the newest from %s", count - told, newest)
                told = count
            if now_s - looked_s > _KEYS_LOOK_S:
                looked_s = now_s
                if self._guard.has_changed():
                    log.warning("The keys of the link have changed; robots must reconnect.")
                    self._table.interrupt_all()

    def _accept(self, listener: socket.socket) -> None:
        for connected, address in connections(listener, self._end, self._give_up_one):
            if threading.active_count() > _MOST_THREADS:
                connected.close()
                self._give_up_one()
                continue
            self._table.make_room(least=_MOST_UNKNOWN)
            patience = Patience(admit_s=_ADMIT_S, frame_s=_FRAME_S)
            try:
                visitor = Visitor(self, self._guard, connected, address, patience)
            except OSError as error:
                connected.close()
                self._table.note_refusal(address, str(error))
                continue
            self._table.add(visitor)
            try:
                threading.Thread(target=visitor.serve, name="robot", daemon=True).start()
            except RuntimeError as error:  # the system starts no more threads
                visitor.close(str(error))
                self._give_up_one()

    def _give_up_one(self) -> None:
        """End an unidentified connection, if there is one."""
        self._table.make_room(least=1)

    def _tell(self, listener: socket.socket) -> None:
        """Answer status requests, one after the other."""
        for connected, _ in connections(listener, self._end, self._give_up_one):
            with connected:
                try:
                    self._tell_one(connected)
                except (OSError, ForeignDataError):
                    pass
                except Exception:  # the border to one client: the next one is answered
                    log.exception("The status cannot be told.")

    def _tell_one(self, connected: socket.socket) -> None:
        """Answer a status request of this user. Raises OSError or ForeignDataError."""
        if peer_user(connected) != os.getuid():
            return
        channel = FrameChannel(connected, HELLO_BYTES)
        try:
            channel.receive(time.monotonic() + 1.0)
            channel.send(Header(FrameKind.STATUS), self.status(), 1.0)
        finally:
            channel.close()

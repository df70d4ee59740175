"""The network side of `roboneuron serve-policy`: admits robots, and carries their frames to the
process of the model that they name.
"""

from __future__ import annotations

import errno
import logging
import os
import socket
import ssl
import threading
import time
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from rn_backend_shared import wire
from rn_backend_shared.channel import Channel, Received
from rn_backend_shared.fields import text
from rn_backend_shared.frames import Document, FrameError, Header, Kind, VersionError
from rn_backend_shared.options import PolicyServerOptions
from rn_backend_shared.processes import ModelProcess
from rn_backend_shared.security import Guard, is_same_token, tune, valid_until
from rn_backend_shared.server import peer_user
from rn_backend_shared.session import FAILED
from roboneuron import ConfigurationError, NotReadyError, RoboNeuronError

log = logging.getLogger(__name__)
_BACKLOG = 1024
_ADMIT_S = 5.0
"""Whoever connects has this long to shake hands and to introduce itself."""
_MOST_UNKNOWN = 64
"""Connections that have not introduced themselves; the oldest of the address with most of them
gives way.
"""
_MOST_THREADS = 512
_HELLO_BYTES = 4096
_REQUEST_BYTES = 1 << 25
_FRAME_S = 10.0
"""A frame that takes longer to arrive is not waited for."""
_SEND_S = 2.0
_SILENT_S = 5.0
_SLICE_S = 0.5
_GRACE_S = 0.1
"""So much later than its deadline an answer of the model is passed on, for the robot to count."""
_LOOK_S = 0.1
_KEYS_LOOK_S = 0.5
_TELL_S = 10.0
"""How often the log tells of connections that were refused: strangers must not fill it."""
_NO_HANDLES = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)
_NO_HANDLES_S = 1.0


class PolicyServer:
    """Serves several models, each in a process of its own, to robots that prove who they are.

    Args:
        options: of the server.
        folder: for sockets and logs, this user's alone.
        name: of the server among others in the folder.
    """

    def __init__(self, options: PolicyServerOptions, folder: Path, name: str) -> None:
        self._options = options
        self._guard = Guard(options.listen)
        self.path = folder / f"{name}.sock"
        self.processes = {
            model: ModelProcess(model, given, folder / f"{name}-{model}.sock")
            for model, given in options.models.items()
        }
        self._end = threading.Event()
        self._lock = threading.Lock()
        self._unknown: dict[_Visitor, float] = {}
        self._robots: set[_Visitor] = set()
        self._counts: Counter[str] = Counter()
        self._newest_refusal = ""
        self.has_begun = threading.Event()
        self.port = 0

    def run(self) -> int:
        """Serve until `stop`; returns the exit status.

        Raises:
            ConfigurationError: the address cannot be used.
        """
        listen = self._options.listen
        with _listener(listen.host, listen.port) as network, _local_listener(self.path) as local:
            self.port = network.getsockname()[1]
            for process in self.processes.values():
                process.start()
            threads = [
                threading.Thread(target=self._accept, args=(network,), name="accept", daemon=True),
                threading.Thread(target=self._tell, args=(local,), name="status", daemon=True),
            ]
            for thread in threads:
                thread.start()
            self.has_begun.set()
            log.info("Robots connect to %s:%d (keys: %s).", listen.host, self.port, listen.keys)
            _notify_manager()
            try:
                self._watch()
            finally:
                self._end.set()
                self.path.unlink(missing_ok=True)
                self._interrupt_all()
                for process in self.processes.values():
                    process.stop()
                for process in self.processes.values():
                    process.close()
        return 0

    def stop(self) -> None:
        """End soon; callable from a signal handler."""
        self._end.set()

    def status(self) -> Document:
        """Numbers of the server and of its models."""
        listen = self._options.listen
        with self._lock:
            own: Document = {
                "address": f"{listen.host}:{self.port}",
                "keys": listen.keys,
                "pid": os.getpid(),
                "robots": len(self._robots),
                "refused_connections": self._counts["refused"],
            }
            lost = {name: self._counts[f"lost {name}"] for name in self.processes}
        own["models"] = {
            name: {**process.status(), "lost": lost[name]}
            for name, process in self.processes.items()
        }
        return own

    def admit(self, visitor: _Visitor, hello: Document) -> ModelProcess:
        """The model of a robot that has introduced itself, which is one of the robots from now on.

        Raises:
            ConnectionError: its token is wrong.
            ConfigurationError: there is no such model, or there are too many robots.
        """
        shown = text(hello.get("token") or "", "token", 2048)
        if self._guard.token and not is_same_token(shown, self._guard.token):
            raise ConnectionError("a wrong token")
        wanted = hello.get("model")
        names = list(self.processes)
        name = names[0] if wanted is None and len(names) == 1 else text(wanted or "", "model", 64)
        if name not in self.processes:
            raise ConfigurationError(
                f"This server has no model {name!r}."
                if name
                else "This server has several models.",
                hint=f"Name one with `model`: {', '.join(names)}.",
            )
        with self._lock:
            if len(self._robots) >= self._options.listen.robots:
                raise ConfigurationError(
                    f"{len(self._robots)} robots are connected to this server; no more are taken.",
                    hint="Raise `robots` in its [listen].",
                )
            if self._unknown.pop(visitor, None) is None:
                raise ConnectionError("it has taken too long")
            self._robots.add(visitor)
        return self.processes[name]

    def leave(self, visitor: _Visitor, why: str) -> None:
        """It is gone."""
        with self._lock:
            self._unknown.pop(visitor, None)
            is_robot = visitor in self._robots
            self._robots.discard(visitor)
            if not is_robot:
                self._counts["refused"] += 1
                self._newest_refusal = f"{visitor.address}: {why}"
        if is_robot:
            log.info("A robot at %s is gone: %s", visitor.address, why)

    def note_lost(self, model: str) -> None:
        """An observation whose model was not there."""
        with self._lock:
            self._counts[f"lost {model}"] += 1

    def _watch(self) -> None:
        """Until the end: hang up on those that have taken too long, and on all when keys change."""
        looked_s = told_s = 0.0
        told = 0
        while not self._end.wait(_LOOK_S):
            now_s = time.monotonic()
            with self._lock:
                late = [
                    visitor
                    for visitor, since_s in self._unknown.items()
                    if now_s - since_s > _ADMIT_S
                ]
            for visitor in late:
                visitor.interrupt()
            if self._counts["refused"] > told and now_s - told_s > _TELL_S:
                count, told_s = self._counts["refused"], now_s
                log.warning(
                    "%d connections were refused, the newest from %s",
                    count - told,
                    self._newest_refusal,
                )
                told = count
            if now_s - looked_s > _KEYS_LOOK_S:
                looked_s = now_s
                if self._guard.has_changed():
                    log.warning("The keys of the link have changed; robots connect again.")
                    self._interrupt_all()

    def _interrupt_all(self) -> None:
        with self._lock:
            visitors = [*self._unknown, *self._robots]
        for visitor in visitors:
            visitor.interrupt()

    def _accept(self, listener: socket.socket) -> None:
        while not self._end.is_set():
            try:
                connected, address = listener.accept()
            except OSError as error:
                if error.errno not in _NO_HANDLES:
                    return
                log.error("A robot cannot connect: %s.", error.strerror)
                self._make_room(least=1)
                self._end.wait(_NO_HANDLES_S)
                continue
            if threading.active_count() > _MOST_THREADS:
                connected.close()
                self._make_room(least=1)
                continue
            self._make_room(least=_MOST_UNKNOWN)
            try:
                visitor = _Visitor(self, self._guard, connected, str(address[0]))
            except OSError as error:
                connected.close()
                with self._lock:
                    self._counts["refused"] += 1
                    self._newest_refusal = f"{address[0]}: {error}"
                continue
            with self._lock:
                self._unknown[visitor] = time.monotonic()
            threading.Thread(target=visitor.serve, name="robot", daemon=True).start()

    def _make_room(self, *, least: int) -> None:
        """Hang up on the oldest unknown connection of the address with most of them, when there are
        `least` of them.
        """
        with self._lock:
            if len(self._unknown) < least:
                return
            most = Counter(visitor.address for visitor in self._unknown).most_common(1)
            address = most[0][0]
            visitor = next(one for one in self._unknown if one.address == address)
            del self._unknown[visitor]
        visitor.interrupt()

    def _tell(self, listener: socket.socket) -> None:
        """Answer questions for the status, one after the other."""
        while not self._end.is_set():
            try:
                connected, _ = listener.accept()
            except OSError:
                return
            with connected:
                if peer_user(connected) != os.getuid():
                    continue
                with suppress(OSError, FrameError):
                    channel = Channel(connected, _HELLO_BYTES)
                    channel.receive(time.monotonic() + 1.0)
                    channel.send(Header(Kind.STATUS), self.status(), 1.0)
                    channel.close()


class _Visitor:
    """One connection from the network, served on a thread of its own.

    Raises:
        OSError: nobody is to be talked to.
    """

    def __init__(
        self, server: PolicyServer, guard: Guard, connected: socket.socket, address: str
    ) -> None:
        self.address = address
        self._server = server
        tune(connected, _SILENT_S)
        connected.settimeout(_ADMIT_S)
        self._connected = guard.wrap(connected)
        self._channel: Channel | None = None
        self._expires: datetime | None = None
        self._model: Channel | None = None
        self._last = 0

    def serve(self) -> None:
        """Until it is gone."""
        why = "it was refused"
        try:
            if isinstance(self._connected, ssl.SSLSocket):
                self._connected.do_handshake()
            self._expires = valid_until(self._connected)
            channel = self._channel = Channel(self._connected, _HELLO_BYTES)
            received = channel.receive(time.monotonic() + _ADMIT_S)
            if received.header.kind is not Kind.HELLO:
                raise FrameError("it has not introduced itself")
            try:
                process = self._server.admit(self, received.document())
            except RoboNeuronError as error:
                refusal = {"state": FAILED, "pid": 0, **wire.from_answer(error)}
                channel.send(Header(Kind.WELCOME), refusal, _SEND_S)
                raise FrameError(str(error)) from error
            channel.most_bytes = _REQUEST_BYTES
            log.info("A robot at %s uses the model %s.", self.address, process.name)
            self._welcome(channel, process)
            while True:
                self._take(channel, process, self._next(channel))
        except VersionError as error:
            why = str(error)
            self._refuse_version(error)
        except (OSError, FrameError) as error:
            why = str(error)
        finally:
            self._server.leave(self, why)
            if self._model is not None:
                self._model.close()
            if self._channel is not None:
                self._channel.close()
            self._connected.close()

    def _refuse_version(self, error: VersionError) -> None:
        """Say it to whoever has shown a key; anybody else learns nothing."""
        if self._expires is None or self._channel is None:
            return
        refusal = ConfigurationError(f"The policy server refuses: {error}.")
        with suppress(OSError):
            self._channel.send(Header(Kind.ANSWER), wire.from_answer(refusal), _SEND_S)

    def interrupt(self) -> None:
        """End it, from another thread."""
        with suppress(OSError):
            # the method of SSLSocket would go on in clear
            socket.socket.shutdown(self._connected, socket.SHUT_RDWR)

    def _next(self, channel: Channel) -> Received:
        """The next frame, however long a robot is silent.

        Raises:
            OSError: it is gone, its certificate has expired, or a frame takes too long.
        """
        while True:
            with suppress(TimeoutError):
                return channel.receive(time.monotonic() + _SLICE_S)
            begun_s = channel.begun_s
            if begun_s is not None and time.monotonic() - begun_s > _FRAME_S:
                raise ConnectionError("a frame has not come whole in time")
            if self._expires is not None and datetime.now(UTC) > self._expires:
                raise ConnectionError("its certificate has expired")

    def _take(self, channel: Channel, process: ModelProcess, received: Received) -> None:
        header = received.header
        if header.kind is Kind.HELLO:
            self._welcome(channel, process)
            return
        if header.kind is not Kind.REQUEST or header.number <= self._last:
            raise FrameError(f"frame {header.number} of kind {header.kind} was not expected")
        self._last = header.number
        try:
            answer = self._carry(process, received)
        except NotReadyError as error:
            self._server.note_lost(process.name)
            told = Header(Kind.ANSWER, header.number, header.clock_ns)
            channel.send(told, wire.from_answer(error), _SEND_S)
        else:
            channel.send_parts([answer.header.pack(), answer.body], _SEND_S)

    def _welcome(self, channel: Channel, process: ModelProcess) -> None:
        """Tell what the model's own process says of itself."""
        told: Mapping[str, object] = process.welcome()
        with suppress(NotReadyError):
            told = self._connect(process)
        channel.send(Header(Kind.WELCOME), told, _SEND_S)

    def _connect(self, process: ModelProcess) -> Document:
        if self._model is not None:
            self._model.close()
            self._model = None
        self._model, welcome = process.connect()
        return welcome.document

    def _carry(self, process: ModelProcess, received: Received) -> Received:
        """The model's answer to a request.

        Raises:
            NotReadyError: it has died, is not ready, or does not answer by the deadline.
        """
        header = received.header
        deadline_s = time.monotonic() + header.left_s
        if self._model is None:
            self._connect(process)
        assert self._model is not None
        try:
            self._model.send_parts([header.pack(), received.body], header.left_s)
            while True:
                answer = self._model.receive(deadline_s + _GRACE_S)
                found = answer.header
                if (found.number, found.clock_ns) == (header.number, header.clock_ns):
                    return answer
        except TimeoutError as error:
            raise NotReadyError(
                f"The model {process.name!r} did not answer before the deadline."
            ) from error
        except (OSError, FrameError) as error:
            self._model.close()
            self._model = None
            raise NotReadyError(
                f"The model {process.name!r} has died; the server starts it again."
            ) from error


def _listener(host: str, port: int) -> socket.socket:
    try:
        return socket.create_server((host, port), backlog=_BACKLOG)
    except OSError as error:
        raise ConfigurationError(
            f"The policy server cannot listen on {host}:{port}: {error.strerror or error}.",
            hint="Does another one run there? Choose another host or port in [listen].",
        ) from error


def _local_listener(path: Path) -> socket.socket:
    listener = socket.socket(socket.AF_UNIX)
    try:
        with socket.socket(socket.AF_UNIX) as probe:
            if probe.connect_ex(str(path)) == 0:
                raise ConfigurationError(
                    "A policy server of this file runs already.",
                    hint="Look at it with `roboneuron serve-policy status`.",
                )
        path.unlink(missing_ok=True)
        listener.bind(str(path))
        listener.listen()
    except OSError as error:
        listener.close()
        raise ConfigurationError(f"The socket {path} cannot be made: {error}.") from error
    except ConfigurationError:
        listener.close()
        raise
    return listener


def _notify_manager() -> None:
    """Tell systemd that the service has begun. Source: sd_notify(3)."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as told, suppress(OSError):
        told.connect(f"\0{address[1:]}" if address.startswith("@") else address)
        told.send(b"READY=1")

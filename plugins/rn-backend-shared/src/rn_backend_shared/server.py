"""The server of one model: one socket, a thread for each connected robot, one for the model."""

from __future__ import annotations

import fcntl
import logging
import os
import secrets
import socket
import threading
import time
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from rn_backend_shared import wire
from rn_backend_shared.batching import Answer, Batcher, Waiting
from rn_backend_shared.channel import FrameChannel, Received, peer_process, peer_user
from rn_backend_shared.fields import field, text
from rn_backend_shared.frames import Document, FrameKind, Header, VersionError
from rn_backend_shared.images import CROPPED, crop
from rn_backend_shared.introduction import CLIENT, ROBOT, to_profile
from rn_backend_shared.listening import connections, outlast
from rn_backend_shared.model import SharedModel
from rn_backend_shared.options import SharedOptions
from rn_backend_shared.session import FAILED, LOADING, READY
from rn_backend_shared.statistics import Statistics
from roboneuron import (
    ActionChunk,
    ConfigurationError,
    ForeignDataError,
    InvalidInputError,
    NotReadyError,
    Observation,
    PluginError,
    RoboNeuronError,
)
from roboneuron.command import HangWatch

log = logging.getLogger(__name__)
_SEND_S = 0.5
"""Time without reading after which a robot is disconnected, so that it blocks nobody else."""
_FAILED_S = 3.0
"""Time for which a server that could not load reports this before it ends."""
_LOOK_S = 0.1
_BACKLOG = 1024
_MOST_HELD = 8
"""Number of chunk contexts kept for a robot: of the running chunk, and of answers in transit."""
_MOST_ROBOTS = 128
"""Limit of connections; each has a thread and two handles."""
_FIRST_S = 5.0
"""Time limit for a new connection's first request."""


class SharedModelServer:
    """Serves one model to all robots that connect.

    Args:
        options: options of the model.
        path: path of the socket.
        idle_s: time without a robot after which the server ends; None for never.
    """

    def __init__(self, options: SharedOptions, path: Path, idle_s: float | None) -> None:
        self._options = options
        self._path = path
        self._idle_s = idle_s
        self._model = SharedModel(options)
        self._batcher: Batcher | None = None
        self._robots: dict[_RobotConnection, None] = {}
        self._end = threading.Event()
        self._state = LOADING
        self._image_sizes: Mapping[str, tuple[int, int]] = {}
        self._failure: RoboNeuronError | None = None
        self._used_s = time.monotonic()
        self._statistics = Statistics()

    def run(self, watch: HangWatch | None = None) -> int:
        """Serve until `stop`, or idle; returns the exit status. Only one server serves a path at a
        time: a second one ends at once. `watch` is that of this process.
        """
        with self._path.with_suffix(".lock").open("a") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return 0
            with socket.socket(socket.AF_UNIX) as listener:
                # Renamed once it listens, so that a robot that finds the socket is not refused.
                unready = self._path.with_suffix(".new")
                unready.unlink(missing_ok=True)
                listener.bind(str(unready))
                listener.listen(_BACKLOG)
                unready.replace(self._path)
                threading.Thread(
                    target=self._accept, args=(listener,), name="accept", daemon=True
                ).start()
                try:
                    return self._serve(watch or HangWatch())
                finally:
                    self._path.unlink(missing_ok=True)
                    for robot in list(self._robots):
                        robot.close()

    def stop(self) -> None:
        """Request the end; callable from a signal handler."""
        self._end.set()

    def _serve(self, watch: HangWatch) -> int:
        try:
            with watch.loading():
                self._model.load()
        except RoboNeuronError as error:
            return self._fail(error)
        except (
            Exception
        ) as error:  # the border to the model: robots are notified before the process ends
            log.exception("The model cannot be loaded.")
            return self._fail(NotReadyError(f"The shared model cannot be loaded: {error!r}."))
        options = self._options
        batcher = self._batcher = Batcher(
            self._statistics.timed(self._model.answer),
            most=self._model.most,
            waiting=options.waiting,
            linger_s=options.linger_s,
            clients=lambda: sum(robot.has_asked for robot in list(self._robots)),
        )
        batcher.start()
        self._image_sizes = self._model.image_sizes
        self._state = READY
        log.info("The model %s is ready.", self._options.backend)
        self._used_s = time.monotonic()
        while not self._end.wait(_LOOK_S):
            now_s = time.monotonic()
            if any(robot.has_asked for robot in list(self._robots)):
                self._used_s = now_s
            elif self._idle_s is not None and now_s - self._used_s > self._idle_s:
                log.info("No robot for %g s.", self._idle_s)
                break
        batcher.close()
        self._model.close()
        return 0

    def _fail(self, error: RoboNeuronError) -> int:
        log.error("%s", error)
        self._failure, self._state = error, FAILED
        self._end.wait(_FAILED_S)
        return 1

    def hello(self, hello: Document) -> Document:
        """Welcome message: sent first, repeated while the model loads, and after a robot's
        introduction (see `from_profile`).

        Raises:
            ForeignDataError: the introduction is invalid.
        """
        told: Document = {"state": self._state, "pid": os.getpid()}
        if self._failure is not None:
            return told | wire.from_answer(self._failure)
        if self._state == READY:
            spec = self._model.spec
            told["cameras"] = list(spec.cameras)
            told["optional_cameras"] = list(spec.optional_cameras)
            told["horizon"] = spec.action_space.horizon
            told["step_s"] = spec.action_space.step_s
            told["most_committed"] = spec.max_committed_rows
            told["takes_state"] = spec.takes_predicted_state
            told["continues"] = self._model.continues_rows
            told["crops"] = {role: list(one) for role, one in self._options.crop.items()}
            told["image_sizes"] = {role: list(size) for role, size in self._image_sizes.items()}
            if ROBOT in hello:
                told |= self._space_on(hello[ROBOT])
        return told

    def _space_on(self, robot: object) -> Document:
        """The control space of the model's chunks on a robot, or why it cannot move it."""
        try:
            return {"space": wire.from_space(self._model.space_on(to_profile(robot)))}
        except ForeignDataError:  # no introduction; a refusal is for a model that does not fit
            raise
        except RoboNeuronError as error:
            return {"refusal": wire.from_answer(error)}

    def status(self) -> Document:
        """Statistics of this server."""
        asking = sum(robot.has_asked for robot in list(self._robots))
        return {
            "state": self._state,
            "pid": os.getpid(),
            "clients": asking,
            "waiting": 0 if self._batcher is None else self._batcher.waiting,
            **self._statistics.values(),
        }

    def cropped(self, observation: Observation, document: Document) -> Observation:
        """Crop the images that the robot has not cropped.

        Args:
            observation: the received observation.
            document: its document.

        Raises:
            InvalidInputError: the crop exceeds an image.
        """
        frames = dict(observation.frames)
        for role, rectangle in self._options.crop.items():
            if role in frames and not document["frames"][role].get(CROPPED, False):
                frames[role] = crop(frames[role], rectangle)
        return replace(observation, frames=frames)

    def submit(self, waiting: Waiting) -> None:
        """See `Batcher`."""
        if self._batcher is None:
            raise NotReadyError("The shared model is being loaded.")
        self._batcher.submit(waiting)

    def note(self, answer: Answer) -> None:
        """Count an answer."""
        self._statistics.note(answer)

    def leave(self, robot: _RobotConnection) -> None:
        """Remove a disconnected robot."""
        self._robots.pop(robot, None)

    def _accept(self, listener: socket.socket) -> None:
        """Accept connections until the end; if there are too many, one without requests is
        closed.
        """
        for connected, _ in connections(listener, self._end, self._drop_silent):
            try:
                user, process = peer_user(connected), peer_process(connected)
                channel = FrameChannel(connected)
            except OSError as error:  # there may be no second handle
                connected.close()
                log.error("A robot cannot connect: %s.", error.strerror or error)
                outlast(error, self._end, self._drop_silent)
                continue
            if user != os.getuid() or (
                len(self._robots) >= _MOST_ROBOTS and not self._drop_silent()
            ):
                channel.close()
                continue
            robot = _RobotConnection(channel, self, f"process {process}")
            self._robots[robot] = None
            try:
                threading.Thread(target=robot.serve, name="robot", daemon=True).start()
            except RuntimeError as error:  # the system starts no more threads
                log.error("A robot cannot connect: %s.", error)
                self.leave(robot)
                robot.close()
                self._drop_silent()

    def _drop_silent(self) -> bool:
        """Close the oldest connection without requests; returns True if there was one."""
        silent = next((robot for robot in list(self._robots) if not robot.has_asked), None)
        if silent is None:
            return False
        self._robots.pop(silent, None)
        silent.close()
        return True


class _RobotConnection:
    """One connection.

    Args:
        channel: channel of the connection.
        server: the model's server.
        client: its owner, unless it is introduced as another's.
    """

    def __init__(self, channel: FrameChannel, server: SharedModelServer, client: str) -> None:
        self._channel = channel
        self._server = server
        self._client = client
        self._sending = threading.Lock()
        self._session = secrets.randbits(62)
        self._held: OrderedDict[int, object] = OrderedDict()
        self._last = 0
        self.has_asked = False

    def serve(self) -> None:
        """Serve its requests until it disconnects; the first one has a time limit."""
        try:
            first = self._channel.receive(time.monotonic() + _FIRST_S)
            self.has_asked = True
            self._take(first)
            while True:
                self._take(self._channel.receive(None))
        except OSError:
            pass
        except VersionError as error:
            log.warning("A client was refused: %s", error)
            refusal = ConfigurationError(f"The server of the shared model refuses: {error}.")
            self._send(Header(FrameKind.ANSWER), wire.from_answer(refusal))
        except ForeignDataError as error:
            log.warning("A client sent what is no request: %s", error)
        finally:
            self._server.leave(self)
            self.close()

    def _take(self, received: Received) -> None:
        header = received.header
        if header.kind is FrameKind.HELLO:
            hello = received.document()
            self._client = text(hello.get(CLIENT, self._client), "a client", 128)
            told = Header(FrameKind.WELCOME, clock_ns=header.clock_ns)
            self._send(told, self._server.hello(hello))
            return
        if header.kind is FrameKind.STATUS:
            self._send(Header(FrameKind.STATUS), self._server.status())
            return
        if header.kind is not FrameKind.REQUEST or header.number <= self._last:
            raise ForeignDataError(f"frame {header.number} of kind {header.kind} was not expected")
        self._last = header.number
        answer_header = Header(FrameKind.ANSWER, header.number, header.clock_ns)

        def tell(answer: Answer) -> None:
            self._server.note(answer)
            try:
                held = self._hold(answer, header.number)
                self._send(answer_header, wire.from_answer(answer, held))
            except (TypeError, ValueError, OverflowError) as error:
                refusal = PluginError(f"The answer of the shared model cannot be sent: {error}.")
                self._send(answer_header, wire.from_answer(refusal))

        try:
            document = field(received.document(), "observation")
            observation = wire.to_observation(document, self._recall)
            observation = self._server.cropped(observation, document)
            deadline_s = time.monotonic() + header.left_s
            self._server.submit(
                Waiting(
                    observation=observation,
                    deadline_s=deadline_s,
                    tell=tell,
                    client=self._client,
                    connection=self,
                )
            )
        except ForeignDataError as error:
            tell(InvalidInputError(f"The observation cannot be read: {error}."))
        except RoboNeuronError as error:
            tell(error)

    def _hold(self, answer: Answer, number: int) -> wire.HeldContext | None:
        """Store the context of a chunk; called on the model's thread, so that it exists before the
        robot can name it.
        """
        if not isinstance(answer, ActionChunk) or answer.context is None:
            return None
        self._held[number] = answer.context
        while len(self._held) > _MOST_HELD:
            self._held.popitem(last=False)
        return wire.HeldContext(self._session, number)

    def _recall(self, named: wire.HeldContext) -> object:
        """A stored context; None for that of another connection."""
        return self._held.get(named.number) if named.session == self._session else None

    def _send(self, header: Header, document: Document) -> None:
        try:
            with self._sending:
                self._channel.send(header, document, _SEND_S)
        except OSError:
            self.close()  # this ends `serve`

    def close(self) -> None:
        """Disconnect."""
        self._channel.close()

"""The server of one model: websockets at a Unix socket, and one thread for the model."""

from __future__ import annotations

import asyncio
import fcntl
import json
import logging
import os
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from http import HTTPStatus
from pathlib import Path

from websockets.asyncio.server import ServerConnection

from rn_backend_openpi import messages
from rn_backend_openpi.batching import Batcher, Waiting
from rn_backend_openpi.conversation import Conversation, Reply, converse
from rn_backend_openpi.description import (
    FAILED,
    LOADING,
    PROTOCOL,
    READY,
    describe_arena,
    facts_of,
)
from rn_backend_openpi.introduction import to_profile
from rn_backend_openpi.listener import Listener
from rn_backend_openpi.messages import RESERVED, Document
from rn_backend_openpi.model import SharedModel
from rn_backend_openpi.options import ModelOptions
from rn_backend_openpi.statistics import STATUS, Statistics
from roboneuron import (
    ForeignDataError,
    NotReadyError,
    RoboNeuronError,
)
from roboneuron.command import HangWatch

log = logging.getLogger(__name__)
_FAILED_S = 3.0
"""Time for which a server that could not load reports this before it ends."""
_LOOK_S = 0.1
_MOST_ROBOTS = 128
_START_S = 10.0


class SharedModelServer:
    """Serves one model to all robots that connect.

    Args:
        options: options of the model.
        path: path of the socket.
        idle_s: time without a robot after which the server ends; None for never.
        model: the model, not loaded; that of the options if None.

    Attributes:
        statistics: of its batches and answers.
    """

    def __init__(
        self,
        options: ModelOptions,
        path: Path,
        idle_s: float | None,
        model: SharedModel | None = None,
    ) -> None:
        self._options = options
        self._path = path
        self._idle_s = idle_s
        self.model = model or SharedModel(options)
        self._batcher: Batcher | None = None
        self._listener = Listener(
            self._handle, most=_MOST_ROBOTS, pages={STATUS: self._status_page}
        )
        self._end = threading.Event()
        self._state = LOADING
        self._image_sizes: Mapping[str, tuple[int, int]] = {}
        self._failure: RoboNeuronError | None = None
        self._used_s = time.monotonic()
        self.statistics = Statistics()

    def run(self, watch: HangWatch | None = None) -> int:
        """Serve until `stop`, or idle; returns the exit status. Only one server serves a path at a
        time: a second one ends at once. `watch` is that of this process.
        """
        with self._path.with_suffix(".lock").open("a") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return 0
            with self._listening():
                return self._serve(watch or HangWatch())

    def stop(self) -> None:
        """Request the end; callable from a signal handler."""
        self._end.set()

    def load(self) -> None:
        """Load the model, and start answering; `run` does it too.

        Raises:
            RoboNeuronError: as `Backend.load`.
        """
        self.model.load()
        options = self._options
        self._batcher = Batcher(
            self.statistics.timed(self.model.answer),
            most=self.model.most,
            waiting=options.waiting,
            linger_s=options.linger_s,
            clients=lambda: len(self._listener.clients),
        )
        self._batcher.start()
        self._image_sizes = self.model.image_sizes
        self._state = READY
        log.info("The model %s is ready.", self._options.backend)

    @property
    def is_alive(self) -> bool:
        """True while the model's thread answers."""
        return self._batcher is not None and self._batcher.is_alive

    def close(self) -> None:
        """Stop after the current batch, and release the model; idempotent."""
        batcher, self._batcher = self._batcher, None
        if batcher is not None:
            batcher.close()
            self.model.close()

    def _serve(self, watch: HangWatch) -> int:
        try:
            with watch.loading():
                self.load()
        except RoboNeuronError as error:
            return self._fail(error)
        except (
            Exception
        ) as error:  # the border to the model: robots are notified before the process ends
            log.exception("The model cannot be loaded.")
            return self._fail(NotReadyError(f"The shared model cannot be loaded: {error!r}."))
        self._used_s = time.monotonic()
        while not self._end.wait(_LOOK_S):
            now_s = time.monotonic()
            if self._listener.clients:
                self._used_s = now_s
            elif self._idle_s is not None and now_s - self._used_s > self._idle_s:
                log.info("No robot for %g s.", self._idle_s)
                break
        self.close()
        return 0

    def _fail(self, error: RoboNeuronError) -> int:
        log.error("%s", error)
        self._failure, self._state = error, FAILED
        self._end.wait(_FAILED_S)
        return 1

    @contextmanager
    def _listening(self) -> Iterator[None]:
        """Accept connections, on a thread with the event loop."""
        is_open, loop, until = threading.Event(), asyncio.new_event_loop(), asyncio.Event()

        async def listen() -> None:
            # renamed once it listens, so that a robot that finds the socket is not refused
            unready = self._path.with_suffix(".new")
            async with await self._listener.open_local(str(unready)):
                unready.replace(self._path)
                is_open.set()
                await until.wait()
                self._path.unlink(missing_ok=True)

        def run() -> None:
            with asyncio.Runner(loop_factory=lambda: loop) as runner:
                runner.run(listen())

        thread = threading.Thread(target=run, name="connections", daemon=True)
        thread.start()
        if not is_open.wait(_START_S):
            raise NotReadyError(f"The socket {self._path} cannot be made.")
        try:
            yield
        finally:
            loop.call_soon_threadsafe(until.set)
            thread.join(_START_S)

    async def _handle(self, connection: ServerConnection) -> None:
        await converse(connection, Conversation(self))

    def first(self, number: int) -> Reply:
        """The first message to a client: the description of the model with a number (see
        `ServerDescription`), or the metadata of RoboArena.
        """
        interface, layout = self._options.interface, self.model.layout
        if layout is not None and interface is not None and interface.dialect == "roboarena":
            return describe_arena(layout)
        return {RESERVED: {**self.metadata(), "number": number}}

    def metadata(self) -> Document:
        """Description of the model in the first message to a robot, which repeats the connection
        while the model loads.
        """
        told: Document = {"protocol": PROTOCOL, "state": self._state, "pid": os.getpid()}
        if self._failure is not None:
            return told | messages.from_error(self._failure)
        if self._state != READY:
            return told
        spec, layout = self.model.spec, self.model.layout
        return {
            **told,
            "cameras": list(spec.cameras),
            "optional_cameras": list(spec.optional_cameras),
            "horizon": spec.action_space.horizon,
            "step_s": spec.action_space.step_s,
            "most_committed": spec.max_committed_rows,
            "takes_state": spec.takes_predicted_state,
            "continues": self.model.continues_rows,
            "image_sizes": {role: list(size) for role, size in self._image_sizes.items()},
            **({} if layout is None else {"interface": facts_of(layout)}),
        }

    def space_on(self, robot: object) -> Document:
        """The control space of the model's chunks on an introduced robot (see `from_profile`), or
        why it cannot move it. Raises ForeignDataError.
        """
        if self._state != READY:
            return {}
        try:
            return {"space": messages.from_space(self.model.space_on(to_profile(robot)))}
        except ForeignDataError:  # no introduction; a refusal is for a model that does not fit
            raise
        except RoboNeuronError as error:
            return {"refusal": messages.from_error(error)}

    def _status_page(self) -> tuple[HTTPStatus, str]:
        return HTTPStatus.OK, json.dumps(self.status())

    def status(self) -> Document:
        """Statistics of this server."""
        own: Document = {
            "state": self._state,
            "pid": os.getpid(),
            "clients": len(self._listener.clients),
            "waiting": 0 if self._batcher is None else self._batcher.waiting,
            **self.statistics.values(),
        }
        if self._failure is not None:
            own |= messages.from_error(self._failure)
        return own

    def submit(self, waiting: Waiting) -> None:
        """See `Batcher`."""
        if self._batcher is None:
            raise NotReadyError("The shared model is being loaded.")
        self._batcher.submit(waiting)

"""Replicas of one model under one name, each a supervised process; robots are distributed over
them.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path

from rn_backend_shared.channel import FrameChannel
from rn_backend_shared.frames import Document
from rn_backend_shared.options import ServedModelOptions
from rn_backend_shared.processes import DEAD, ModelProcess
from rn_backend_shared.session import FAILED, LOADING, READY, Welcome
from roboneuron import NotReadyError

_SUMS = (
    "clients",
    "waiting",
    "batches",
    "observations",
    "answered",
    "refused",
    "errors",
    "restarts",
)
_GREATEST = ("model_ms_median", "model_ms_p99", "busy_s")
_BEST_FIRST = (READY, LOADING, DEAD, FAILED)
"""States from best to worst; a model has the best state of its replicas."""


class Seat:
    """A robot's connection to a replica; counted until `leave`.

    Attributes:
        channel: to the replica's process.
        welcome: its welcome message.
        replica: its number.
    """

    def __init__(
        self, model: Replicas, replica: int, channel: FrameChannel, welcome: Welcome
    ) -> None:
        self._model = model
        self.replica = replica
        self.channel = channel
        self.welcome = welcome

    @property
    def is_crowded(self) -> bool:
        """True if another replica has fewer robots, and this robot's chunks need no context of this
        replica.
        """
        return not self.welcome.continues and self._model.is_crowded(self.replica)

    def leave(self) -> None:
        """Disconnect."""
        self.channel.close()
        self._model.vacate(self.replica)


class Replicas:
    """The processes of one model; callable from any thread.

    A robot stays with its replica, which holds the connection and the contexts of its chunks. It
    moves when the replica dies, or, if it continues no rows, when another replica has fewer robots.

    Args:
        name: name of the model.
        options: options of the model.
        folder: folder of sockets and logs.
        prefix: prefix of their names.
    """

    def __init__(self, name: str, options: ServedModelOptions, folder: Path, prefix: str) -> None:
        self.name = name
        # names of models have no dot, so sockets of replicas are unique
        marks = [""] if options.replicas == 1 else [f".{n}" for n in range(options.replicas)]
        self.processes: Sequence[ModelProcess] = tuple(
            ModelProcess(
                f"{name}{mark}", options.of_replica(number), folder / f"{prefix}-{name}{mark}.sock"
            )
            for number, mark in enumerate(marks)
        )
        self._lock = threading.Lock()
        self._seated = [0] * len(self.processes)

    @property
    def state(self) -> str:
        """The best state of its replicas."""
        return min((process.state for process in self.processes), key=_BEST_FIRST.index)

    def start(self) -> None:
        """Start all processes and their supervision."""
        for process in self.processes:
            process.start()

    def stop(self) -> None:
        """Request the end of all processes."""
        for process in self.processes:
            process.stop()

    def close(self) -> None:
        """End all processes, and wait for them; idempotent."""
        for process in self.processes:
            process.close()

    def welcome(self) -> Document:
        """Welcome message while no replica is ready: loading, or the failure if all have failed."""
        told = [process.welcome() for process in self.processes]
        return next((one for one in told if one["state"] != FAILED), told[0])

    def take_seat(self, hello: Document, *, avoided: int | None = None) -> Seat:
        """Connect a robot to the ready replica with the fewest robots.

        Args:
            hello: introduction of the robot.
            avoided: a replica that has just failed; used only if there is no other.

        Raises:
            NotReadyError: no replica is ready.
        """
        refusal: NotReadyError | None = None
        for replica in self._by_room(avoided):
            self._count(replica, 1)
            try:
                channel, welcome = self.processes[replica].connect(hello)
            except NotReadyError as error:
                self.vacate(replica)
                refusal = refusal or error
                continue
            return Seat(self, replica, channel, welcome)
        assert refusal is not None
        raise refusal

    def is_crowded(self, replica: int) -> bool:
        """True if another ready replica has at least two robots less, so that moving one balances
        them.
        """
        others = [
            self._seated[number]
            for number, process in enumerate(self.processes)
            if number != replica and process.state == READY
        ]
        return bool(others) and min(others) + 2 <= self._seated[replica]

    def vacate(self, replica: int) -> None:
        """Remove a robot from the count of a replica."""
        self._count(replica, -1)

    def status(self) -> Document:
        """Statistics of the model, and of each replica if there are several. Counts are summed,
        times are those of the slowest.
        """
        told = [process.status() for process in self.processes]
        if len(told) == 1:
            return told[0]
        known: Document = {"state": self.state, "pid": None}
        known |= {name: sum(one.get(name, 0) for one in told) for name in _SUMS}
        for name in _GREATEST:
            values = [one[name] for one in told if one.get(name) is not None]
            known[name] = max(values, default=None)
        failures = [one["failure"] for one in told if "failure" in one]
        if failures:
            known["failure"] = failures[0]
        return {**known, "replicas": told}

    def _by_room(self, avoided: int | None) -> list[int]:
        with self._lock:
            seated = list(self._seated)
        return sorted(
            range(len(seated)),
            key=lambda replica: (
                replica == avoided,
                self.processes[replica].state != READY,
                seated[replica],
            ),
        )

    def _count(self, replica: int, robots: int) -> None:
        with self._lock:
            self._seated[replica] += robots

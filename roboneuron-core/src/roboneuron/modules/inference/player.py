"""Thread that sends each row of a chunk when it is due."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from roboneuron.errors import NotReadyError
from roboneuron.modules.inference.execution import ChunkExecutor, Row
from roboneuron.modules.module_host import ModuleHost
from roboneuron.modules.step_filters import StepFilters
from roboneuron.modules.worker import Worker

_WAIT_S = 0.1
"""Longest wait for a row; well below the 0.4 s after which a thread counts as stalled."""
_LOOK_S = 0.002
"""Polling period while a filter does not let a row that is due be sent."""


class RowPlayer:
    """Play an executor's rows between `start` and `stop`.

    Two threads send rows: the player's own, and the predicting one with `play_due`. Both hold the
    executor's lock from the choice of the row until it is sent, so that rows keep their order and
    none follows a stop.
    """

    def __init__(
        self,
        node: ModuleHost,
        filters: StepFilters,
        executor: ChunkExecutor,
        send: Callable[[Row], None],
    ) -> None:
        """Args:
        node: node of the inference module.
        filters: of the module.
        executor: provides the row that is due.
        send: publishes a row; called with the executor's lock held, so that no instruction or stop
            can intervene.
        """
        self._node, self._filters = node, filters
        self._executor = executor
        self._publish = send
        self._worker = Worker("playing", self._play, node.status)
        self._is_playing = False
        node.resources.callback(self.stop)

    def start(self) -> None:
        """Start playing."""
        self._is_playing = True
        self._worker.start()

    def stop(self) -> bool:
        """Stop sending, on every thread; return False if the player's thread hangs."""
        with self._executor.changed:
            self._is_playing = False
        # without the lock: the player's thread needs it to end
        return self._worker.stop()

    def play_due(self, stop: threading.Event) -> None:
        """Send the row that is due, if one is, on the caller's thread.

        The predicting thread calls this after an answer, because waking the player's thread would
        dominate the time to the first action.

        Args:
            stop: ends the caller's work.

        Raises:
            NotReadyError: the image behind the row has become too old.
        """
        with self._executor.changed:
            due_s = self._executor.due_s()
            if self._is_playing and due_s is not None and due_s <= time.monotonic():
                self._send_due(stop)

    def _play(self, stop: threading.Event) -> None:
        """Send the row that is due, or wait for it."""
        executor = self._executor
        with executor.changed:
            due_s = executor.due_s()
            wait_s = _WAIT_S if due_s is None else min(_WAIT_S, due_s - time.monotonic())
            # both waits release the lock, and end early when rows arrive or an epoch begins
            if wait_s > 0:
                executor.changed.wait(wait_s)
            elif not self._send_due(stop):
                executor.changed.wait(_LOOK_S)

    def _send_due(self, stop: threading.Event) -> bool:
        """Send the row that is due; return False if a filter does not let it be sent yet.

        The executor's lock is held, and a row is due.

        Raises:
            NotReadyError: the image behind the row has become too old; nothing was sent.
        """
        executor, node, filters = self._executor, self._node, self._filters
        now_ns = node.now_ns()
        if stop.is_set() or node.stopped or any(one.ends_rows(now_ns) for one in filters):
            executor.drop()
            return True
        if not all(one.may_play(now_ns) for one in filters):
            return False
        try:
            row = executor.play(time.monotonic(), now_ns)
        except NotReadyError:
            node.status.drop("late_action")
            raise
        if row is not None:
            filters.note_sent("action")
            self._publish(row)
        return True

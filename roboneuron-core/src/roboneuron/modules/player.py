"""The rows of chunks, each sent when it is due, by a thread of their own."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from roboneuron.errors import NotReadyError
from roboneuron.modules.execution import ChunkExecutor, Row
from roboneuron.modules.module import ModuleNode
from roboneuron.modules.worker import Worker

_WAIT_S = 0.1
_LOOK_S = 0.002
"""How often the successor in a handover looks whether the predecessor has finished."""


class RowPlayer:
    """Plays what an executor holds between `start` and `stop`."""

    def __init__(
        self, node: ModuleNode, executor: ChunkExecutor, send: Callable[[Row], None]
    ) -> None:
        """Args:
        node: of the inference module.
        executor: says which row is due.
        send: publishes a row; the executor's lock is held, so that no instruction or stop comes
        between.
        """
        self._node = node
        self._executor = executor
        self._publish = send
        self._worker = Worker("playing", self._play, node.status)
        self.start, self.stop = self._worker.start, self._worker.stop
        node.resources.callback(self.stop)

    def _play(self, stop: threading.Event) -> None:
        """Send the row that is due, or wait for it."""
        executor, node = self._executor, self._node
        with executor.changed:
            due_s = executor.due_s()
            wait_s = _WAIT_S if due_s is None else min(_WAIT_S, due_s - time.monotonic())
            if wait_s > 0:
                executor.changed.wait(wait_s)
                return
            now_ns = node.now_ns()
            if stop.is_set() or node.stopped or node.handover.must_fall_silent(now_ns):
                executor.drop()
                return
            if not node.handover.may_send(now_ns):
                executor.changed.wait(_LOOK_S)
                return
            try:
                row = executor.play(time.monotonic(), now_ns)
            except NotReadyError:
                node.status.dropped.add("late_action")
                raise
            if row is not None:
                node.handover.note_sent("action")
                self._publish(row)

"""The rows of chunks, each sent when it is due, by a thread of their own."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from rn_standard.inference.execution import ChunkExecutor, Row
from roboneuron import NotReadyError
from roboneuron.node import ModuleHost, Worker

_WAIT_S = 0.1
"""Longest wait for a row; well below the 0.4 s after which a thread counts as stalled."""
_LOOK_S = 0.002
"""How often the successor in a handover looks whether the predecessor has finished."""


class RowPlayer:
    """Plays what an executor holds between `start` and `stop`.

    Two threads send rows: the player's own, and the predicting one by `play_due`. Both hold the
    executor's lock from the question which row is due until that row is out, so that rows keep
    their order and none follows a stop.
    """

    def __init__(
        self, node: ModuleHost, executor: ChunkExecutor, send: Callable[[Row], None]
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
        self._is_playing = False
        node.resources.callback(self.stop)

    def start(self) -> None:
        """Play from now on."""
        self._is_playing = True
        self._worker.start()

    def stop(self) -> bool:
        """Send nothing more, on whichever thread; False when the player's thread hangs."""
        with self._executor.changed:
            self._is_playing = False
        # without the lock: the player's thread needs it to come to its end
        return self._worker.stop()

    def play_due(self, stop: threading.Event) -> None:
        """Send the row that is due, if one is, on the caller's thread.

        The thread that has just predicted calls this, because waking the player's thread would take
        longer than all else between an answer and its first action.

        Args:
            stop: of the caller's work.

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
            # both waits give the lock away, and end early when rows come or an epoch begins
            if wait_s > 0:
                executor.changed.wait(wait_s)
            elif not self._send_due(stop):
                executor.changed.wait(_LOOK_S)

    def _send_due(self, stop: threading.Event) -> bool:
        """Send the row that is due; False when the predecessor in a handover is to send before.

        The executor's lock is held, and a row is due.

        Raises:
            NotReadyError: the image behind the row has become too old; nothing was sent.
        """
        executor, node = self._executor, self._node
        now_ns = node.now_ns()
        if stop.is_set() or node.stopped or node.handover.must_fall_silent(now_ns):
            executor.drop()
            return True
        if not node.handover.may_send(now_ns):
            return False
        try:
            row = executor.play(time.monotonic(), now_ns)
        except NotReadyError:
            node.status.drop("late_action")
            raise
        if row is not None:
            node.handover.note_sent("action")
            self._publish(row)
        return True

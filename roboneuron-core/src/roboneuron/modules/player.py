"""The playing of action chunks: when each row is due, what cuts the rest, when to predict again."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from roboneuron.contract import ActionChunk, Observation

_PACE = 0.8
"""The next prediction may start after this share of a step has passed since the last action went out."""


class ChunkPlayer:
    """Sends one row per `step_s`; used on the thread that predicts.

    Args:
        send: sends row `index` of a chunk that answers an observation.
    """

    def __init__(self, send: Callable[[ActionChunk, int, Observation], None]) -> None:
        self._send = send
        self._next_s = 0.0

    def restart(self) -> None:
        """The next prediction may start at once."""
        self._next_s = 0.0

    def wait(self, stop: threading.Event) -> bool:
        """Wait until the next prediction may start; whether `stop` was set meanwhile."""
        remaining_s = self._next_s - time.monotonic()
        return remaining_s > 0 and stop.wait(remaining_s)

    def play(
        self, chunk: ActionChunk, observation: Observation, stop: threading.Event, is_cut: Callable[[], bool]
    ) -> None:
        """Send the rows that answer `observation`, the first at once, until the end, `stop` or `is_cut`."""
        start_s = time.monotonic()
        for index in range(len(chunk.actions)):
            delay_s = start_s + index * chunk.step_s - time.monotonic()
            if delay_s > 0:
                stop.wait(delay_s)
            if stop.is_set() or is_cut():
                return
            self._send(chunk, index, observation)
        self._next_s = time.monotonic() + _PACE * chunk.step_s

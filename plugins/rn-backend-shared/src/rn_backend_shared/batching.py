"""What waits for the model: the earliest deadline first, as many at once as can be answered in
time.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from roboneuron import ActionChunk, NotReadyError, Observation, PluginError, RoboNeuronError

log = logging.getLogger(__name__)
Answer = ActionChunk | RoboNeuronError
_NEW = 0.3
"""Share of the newest measurement in the expected time of a batch."""
_FORGET = 0.9
"""The expected time of a size that was not tried shrinks by this: one hiccup must not bar large
batches for good.
"""
_POLL_S = 0.2


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Waiting:
    """One observation that waits.

    Attributes:
        observation: what is seen.
        deadline_s: monotonic time after which nobody wants the answer [s].
        tell: called with the answer, once, on the thread of the model; must not block for long.
        since_s: monotonic time since which it waits [s]; set by `Batcher.submit`.
    """

    observation: Observation
    deadline_s: float
    tell: Callable[[Answer], object]
    since_s: float = 0.0


class Batcher:
    """Collects observations from any thread and answers them on one.

    Args:
        predict: one answer for each observation; called on the batcher's thread only.
        most: most observations in one batch.
        waiting: most that wait.
        linger_s: how long the first one of an idle server waits for others.
        clients: how many may ask; when all of them wait, nobody else is waited for.
        clock: monotonic time [s].
    """

    def __init__(
        self,
        predict: Callable[[Sequence[Observation]], Sequence[Answer]],
        *,
        most: int,
        waiting: int,
        linger_s: float = 0.0,
        clients: Callable[[], int] = lambda: 1,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._predict = predict
        self._most = most
        self._most_waiting = waiting
        self._linger_s = linger_s
        self._clients = clients
        self._clock = clock
        self._waiting: list[Waiting] = []
        self._changed = threading.Condition()
        self._expected_s: dict[int, float] = {}
        self._is_over = False
        self._thread = threading.Thread(target=self._run, name="batches", daemon=True)

    def submit(self, waiting: Waiting) -> None:
        """Add one.

        Raises:
            NotReadyError: too many wait already.
        """
        with self._changed:
            if self._is_over or len(self._waiting) >= self._most_waiting:
                raise NotReadyError(
                    f"The shared model has {len(self._waiting)} observations waiting; no more are "
                    "accepted.",
                    hint="Fewer robots, a faster model, or more replicas.",
                )
            self._waiting.append(replace(waiting, since_s=self._clock()))
            self._changed.notify()

    def start(self) -> None:
        """Begin to answer."""
        self._thread.start()

    def close(self) -> None:
        """Answer no more, after the batch that may be under way; idempotent. What waits is
        refused.
        """
        with self._changed:
            self._is_over = True
            self._changed.notify()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join()
        for waiting in self._waiting:
            waiting.tell(NotReadyError("The shared model is being stopped."))
        self._waiting = []

    def expected_s(self, count: int) -> float:
        """How long a batch of that size takes, as far as is known; larger ones take as long as
        smaller at least.
        """
        return max(
            (took_s for size, took_s in self._expected_s.items() if size <= count), default=0.0
        )

    def take(self) -> tuple[list[Waiting], list[Waiting]]:
        """The next batch, earliest deadline first, and those that are too late; both leave the
        queue.
        """
        now_s = self._clock()
        with self._changed:
            in_order = sorted(self._waiting, key=lambda waiting: waiting.deadline_s)
            late = [waiting for waiting in in_order if waiting.deadline_s <= now_s]
            good = in_order[len(late) :]
            count = min(len(good), self._most)
            wanted = count
            while count > 1 and now_s + self.expected_s(count) > good[0].deadline_s:
                count -= 1
            if count < wanted:
                self._forget_above(count)
            self._waiting = good[count:]
            return good[:count], late

    def step(self) -> None:
        """Answer one batch, and refuse what is too late."""
        batch, late = self.take()
        for waiting in late:
            waiting.tell(
                NotReadyError(
                    "The shared model had no time before the deadline; too many robots wait."
                )
            )
        if not batch:
            return
        began_s = self._clock()
        answers = self._answers([waiting.observation for waiting in batch])
        took_s = self._clock() - began_s
        before_s = self._expected_s.get(len(batch), took_s)
        self._expected_s[len(batch)] = before_s + _NEW * (took_s - before_s)
        for waiting, answer in zip(batch, answers, strict=True):
            queued_s = began_s - waiting.since_s
            waiting.tell(_with_metrics(answer, len(batch), took_s, queued_s))

    def _answers(self, observations: list[Observation]) -> Sequence[Answer]:
        try:
            answers = self._predict(observations)
            if len(answers) != len(observations):
                raise PluginError(
                    f"{len(observations)} observations were answered by {len(answers)} chunks."
                )
        except Exception as error:  # the border to the model: every robot that waits is told
            log.exception("A batch of %d failed.", len(observations))
            known = (
                error
                if isinstance(error, RoboNeuronError)
                else PluginError(f"The shared model failed: {error!r}.")
            )
            return [known] * len(observations)
        return answers

    def _forget_above(self, count: int) -> None:
        shrunk = {
            size: took_s * _FORGET for size, took_s in self._expected_s.items() if size > count
        }
        self._expected_s |= shrunk

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._waiting and not self._is_over:
                    self._changed.wait(_POLL_S)
                if self._is_over:
                    return
                self._changed.wait_for(self._is_complete, self._linger_s)
            self.step()

    def _is_complete(self) -> bool:
        """Nobody else is worth waiting for."""
        return self._is_over or len(self._waiting) >= min(self._most, self._clients())


def _with_metrics(answer: Answer, count: int, took_s: float, queued_s: float = 0.0) -> Answer:
    if isinstance(answer, RoboNeuronError):
        return answer
    own = {
        "shared.batch": float(count),
        "shared.queue_ms": queued_s * 1e3,
        "shared.model_ms": took_s * 1e3,
    }
    return replace(answer, metrics={**answer.metrics, **own})

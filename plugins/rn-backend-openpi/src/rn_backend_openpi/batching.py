"""Queue and batches of the model: connections in turn, and a batch as large as can be answered in
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
"""Weight of the newest measurement in the expected time of a batch."""
_FORGET = 0.9
"""Factor by which the expected time of an untried size shrinks, so that one slow batch does not
exclude large batches forever.
"""
_POLL_S = 0.2


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Waiting:
    """One observation in the queue.

    Attributes:
        observation: input of the model.
        deadline_s: monotonic time after which the answer is useless [s].
        tell: called once with the answer, on the model's thread; must not block for long.
        connection: its sender, compared by identity; None for one of its own. A newer observation
            takes the place of one of the same connection that waits.
        since_s: monotonic time of queueing [s]; set by `Batcher.submit`.
    """

    observation: Observation
    deadline_s: float
    tell: Callable[[Answer], object]
    connection: object = None
    since_s: float = 0.0


class Batcher:
    """Collects observations from any thread and answers them on one.

    Args:
        predict: one answer for each observation; called on the batcher's thread only.
        most: largest number of observations in one batch.
        waiting: largest number of queued observations; further ones are refused.
        linger_s: time that an idle server's first observation waits for others [s].
        clients: number of connections; when all of them wait, the batch starts at once.
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
        """Add one observation.

        Raises:
            NotReadyError: the queue is full.
        """
        queued = replace(waiting, since_s=self._clock())
        with self._changed:
            if self._is_over:
                raise NotReadyError("The shared model is being stopped.")
            older = self._older(waiting.connection)
            if older is None:
                if len(self._waiting) >= self._most_waiting:
                    raise _full(len(self._waiting))
                self._waiting.append(queued)
            else:
                self._waiting[self._waiting.index(older)] = queued
            self._changed.notify()
        if older is not None:
            _tell(older, NotReadyError("A newer observation of this robot has come."))

    def _older(self, connection: object) -> Waiting | None:
        """The observation of a connection that waits already."""
        if connection is None:
            return None
        own = (one for one in self._waiting if one.connection is connection)
        return next(own, None)

    @property
    def waiting(self) -> int:
        """Number of queued observations."""
        return len(self._waiting)

    @property
    def is_alive(self) -> bool:
        """True while the thread answers."""
        return self._thread.is_alive()

    def start(self) -> None:
        """Start answering."""
        self._thread.start()

    def close(self) -> None:
        """Stop after the current batch; idempotent. Queued observations are refused."""
        with self._changed:
            self._is_over = True
            self._changed.notify()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join()
        for waiting in self._waiting:
            _tell(waiting, NotReadyError("The shared model is being stopped."))
        self._waiting = []

    def expected_s(self, count: int) -> float:
        """Expected time of a batch of that size, as far as known [s]; at least that of smaller
        ones.
        """
        return max(
            (took_s for size, took_s in self._expected_s.items() if size <= count), default=0.0
        )

    def take(self) -> tuple[list[Waiting], list[Waiting]]:
        """Remove and return the next batch, and the observations whose deadline has passed.

        Connections are served in turn, in the order in which their observations came. The first
        observation of the batch limits its size. Others that this batch would answer too late stay
        in the queue.
        """
        now_s = self._clock()
        with self._changed:
            late = [waiting for waiting in self._waiting if waiting.deadline_s <= now_s]
            good = [waiting for waiting in self._waiting if waiting.deadline_s > now_s]
            in_order = good[: self._most]
            count = wanted = len(in_order)
            while count > 1 and now_s + self.expected_s(count) > in_order[0].deadline_s:
                count -= 1
            if count < wanted:
                self._forget_above(count)
            end_s = now_s + self.expected_s(count)
            batch = [
                waiting
                for place, waiting in enumerate(in_order[:count])
                if not place or waiting.deadline_s >= end_s
            ]
            taken = {id(waiting) for waiting in batch}
            self._waiting = [waiting for waiting in good if id(waiting) not in taken]
            return batch, late

    def step(self) -> None:
        """Answer one batch, and refuse observations whose deadline has passed."""
        batch, late = self.take()
        for waiting in late:
            _tell(
                waiting,
                NotReadyError(
                    "The shared model had no time before the deadline; too many robots wait."
                ),
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
            _tell(waiting, _with_metrics(answer, len(batch), took_s, queued_s))

    def _answers(self, observations: list[Observation]) -> Sequence[Answer]:
        try:
            answers = self._predict(observations)
            if len(answers) != len(observations):
                raise PluginError(
                    f"{len(observations)} observations were answered by {len(answers)} chunks."
                )
            return [_checked(answer) for answer in answers]
        # the border to the model: every waiting robot gets the error, and the thread goes on, also
        # after sys.exit
        except (Exception, SystemExit) as error:
            log.exception("A batch of %d failed.", len(observations))
            known = (
                error
                if isinstance(error, RoboNeuronError)
                else PluginError(f"The shared model failed: {error!r}.")
            )
            return [known] * len(observations)

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
        """True if the batch needs no further observations."""
        return self._is_over or len(self._waiting) >= min(self._most, self._clients())


def _full(count: int) -> NotReadyError:
    return NotReadyError(
        f"The shared model has {count} observations waiting; no more are accepted.",
        hint="Fewer robots, a faster model, or another server.",
    )


def _checked(answer: object) -> Answer:
    """The answer; an error instead of one of another type."""
    if isinstance(answer, ActionChunk | RoboNeuronError):
        return answer
    error = PluginError(
        f"The shared model returned {type(answer).__name__} for an observation, expected an "
        "ActionChunk."
    )
    log.error("%s", error)
    return error


def _tell(waiting: Waiting, answer: Answer) -> None:
    """Pass on the answer; an error of one connection affects no other."""
    try:
        waiting.tell(answer)
    except Exception:  # the border to a connection
        log.exception("An answer could not be passed on.")


def _with_metrics(answer: Answer, count: int, took_s: float, queued_s: float = 0.0) -> Answer:
    if isinstance(answer, RoboNeuronError):
        return answer
    own = {
        "shared.batch": float(count),
        "shared.queue_ms": queued_s * 1e3,
        "shared.model_ms": took_s * 1e3,
    }
    return replace(answer, metrics={**answer.metrics, **own})

"""What waits for the model: a fair share for each client, and in it for each of its connections;
the earliest deadline first among those who have had as much, as many at once as can be answered in
time.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Hashable, Mapping, Sequence
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
        client: who asks, by its key or address: all its connections together get one share.
        connection: of the client, compared by identity; each gets an equal part of that share.
        since_s: monotonic time since which it waits [s]; set by `Batcher.submit`.
    """

    observation: Observation
    deadline_s: float
    tell: Callable[[Answer], object]
    client: Hashable = None
    connection: object = None
    since_s: float = 0.0


class Turns:
    """How much each of several queues has had: start-time fair queueing with a cost of one for each
    answer.

    A queue's next turn is one after its last, but never before the turn that was served last: who
    was silent gains nothing by it, and who asks more often than others comes after them.
    Source: Goyal, Vin, Cheng: Start-time Fair Queueing (1996).
    """

    def __init__(self) -> None:
        self._now = 0
        self._next: dict[Hashable, int] = {}

    def order(self, queues: Mapping[Hashable, Sequence[Waiting]]) -> list[Waiting]:
        """All that waits; what is in one queue stays in its order."""
        keys = [
            (self._turn(name) + place, one.deadline_s, one)
            for name, queue in queues.items()
            for place, one in enumerate(queue)
        ]
        return [one for *_, one in sorted(keys, key=lambda key: key[:2])]

    def note(self, served: Sequence[Hashable]) -> None:
        """Count an answer for each of these queues."""
        turns = []
        for name in served:
            turns.append(self._turn(name))
            self._next[name] = turns[-1] + 1
        self._now = max([self._now, *turns])
        self._next = {name: turn for name, turn in self._next.items() if turn > self._now}

    def _turn(self, name: Hashable) -> int:
        return max(self._next.get(name, 0), self._now)


class Shares:
    """Turns of clients, and of the connections of each."""

    def __init__(self) -> None:
        self._clients = Turns()
        self._connections: dict[Hashable, Turns] = {}

    def order(self, waiting: Sequence[Waiting], most: int) -> list[Waiting]:
        """The first `most` of what waits, in their order."""
        by_deadline = sorted(waiting, key=lambda one: one.deadline_s)
        queues = {
            client: self._connections.get(client, Turns()).order(_grouped(own, _connection))
            for client, own in _grouped(by_deadline, _client).items()
        }
        return self._clients.order(queues)[:most]

    def note(self, served: Sequence[Waiting]) -> None:
        """Count what is answered."""
        self._clients.note([one.client for one in served])
        for client, own in _grouped(served, _client).items():
            turns = self._connections.setdefault(client, Turns())
            turns.note([_connection(one) for one in own])

    def settle(self, waiting: Sequence[Waiting]) -> None:
        """Forget what was had by connections of clients that wait for nothing; when nobody waits,
        what clients have had no longer counts either.
        """
        if not waiting:
            self._clients = Turns()
        clients = {one.client for one in waiting}
        self._connections = {
            client: turns for client, turns in self._connections.items() if client in clients
        }


def _client(waiting: Waiting) -> Hashable:
    return waiting.client


def _connection(waiting: Waiting) -> Hashable:
    return id(waiting.connection)


def _grouped(
    waiting: Sequence[Waiting], by: Callable[[Waiting], Hashable]
) -> dict[Hashable, list[Waiting]]:
    groups: dict[Hashable, list[Waiting]] = {}
    for one in waiting:
        groups.setdefault(by(one), []).append(one)
    return groups


class Batcher:
    """Collects observations from any thread and answers them on one.

    Args:
        predict: one answer for each observation; called on the batcher's thread only.
        most: most observations in one batch.
        waiting: most that wait. Beyond it the client with most of them gives one up, or of the same
            client the connection.
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
        self._shares = Shares()
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
            given_up = self._given_up(waiting)
            self._waiting = [one for one in self._waiting if one is not given_up]
            self._waiting.append(replace(waiting, since_s=self._clock()))
            self._changed.notify()
        if given_up is not None:
            given_up.tell(_full(self._most_waiting))

    def _given_up(self, newest: Waiting) -> Waiting | None:
        """What leaves a full queue for an observation, None while it is not full.

        Raises:
            NotReadyError: its client has as many there as any other, and its connection as many as
                any of the client's.
        """
        if self._is_over:
            raise NotReadyError("The shared model is being stopped.")
        if len(self._waiting) < self._most_waiting:
            return None
        counts = Counter(one.client for one in self._waiting)
        greedy, most = counts.most_common(1)[0]
        is_fair = counts[newest.client] + 1 < most
        client = greedy if is_fair else newest.client
        own = [one for one in self._waiting if one.client == client]
        of_connections = Counter(_connection(one) for one in own)
        connection, most = of_connections.most_common(1)[0] if own else (None, 0)
        if not is_fair and of_connections[_connection(newest)] + 1 >= most:
            raise _full(len(self._waiting))
        return max(
            (one for one in own if _connection(one) == connection),
            key=lambda one: one.deadline_s,
        )

    @property
    def waiting(self) -> int:
        """How many wait."""
        return len(self._waiting)

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
        """The next batch, and those that are too late; both leave the queue.

        Clients are taken in turns, see `Shares`; those who have had as many turns by their earliest
        deadline. The first of the batch decides how large it may be. Others that a batch of this
        size would answer too late stay.
        """
        now_s = self._clock()
        with self._changed:
            late = [waiting for waiting in self._waiting if waiting.deadline_s <= now_s]
            good = [waiting for waiting in self._waiting if waiting.deadline_s > now_s]
            in_order = self._shares.order(good, self._most)
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
            self._shares.note(batch)
            taken = {id(waiting) for waiting in batch}
            self._waiting = [waiting for waiting in good if id(waiting) not in taken]
            self._shares.settle(self._waiting)
            return batch, late

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


def _full(count: int) -> NotReadyError:
    return NotReadyError(
        f"The shared model has {count} observations waiting; no more are accepted.",
        hint="Fewer robots, a faster model, or more replicas.",
    )


def _with_metrics(answer: Answer, count: int, took_s: float, queued_s: float = 0.0) -> Answer:
    if isinstance(answer, RoboNeuronError):
        return answer
    own = {
        "shared.batch": float(count),
        "shared.queue_ms": queued_s * 1e3,
        "shared.model_ms": took_s * 1e3,
    }
    return replace(answer, metrics={**answer.metrics, **own})

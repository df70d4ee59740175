"""All servers of one model: each request goes to the ready one with the least load, and to another
one if that fails.
"""

from __future__ import annotations

import time
import uuid
from collections import Counter
from collections.abc import Callable, Mapping, Sequence

from rn_runtime_sglang.connection import AnswerTooLate, ServerLost
from rn_runtime_sglang.server import SglangServer
from rn_runtime_sglang.wire import Generated, MalformedReply
from roboneuron import NotReadyError, RoboNeuronError

Check = Callable[[], None]
"""Raises if the answer is no longer needed."""
_WAIT_S = 0.1


class ServerPool:
    """`generate` is called from one thread, `abort` and `close` from any."""

    def __init__(self, servers: Sequence[SglangServer]) -> None:
        self._servers = tuple(servers)
        self._counts: Counter[str] = Counter()
        self._current: tuple[SglangServer, str] | None = None

    @property
    def servers(self) -> tuple[SglangServer, ...]:
        """The servers in the order of the configuration."""
        return self._servers

    def start(self, timeout_s: float, check: Check) -> None:
        """Monitor all servers, and wait until one is ready and each has had the time of one poll.

        Args:
            timeout_s: longest wait for the first one.
            check: called while waiting; may raise.

        Raises:
            RoboNeuronError: the refusal of a server (at the start every refusal is an error).
            NotReadyError: none became ready.
        """
        for server in self._servers:
            server.start()
        deadline_s = time.monotonic() + timeout_s
        while not any(server.is_ready for server in self._servers):
            check()
            self._raise_refusals()
            if time.monotonic() > deadline_s:
                raise NotReadyError(
                    f"No SGLang server became ready within {timeout_s:g} s. {self._problems()}",
                    hint="Are the servers running, and are the URLs right?",
                )
            self._servers[0].wait_settled(_WAIT_S)
        for server in self._servers:
            server.wait_settled(min(1.0, timeout_s))
        self._raise_refusals()

    def _raise_refusals(self) -> None:
        for server in self._servers:
            if server.refusal is not None:
                raise server.refusal

    def _problems(self) -> str:
        return " ".join(server.problem for server in self._servers if server.problem)

    def generate(
        self,
        body: bytes,
        deadline_s: float,
        *,
        attempts: int,
        count: int,
        vocabulary: int,
        check: Check,
    ) -> Generated:
        """Send one request and return its answer.

        Args:
            body: from `encode_body`.
            deadline_s: `time.monotonic()` after which the answer is useless.
            attempts: largest number of attempts.
            count, vocabulary: required number and range of the reply's tokens.
            check: called after a failure; may raise.

        Raises:
            NotReadyError: no server answered in time.
            RoboNeuronError: see `SglangServer.generate`.
        """
        failed: list[SglangServer] = []
        error: NotReadyError | None = None
        while len(failed) < attempts and time.monotonic() < deadline_s:
            server = self._choose(failed)
            if failed:
                self._counts["retried"] += 1
            rid = uuid.uuid4().hex
            self._current = (server, rid)
            try:
                return server.generate(rid, body, deadline_s, count=count, vocabulary=vocabulary)
            except AnswerTooLate as late:
                check()
                self._counts["late"] += 1
                raise NotReadyError(
                    f"{server.url} did not answer in time; the request was aborted "
                    f"({self._counts['late']} so far)."
                ) from late
            except (ServerLost, MalformedReply) as lost:
                check()
                self._counts["failed"] += 1
                failed.append(server)
                error = lost
            finally:
                self._current = None
        raise NotReadyError(
            f"No server answered: {error or 'the deadline had passed before.'}"
        ) from error

    def _choose(self, failed: Sequence[SglangServer]) -> SglangServer:
        usable = [server for server in self._servers if server.refusal is None]
        if not usable:
            raise self._no_server()
        # A server that is not ready is still used if no other is left: it may be back before the
        # next poll.
        return min(usable, key=lambda server: (server in failed, not server.is_ready, server.load))

    def _no_server(self) -> RoboNeuronError:
        return NotReadyError(f"No server may be used. {self._problems()}")

    def abort(self) -> None:
        """Abort the request in progress, here and on its server; returns at once."""
        current = self._current
        if current is not None:
            server, rid = current
            self._counts["aborted"] += 1
            server.abort(rid)
            server.cut()

    def metrics(self) -> Mapping[str, float]:
        """Counters since the start, the number of ready servers, and the sums of the servers' own
        metrics.
        """
        counted = {
            f"served.{word}": float(self._counts[word])
            for word in ("late", "failed", "retried", "aborted")
        }
        summed: Counter[str] = Counter()
        for server in self._servers:
            summed.update(server.metrics)
        ready = sum(server.is_ready for server in self._servers)
        return {**counted, "served.servers_ready": float(ready), **summed}

    def close(self) -> None:
        """Abort the request in progress and stop monitoring."""
        self.abort()
        for server in self._servers:
            server.close()

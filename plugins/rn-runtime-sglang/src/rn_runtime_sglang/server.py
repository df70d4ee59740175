"""Connection to one server: a thread monitors readiness, identity and load and sends aborts;
`generate` sends requests.
"""

from __future__ import annotations

import json
import logging
import queue
import threading
import time
from collections.abc import Mapping

from rn_runtime_sglang.connection import Access, AnswerTooLate, HttpConnection, ServerLost
from rn_runtime_sglang.identity import Expectation
from rn_runtime_sglang.wire import (
    Generated,
    MalformedReply,
    error_text,
    parse_metrics,
    parse_reply,
    with_id,
)
from roboneuron import ConfigurationError, InvalidInputError, NotReadyError, RoboNeuronError

log = logging.getLogger(__name__)
_POLL_LIMIT_S = 1.0
"""Time limit of the poll; a server that does not answer within it is not ready."""
_IDENTITY_LIMIT_S = 10.0
_ABORT_LIMIT_S = 1.0
_WANTED = {
    "sglang:num_running_reqs": "served.running",
    "sglang:num_queue_reqs": "served.queued",
    "sglang:token_usage": "served.token_usage",
    "sglang:gen_throughput": "served.tokens_per_s",
}
_STOP = ""


class SglangServer:
    """`generate` is called from one thread; everything else from any."""

    def __init__(self, access: Access, expectation: Expectation, poll_s: float) -> None:
        self.url = access.url
        self._expectation = expectation
        self._poll_s = poll_s
        self._work = HttpConnection(access)
        self._watch = HttpConnection(access)
        self._orders: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._settled = threading.Event()
        self._ready = False
        self._checked = False
        self._refusal: RoboNeuronError | None = None
        self._problem = f"{access.url} has not been queried yet."
        self._metrics: Mapping[str, float] = {}

    @property
    def is_ready(self) -> bool:
        """True if the last poll succeeded, the model is the right one, and no request has failed
        since.
        """
        return self._ready

    @property
    def refusal(self) -> RoboNeuronError | None:
        """Reason why it must not be used although it answers: another model, release or key."""
        return self._refusal

    @property
    def problem(self) -> str:
        """Reason why it is not ready, in one sentence; empty if it is."""
        return self._problem

    @property
    def metrics(self) -> Mapping[str, float]:
        """Values of `/metrics` at the last poll; empty if the server has none."""
        return self._metrics

    @property
    def load(self) -> float:
        """Number of running and queued requests, of all its clients."""
        return self._metrics.get("served.running", 0.0) + self._metrics.get("served.queued", 0.0)

    def start(self) -> None:
        """Start monitoring."""
        self._thread = threading.Thread(
            target=self._observe, name=f"sglang {self.url}", daemon=True
        )
        self._thread.start()

    def wait_settled(self, timeout_s: float) -> bool:
        """Wait until it is ready or refused; False if neither happens within `timeout_s`."""
        return self._settled.wait(timeout_s)

    def close(self) -> None:
        """Stop monitoring and disconnect."""
        self._orders.put(_STOP)
        self._work.cut()
        self._watch.cut()
        if self._thread is not None:
            self._thread.join(_POLL_LIMIT_S + _ABORT_LIMIT_S + _IDENTITY_LIMIT_S)
            self._thread = None
        self._work.close()
        self._watch.close()

    def generate(
        self, rid: str, body: bytes, deadline_s: float, *, count: int, vocabulary: int
    ) -> Generated:
        """Send one request and wait for its reply.

        Raises:
            ServerLost, MalformedReply: another server may be tried.
            AnswerTooLate: the deadline passed; an abort of the request is queued.
            InvalidInputError: the server refuses the request.
            ConfigurationError: it refuses the key.
        """
        try:
            answer = self._work.request("POST", "/generate", deadline_s, with_id(rid, body))
            if answer.status == 200:
                return parse_reply(
                    answer.body, self.url, rid=rid, count=count, vocabulary=vocabulary
                )
            text = f"{self.url} answered {answer.status}: {error_text(answer.body)}"
            if answer.status in (401, 403):
                raise ConfigurationError(text, hint="The API key is not the server's.")
            if answer.status in (400, 413, 422):
                raise InvalidInputError(text)
            raise ServerLost(text)
        except (ServerLost, MalformedReply) as error:
            self._mistrust(str(error), check_again=True)
            raise
        except AnswerTooLate as error:
            self.abort(rid)
            self._mistrust(str(error), check_again=False)
            raise

    def abort(self, rid: str) -> None:
        """Queue the abort of a request on the server; returns at once."""
        self._orders.put(rid)

    def cut(self) -> None:
        """Interrupt the request that `generate` waits for."""
        self._work.cut()

    def _mistrust(self, problem: str, *, check_again: bool) -> None:
        """Prefer other servers until the next poll, which starts now, succeeds."""
        self._ready = False
        self._problem = problem
        if check_again:
            self._checked = False
        self._orders.put(None)

    def _observe(self) -> None:
        while True:
            self._poll()
            try:
                order = self._orders.get(timeout=self._poll_s)
                while True:
                    if order == _STOP:
                        return
                    if order is not None:
                        self._send_abort(order)
                    order = self._orders.get_nowait()
            except queue.Empty:
                continue

    def _poll(self) -> None:
        try:
            deadline_s = time.monotonic() + _POLL_LIMIT_S
            status = self._watch.request("GET", "/ready", deadline_s).status
            if status != 200:
                self._checked = False
                raise NotReadyError(f"{self.url} is not ready (status {status}).")
            if not self._checked:
                self._expectation.check(self._watch, self.url, time.monotonic() + _IDENTITY_LIMIT_S)
                self._checked = True
            self._read_metrics(deadline_s)
        except NotReadyError as error:
            self._note(str(error), None)
            if isinstance(error, ServerLost):
                self._checked = False
        except RoboNeuronError as error:
            self._note(str(error), error)
        else:
            self._note("", None)

    def _note(self, problem: str, refusal: RoboNeuronError | None) -> None:
        if problem != self._problem and self._settled.is_set():
            log.log(
                logging.WARNING if problem else logging.INFO,
                "%s",
                problem or f"{self.url} is ready again.",
            )
        self._problem, self._refusal, self._ready = problem, refusal, not problem
        if self._ready or refusal is not None:
            self._settled.set()

    def _read_metrics(self, deadline_s: float) -> None:
        answer = self._watch.request("GET", "/metrics", deadline_s)
        text = answer.body.decode("utf-8", "replace") if answer.status == 200 else ""
        self._metrics = parse_metrics(text, _WANTED)

    def _send_abort(self, rid: str) -> None:
        try:
            body = json.dumps({"rid": rid}).encode()
            self._watch.request("POST", "/abort_request", time.monotonic() + _ABORT_LIMIT_S, body)
        except NotReadyError as error:
            log.info("Request %s could not be aborted: %s", rid, error)

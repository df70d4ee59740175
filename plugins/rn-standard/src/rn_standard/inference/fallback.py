"""A second policy that acts while the first one does not answer in time.

The first may run on another machine, whose link or process comes and goes. Both move the arm
through the same executor, the same control and the same limits, so that a change from one to the
other is a change of chunks within one motion. An answer of the first that comes after the second
has taken over moves nothing: from then on its answers are only timed, until they have come in time
for a while.
"""

from __future__ import annotations

import logging
import queue
import statistics
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as NotDone
from dataclasses import dataclass, replace

from rn_standard.inference.agreement import check_same_space
from rn_standard.inference.execution import (
    ACTING,
    COUNT,
    FALLBACK,
    OVERLAP,
    REASON,
    SEQUENTIAL,
    ChunkExecutor,
    Prediction,
)
from rn_standard.inference.loaded import LoadedPolicy
from roboneuron import ActionChunk, NotReadyError, Observation
from roboneuron.feature import Config
from roboneuron.node import StatusWriter

BACK_S = 3.0
"""The first policy acts again when its answers have come in time for this long ..."""
BACK_ANSWERS = 5
"""... and when they were at least so many."""
FIRST_S = 2.0
"""Longest wait for the first answer to an instruction: the arm stands, and nothing is lost by
waiting.
"""
HOLD_AFTER_S = 0.375
"""When control holds by default; for a module whose configuration names no control."""
_RESERVE_S = 0.05
"""Kept for a busy machine, beside the time of the next image and that of the second policy."""
_LEAST_SHARE = 0.25
"""The first policy has at least this share of the time until control holds."""
_LOOK_S = 0.05
"""How often a wait looks whether it is to end."""
_RECENT = 20
log = logging.getLogger(__name__)


class Turn:
    """Whose turn it is; time comes from outside.

    Attributes:
        is_first: the first policy acts.
        reason: why it does not; empty while it does.
        count: how often the second has taken over.
    """

    def __init__(self) -> None:
        self.is_first = True
        self.reason = ""
        self.count = 0
        self._good_since_s = 0.0
        self._good = 0

    def take_over(self, reason: str) -> None:
        """The second policy acts from now on."""
        self.is_first = False
        self.reason = reason
        self.count += 1
        self._good = 0

    def note(self, in_time: bool, now_s: float) -> bool:
        """An answer of the first policy has come while the second acts; whether the first may act
        again.

        Args:
            in_time: it came early enough to be executed.
            now_s: monotonic time.
        """
        if not in_time:
            self._good = 0
            return False
        if not self._good:
            self._good_since_s = now_s
        self._good += 1
        return self._good >= BACK_ANSWERS and now_s - self._good_since_s >= BACK_S

    def give_back(self) -> None:
        """The first policy acts again."""
        self.is_first = True
        self.reason = ""


@dataclass(frozen=True, slots=True)
class _PendingRequest:
    """What the first policy was asked, when, and what it answers."""

    prediction: Prediction
    asked_s: float
    answer: Future[tuple[ActionChunk, float]]


class PolicyThread:
    """Asks one policy on a thread of its own, one request after the other."""

    def __init__(self, policy: LoadedPolicy) -> None:
        self._policy = policy
        self._requests: queue.SimpleQueue[tuple[_PendingRequest, bool] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=policy.name, daemon=True)
        self._thread.start()

    def ask(self, prediction: Prediction, resets: bool) -> _PendingRequest:
        """Ask; the answer comes with the monotonic time at which it was there.

        Args:
            prediction: what to answer.
            resets: forget what was before.
        """
        request = _PendingRequest(prediction, time.monotonic(), Future())
        self._requests.put((request, resets))
        return request

    def close(self) -> bool:
        """End after the request in progress; whether it has ended within two seconds."""
        self._requests.put(None)
        self._thread.join(2.0)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while (asked := self._requests.get()) is not None:
            request, resets = asked
            try:
                if resets:
                    self._policy.backend.reset()
                chunk = self._policy.answer(request.prediction.observation)
            except Exception as error:  # told to whoever waits, as if raised there
                request.answer.set_exception(error)
            else:
                request.answer.set_result((chunk, time.monotonic()))


class FallbackPolicies:
    """Two policies for one arm; used on the predicting thread.

    Args:
        first: acts as long as it answers in time.
        second: acts otherwise.
        executor: plays the rows of both.
        hold_after_s: time after the last row at which control holds [s].
        max_age_s: of the image behind a row [s].
        status: where to report.

    Attributes:
        on_wait: called while an answer is waited for.
    """

    def __init__(
        self,
        first: LoadedPolicy,
        second: LoadedPolicy,
        executor: ChunkExecutor,
        *,
        hold_after_s: float,
        max_age_s: float,
        status: StatusWriter,
    ) -> None:
        self._second = second
        self._names = {True: first.name, False: second.name}
        self._executor = executor
        self._hold_after_s = hold_after_s
        self._max_age_s = max_age_s
        self._status = status
        self.on_wait: Callable[[], None] = lambda: None
        self._turn = Turn()
        self._thread = PolicyThread(first)
        self._request: _PendingRequest | None = None
        self._first_resets = True
        self._has_acted = False
        self._took_s: deque[float] = deque([0.0], maxlen=_RECENT)
        self._captured_ns = 0
        self._intervals_s: deque[float] = deque(maxlen=_RECENT)  # from image to image
        self._tell()

    @classmethod
    def beside(
        cls,
        first: LoadedPolicy,
        second: LoadedPolicy,
        executor: ChunkExecutor,
        config: Config,
        status: StatusWriter,
    ) -> FallbackPolicies:
        """Two policies by what is configured.

        Raises:
            PlanningError: their rows are of different spaces.
        """
        check_same_space(first.agreement, second.agreement, second.name)
        assert config.inference is not None
        return cls(
            first,
            second,
            executor,
            hold_after_s=HOLD_AFTER_S if config.control is None else config.control.hold_after_s,
            max_age_s=config.inference.max_image_age_s,
            status=status,
        )

    def answer(
        self,
        prediction: Prediction,
        measured: Observation,
        resets: bool,
        stop: threading.Event,
    ) -> tuple[Prediction, ActionChunk] | None:
        """The answer of the policy whose turn it is, with what it answers.

        Args:
            prediction: the newest, as the first policy is to get it.
            measured: its observation without what the executor has added or rolled forward.
            resets: the instruction is new; what was before is forgotten.
            stop: ends the wait.

        Returns:
            None when there is none: the first policy was too late, or `stop` is set. The next image
            is to be asked about then.

        Raises:
            RoboNeuronError: what the policy says against the observation.
        """
        if resets:
            self._first_resets, self._has_acted = True, False
            self._second.backend.reset()
        self._note_image(prediction.captured_ns)
        if self._turn.is_first:
            found = self._of_first(prediction, stop)
        else:
            found = self._of_either(replace(prediction, observation=measured))
        self._has_acted = self._has_acted or found is not None
        return found

    def close(self) -> bool:
        """End the thread of the first policy; whether it has ended."""
        return self._thread.close()

    def _of_first(
        self, prediction: Prediction, stop: threading.Event
    ) -> tuple[Prediction, ActionChunk] | None:
        """The first policy's answer; None when it is too late, and the second takes over."""
        end_s = self._deadline_s()
        if not self._wait(end_s, stop):  # still at work on what was withdrawn
            return None
        request = self._ask(prediction)
        if not self._wait(end_s, stop):
            return None
        self._request = None
        try:
            chunk, _ = request.answer.result()
        except NotReadyError as error:
            self._take_over(error.message)
            return None
        return prediction, chunk

    def _of_either(self, prediction: Prediction) -> tuple[Prediction, ActionChunk]:
        """The first policy's newest answer when its turn has come again, else the second's."""
        request = self._request
        if request is not None and request.answer.done():
            self._request = None
            chunk = self._judged(request)
            if chunk is not None:
                self._turn.give_back()
                log.warning("%s answers in time again, and acts.", self._names[True])
                self._tell()
                return request.prediction, chunk
        if self._request is None:
            # Rows of the second have another period: the first is not told of them, and its answer
            # is faded into them.
            is_sequential = prediction.mode == SEQUENTIAL
            self._ask(prediction if is_sequential else replace(prediction, mode=OVERLAP))
        began_s = time.monotonic()
        chunk = self._second.answer(prediction.observation)
        self._took_s.append(time.monotonic() - began_s)
        note = f"{self._names[False]} acts in place of {self._names[True]}: {self._turn.reason}"
        told = replace(chunk, note=f"{note} {chunk.note}".strip())
        return replace(prediction, mode=FALLBACK), told

    def _judged(self, request: _PendingRequest) -> ActionChunk | None:
        """The answer to execute from now on; None as long as the second policy acts."""
        try:
            chunk, at_s = request.answer.result()
        except Exception as error:
            self._turn.note(False, time.monotonic())
            self._turn.reason = getattr(error, "message", repr(error))
            return None
        allowed_s = min(self._max_age_s, self._slack_s() + self._executor.lead_s(chunk))
        in_time = at_s - request.asked_s <= allowed_s
        if not in_time:
            self._turn.reason = f"answers take {at_s - request.asked_s:.2g} s."
        return chunk if self._turn.note(in_time, time.monotonic()) else None

    def _ask(self, prediction: Prediction) -> _PendingRequest:
        self._request = self._thread.ask(prediction, self._first_resets)
        self._first_resets = False
        return self._request

    def _wait(self, end_s: float, stop: threading.Event) -> bool:
        """Wait for the request in progress; False when the second policy has taken over, or `stop`
        is set.
        """
        while self._request is not None and not stop.is_set():
            left_s = end_s - time.monotonic()
            if left_s <= 0.0:
                waited_s = time.monotonic() - self._request.asked_s
                self._take_over(f"no answer within {waited_s:.2g} s.")
                return False
            try:
                self._request.answer.exception(min(left_s, _LOOK_S))
            except NotDone:
                self.on_wait()
            else:
                break
        return not stop.is_set()

    def _deadline_s(self) -> float:
        """Monotonic time until which the second policy can still go on before control holds [s]."""
        now_s = time.monotonic()
        if not self._has_acted:
            return now_s + FIRST_S
        end_s = self._executor.end_s()
        return max(now_s, now_s if end_s is None else end_s) + self._slack_s()

    def _slack_s(self) -> float:
        """How long after the last row an answer of the first policy is waited for [s]."""
        reserve_s = _RESERVE_S + 2.0 * statistics.median(self._took_s)
        if self._intervals_s:
            reserve_s += statistics.median(self._intervals_s)
        return max(self._hold_after_s - reserve_s, _LEAST_SHARE * self._hold_after_s)

    def _note_image(self, captured_ns: int) -> None:
        interval_s = (captured_ns - self._captured_ns) / 1e9
        self._captured_ns = captured_ns
        # a longer pause is no camera's period
        if 0.0 < interval_s < self._max_age_s:
            self._intervals_s.append(interval_s)

    def _take_over(self, reason: str) -> None:
        self._turn.take_over(reason)
        log.warning("%s acts in place of %s: %s", self._names[False], self._names[True], reason)
        self._tell()

    def _tell(self) -> None:
        self._status.set_value(ACTING, self._names[self._turn.is_first])
        self._status.set_value(REASON, self._turn.reason)
        self._status.set_value(COUNT, self._turn.count)
        self._status.changed.set()

"""Fallback policy that acts while the first one does not answer in time.

The first may run on another machine, whose link or process may fail. Both move the arm through the
same executor, control and limits, so a change of policy is a change of chunks within one motion.
After the second has taken over, answers of the first move nothing: they are only timed, until they
have been in time for a while.
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

from roboneuron.config.models import Config
from roboneuron.contract import ActionChunk
from roboneuron.errors import NotReadyError
from roboneuron.modules.inference.agreement import check_same_space
from roboneuron.modules.inference.execution import (
    FALLBACK,
    ChunkExecutor,
    Prediction,
)
from roboneuron.modules.inference.loaded import LoadedPolicy
from roboneuron.modules.predictions import (
    OVERLAP,
    SEQUENTIAL,
    AnsweredPrediction,
    PredictionRequest,
)
from roboneuron.modules.status import StatusWriter
from roboneuron.modules.step_filters import StepFilter

BACK_S = 3.0
"""The first policy acts again after its answers were in time for this long ..."""
BACK_ANSWERS = 5
"""... and were at least this many."""
FIRST_S = 2.0
"""Longest wait for the first answer to an instruction: the arm does not move yet, so waiting costs
nothing.
"""
HOLD_AFTER_S = 0.375
"""Default time after which control holds, for a module whose configuration has no control
section.
"""
_RESERVE_S = 0.05
"""Reserve for a busy machine, in addition to the time of the next image and of the second
policy.
"""
_LEAST_SHARE = 0.25
"""Minimum fraction of the time until control holds that the first policy gets."""
_LOOK_S = 0.05
"""Polling period of a wait."""
_RECENT = 20
log = logging.getLogger(__name__)


class Turn:
    """State of the switch between two policies; time is an argument.

    Attributes:
        is_first: the first policy acts.
        reason: why it does not; empty while it does.
        count: number of takeovers by the second.
    """

    def __init__(self) -> None:
        self.is_first = True
        self.reason = ""
        self.count = 0
        self._good_since_s = 0.0
        self._good = 0

    def take_over(self, reason: str) -> None:
        """Switch to the second policy."""
        self.is_first = False
        self.reason = reason
        self.count += 1
        self._good = 0

    def note(self, in_time: bool, now_s: float) -> bool:
        """Record an answer of the first policy while the second acts; return True if the first may
        act again.

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
        """Switch back to the first policy."""
        self.is_first = True
        self.reason = ""


@dataclass(frozen=True, slots=True)
class _PendingRequest:
    """Request to the first policy, its time, and its answer."""

    prediction: Prediction
    asked_s: float
    answer: Future[tuple[ActionChunk, float]]


class PolicyThread:
    """Runs one policy on a background thread, one request after the other."""

    def __init__(self, policy: LoadedPolicy) -> None:
        self._policy = policy
        self._requests: queue.SimpleQueue[tuple[_PendingRequest, bool] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=policy.name, daemon=True)
        self._thread.start()

    def ask(self, prediction: Prediction, resets: bool) -> _PendingRequest:
        """Start a request; the answer includes the monotonic time of its completion.

        Args:
            prediction: the input.
            resets: reset the policy first.
        """
        request = _PendingRequest(prediction, time.monotonic(), Future())
        self._requests.put((request, resets))
        return request

    def close(self) -> bool:
        """End after the request in progress; return True if it ended within two seconds."""
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
            except Exception as error:  # raised again in the waiting thread
                request.answer.set_exception(error)
            else:
                request.answer.set_result((chunk, time.monotonic()))


class FallbackPolicies(StepFilter):
    """Two policies for one arm; used on the predicting thread.

    Args:
        first: acts as long as it answers in time.
        second: acts otherwise.
        executor: plays the rows of both.
        hold_after_s: time after the last row at which control holds [s].
        max_age_s: largest age of the image behind a row [s].
        status: receives the reports.

    Attributes:
        on_wait: called while waiting for an answer.
    """

    phase = StepFilter.StepPhase.POLICY

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
        self._set_status()

    @classmethod
    def beside(
        cls,
        first: LoadedPolicy,
        second: LoadedPolicy,
        executor: ChunkExecutor,
        config: Config,
        status: StatusWriter,
    ) -> FallbackPolicies:
        """Create both policies from the configuration.

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

    def predict(
        self,
        request: PredictionRequest,
        proceed: Callable[[PredictionRequest], AnsweredPrediction | None],
    ) -> AnsweredPrediction | None:
        """Return the answer of the acting policy, with its input; see `StepFilter.predict`. The
        first policy is asked on its own thread, so nothing proceeds.

        Returns:
            None without an answer: the first policy was too late, or the request's `stop` is set.
            Continue with the next image then.

        Raises:
            RoboNeuronError: the policy refuses the observation.
        """
        prediction = request.prediction
        if request.resets:
            self._first_resets, self._has_acted = True, False
            self._second.backend.reset()
        self._note_image(prediction.captured_ns)
        if self._turn.is_first:
            found = self._of_first(prediction, request.stop)
        else:
            found = self._of_either(replace(prediction, observation=request.measured))
        if found is None:
            return None
        self._has_acted = True
        return AnsweredPrediction(prediction=found[0], chunk=found[1], stop=request.stop)

    def close(self) -> bool:
        """End the thread of the first policy; return True if it has ended."""
        return self._thread.close()

    def _of_first(
        self, prediction: Prediction, stop: threading.Event
    ) -> tuple[Prediction, ActionChunk] | None:
        """Return the first policy's answer; None if it is too late and the second takes over."""
        end_s = self._deadline_s()
        if not self._wait(end_s, stop):  # still busy with a withdrawn request
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
        """Return the first policy's newest answer if it acts again, else the second's."""
        request = self._request
        if request is not None and request.answer.done():
            self._request = None
            chunk = self._judged(request)
            if chunk is not None:
                self._turn.give_back()
                log.warning("%s answers in time again, and acts.", self._names[True])
                self._set_status()
                self._status.tell(
                    "fallback_over", f"{self._names[True]} answers in time, and acts again"
                )
                return request.prediction, chunk
        if self._request is None:
            # Rows of the second have another period: the first does not get them, and its answer is
            # cross-faded into them.
            is_sequential = prediction.mode == SEQUENTIAL
            self._ask(prediction if is_sequential else replace(prediction, mode=OVERLAP))
        began_s = time.monotonic()
        chunk = self._second.answer(prediction.observation)
        self._took_s.append(time.monotonic() - began_s)
        note = f"{self._names[False]} acts in place of {self._names[True]}: {self._turn.reason}"
        told = replace(chunk, note=f"{note} {chunk.note}".strip())
        return replace(prediction, mode=FALLBACK), told

    def _judged(self, request: _PendingRequest) -> ActionChunk | None:
        """Return the answer to execute from now on; None as long as the second policy acts."""
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
        """Wait for the request in progress; return False if the second policy has taken over, or
        `stop` is set.
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
        """Monotonic time until which the second policy can continue before control holds [s]."""
        now_s = time.monotonic()
        if not self._has_acted:
            return now_s + FIRST_S
        end_s = self._executor.end_s()
        return max(now_s, now_s if end_s is None else end_s) + self._slack_s()

    def _slack_s(self) -> float:
        """Time after the last row for which an answer of the first policy is awaited [s]."""
        reserve_s = _RESERVE_S + 2.0 * statistics.median(self._took_s)
        if self._intervals_s:
            reserve_s += statistics.median(self._intervals_s)
        return max(self._hold_after_s - reserve_s, _LEAST_SHARE * self._hold_after_s)

    def _note_image(self, captured_ns: int) -> None:
        interval_s = (captured_ns - self._captured_ns) / 1e9
        self._captured_ns = captured_ns
        # a longer pause is not a camera's period
        if 0.0 < interval_s < self._max_age_s:
            self._intervals_s.append(interval_s)

    def _take_over(self, reason: str) -> None:
        self._turn.take_over(reason)
        log.warning("%s acts in place of %s: %s", self._names[False], self._names[True], reason)
        self._set_status()
        self._status.tell("fallback", f"{self._names[False]} acts: {reason}")

    def _set_status(self) -> None:
        self._status.set_value("fallback.acting", self._names[self._turn.is_first])
        self._status.set_value("fallback.reason", self._turn.reason)
        self._status.set_value("fallback.count", self._turn.count)

"""Handover of an inference module: selection of its images, and treatment of its answers in
shadow.
"""

from __future__ import annotations

from collections.abc import Callable

from roboneuron.errors import NotReadyError
from roboneuron.modules.inference.module import InferenceModule
from roboneuron.modules.predictions import AnsweredPrediction
from roboneuron.modules.step_filters import StepFilter
from roboneuron.switching.handover import TimedHandover


class InferenceHandover(StepFilter):
    """Stands between images and predictions, and between answers and actions."""

    phase = StepFilter.StepPhase.POLICY

    def __init__(self, module: InferenceModule, handover: TimedHandover) -> None:
        self._module, self._handover = module, handover

    def prepare(self) -> None:
        """See `TimedHandover.rest`."""
        self._handover.rest()

    def admits(self, stamp_ns: int) -> bool:
        """True to predict on an image of that capture time [ns]."""
        is_over = not self._handover.admits(stamp_ns)
        if is_over:
            self._module.status.set(note="handed over to the successor")
        return stamp_ns >= self._handover.not_before_ns and not is_over

    def deliver(
        self, answer: AnsweredPrediction, proceed: Callable[[AnsweredPrediction], None]
    ) -> None:
        """Execute an answer, or in shadow only measure it, which also shows readiness.

        Raises:
            NotReadyError: an answer in shadow comes too late to be acted on.
        """
        prediction = answer.prediction
        if self._handover.sends(prediction.captured_ns):
            proceed(answer)
            return
        module = self._module
        status, now_ns = module.status, module.node.now_ns()
        status.set(note="in shadow")
        module.executor.measure(prediction, answer.chunk, now_ns)
        oldest_ns = prediction.observation.stamp_ns
        age_s = (now_ns - oldest_ns) / 1e9
        section = module.config.inference
        assert section is not None
        if age_s > section.max_image_age_s:
            status.drop("late_action")
            raise NotReadyError(
                f"The backend answered to an image that was {age_s:.2f} s old by then; "
                f"max_image_age_s = {section.max_image_age_s:g} are allowed.",
                hint="Make the backend faster, or allow older images under [inference].",
            )
        self._handover.withhold(answer.chunk)
        module.note_first(oldest_ns)

"""Handover of an inference module: selection of its images, and treatment of its answers in
shadow.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial

from rn_standard.inference import execution
from rn_standard.inference.module import InferenceModule
from rn_standard.switching.handover import TimedHandover
from roboneuron import ActionChunk, NotReadyError

Deliver = Callable[[execution.Prediction, ActionChunk, threading.Event], None]


def come_between(module: InferenceModule, handover: TimedHandover) -> None:
    """Install the handover between images and predictions, and between answers and actions."""
    module.before_prediction.append(handover.rest)
    module.accepts.append(partial(_accepts, module, handover))
    module.deliver = partial(_deliver, module, handover, module.deliver)


def _accepts(module: InferenceModule, handover: TimedHandover, captured_ns: int) -> bool:
    """True to predict on an image of that capture time [ns]."""
    is_over = handover.is_over(captured_ns)
    if is_over:
        module.status.set(note="handed over to the successor")
    return captured_ns >= handover.not_before_ns and not is_over


def _deliver(
    module: InferenceModule,
    handover: TimedHandover,
    deliver: Deliver,
    prediction: execution.Prediction,
    chunk: ActionChunk,
    stop: threading.Event,
) -> None:
    """Execute an answer, or in shadow only measure it, which also shows readiness.

    Raises:
        NotReadyError: an answer in shadow comes too late to be acted on.
    """
    if not handover.is_shadow(prediction.captured_ns):
        deliver(prediction, chunk, stop)
        return
    status, now_ns = module.status, module.node.now_ns()
    status.set(note="in shadow")
    module.executor.measure(prediction, chunk, now_ns)
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
    handover.withhold(chunk)
    module.note_first(oldest_ns)

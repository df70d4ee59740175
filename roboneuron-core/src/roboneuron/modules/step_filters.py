"""Step filters: what stands between the inputs, the steps and the outputs of inference and control,
in one ordered list.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from typing import TYPE_CHECKING, ClassVar

if TYPE_CHECKING:
    from roboneuron.contract import ActionChunk, Hold, JointCommand, Pose
    from roboneuron.gate.motion.command import Asked, LimitedCommand
    from roboneuron.modules.predictions import (
        AnsweredPrediction,
        Bounds,
        Prediction,
        PredictionRequest,
    )
    from roboneuron.plugins.specs import BackendSpec

__all__ = ["ActionStep", "StepFilter"]
"""Names that other distributions may use."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ActionStep:
    """One action on its way through control.

    Attributes:
        source_ns: time at which it was sent [ROS time, ns].
        read: returns its content; raises RoboNeuronError.
    """

    source_ns: int
    read: Callable[[], Asked]


class StepFilter:
    """Base of step filters; each method passes on what it is given.

    Inputs are identified by their time stamps [ROS time, ns]: capture times of images, times at
    which actions were sent and joints measured. Methods are called from any of the module's
    threads, unless they say which.

    Attributes:
        phase: place in the list; within a phase the one that was added first comes first.
    """

    class StepPhase(IntEnum):
        """Order of the filters."""

        CLOCK = 1
        PERSON = 2
        POLICY = 3
        HANDOVER = 4
        EXECUTION = 5
        REPORT = 6

    phase: ClassVar[StepPhase] = StepPhase.REPORT

    def admits(self, stamp_ns: int) -> bool:
        """True if the module may process an input of that time."""
        return True

    def sends(self, stamp_ns: int) -> bool:
        """True if what the module makes of an input of that time is sent."""
        return True

    def withhold(self, output: JointCommand | Hold | Pose) -> None:
        """Receive an output that is not sent, because a filter says so."""

    def note_sent(self, what: str) -> None:
        """Record that an output of that name was sent."""

    def act(self, step: ActionStep, proceed: Callable[[ActionStep], None]) -> None:
        """Pass on an action of the policy, on control's executor; now, later, changed or never."""
        proceed(step)

    def note_limited(self, limited: LimitedCommand) -> None:
        """Record a command of control after the limits were applied, before it is sent."""

    def prepare(self) -> None:
        """Called on the predicting thread between two predictions."""

    def predict(
        self,
        request: PredictionRequest,
        proceed: Callable[[PredictionRequest], AnsweredPrediction | None],
    ) -> AnsweredPrediction | None:
        """Return the answer to a request, on the predicting thread; None if there is none in time.
        An exception drops the rows of earlier answers.
        """
        return proceed(request)

    def note_answer(
        self, prediction: Prediction, resets: bool, answer: ActionChunk | Exception
    ) -> None:
        """Record an answer or its error, on the predicting thread.

        Args:
            prediction: with the policy's input.
            resets: the policy was reset before.
            answer: the chunk, whose rows are not sent yet, or the error.
        """

    def deliver(
        self, answer: AnsweredPrediction, proceed: Callable[[AnsweredPrediction], None]
    ) -> None:
        """Pass on an answer to be executed, on the predicting thread."""
        proceed(answer)

    def executor(self, backend: BackendSpec, mode: str, bounds: Bounds) -> object | None:
        """Create the `ChunkExecutor` of a backend; None to leave that to others.

        Args:
            backend: its descriptor.
            mode: `inference.execution` of the configuration.
            bounds: ages of images.

        Raises:
            ConfigurationError: the backend does not support the mode.
        """
        return None

    def may_play(self, now_ns: int) -> bool:
        """True if a row that is due may be sent; called with the executor's lock held."""
        return True

    def ends_rows(self, now_ns: int) -> bool:
        """True if the rest of a chunk is not to be sent; called with the executor's lock held."""
        return False


class StepFilters:
    """The filters of one module, in their order.

    Args:
        filters: added before the module was made.
    """

    def __init__(self, filters: Iterable[StepFilter] = ()) -> None:
        # replaced as a whole, never changed: read by other threads
        self._filters: tuple[StepFilter, ...] = ()
        for one in filters:
            self.add(one)

    def __iter__(self) -> Iterator[StepFilter]:
        return iter(self._filters)

    def add(self, added: StepFilter) -> None:
        """Add a filter, behind those of its phase; from `ModuleHost.on_configured`, before a module
        is active.
        """
        self._filters = tuple(sorted((*self._filters, added), key=lambda one: one.phase))

    def admits(self, stamp_ns: int) -> bool:
        """See `StepFilter.admits`."""
        return all(one.admits(stamp_ns) for one in self._filters)

    def sends(self, stamp_ns: int) -> bool:
        """See `StepFilter.sends`."""
        return all(one.sends(stamp_ns) for one in self._filters)

    def is_ours(self, stamp_ns: int) -> bool:
        """True if this module has to act on an input of that time."""
        return self.sends(stamp_ns) and self.admits(stamp_ns)

    def withhold(self, output: JointCommand | Hold | Pose) -> None:
        """See `StepFilter.withhold`."""
        for one in self._filters:
            one.withhold(output)

    def note_sent(self, what: str) -> None:
        """See `StepFilter.note_sent`."""
        for one in self._filters:
            one.note_sent(what)

    def act(self, step: ActionStep, last: Callable[[ActionStep], None]) -> None:
        """Pass an action through all filters to `last`."""
        for one in reversed(self._filters):
            last = partial(one.act, proceed=last)
        last(step)

    def predict(
        self,
        request: PredictionRequest,
        last: Callable[[PredictionRequest], AnsweredPrediction | None],
    ) -> AnsweredPrediction | None:
        """Pass a request through all filters to `last`."""
        for one in reversed(self._filters):
            last = partial(one.predict, proceed=last)
        return last(request)

    def deliver(
        self, answer: AnsweredPrediction, last: Callable[[AnsweredPrediction], None]
    ) -> None:
        """Pass an answer through all filters to `last`."""
        for one in reversed(self._filters):
            last = partial(one.deliver, proceed=last)
        last(answer)

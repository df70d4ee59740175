"""Tool publish_<name>_sequence: consecutive messages, each with its duration."""

from __future__ import annotations

import itertools
import threading
from functools import partial
from typing import Annotated

from pydantic import Field

from roboneuron.errors import InvalidInputError
from roboneuron.server.motion_gate import ExposedEndpoint, GateRequest, MotionGate
from roboneuron.server.tool import Arguments, CallContext
from roboneuron.tools.ros.calls import PublishingCall, Value, duration_s
from roboneuron.tools.ros.exposed_types import message_of
from roboneuron.tools.ros.publish import Delivery, encode_step, to_delivery
from roboneuron.tools.ros.steps import MessageStep, publish_steps
from roboneuron.tools.ros.targets import Targets

MAX_STEPS = 500


class SequenceStep(Arguments):
    """One message and its duration."""

    message: Value = Field(default_factory=dict)
    duration_s: float | None = Field(default=None, gt=0, description="Duration of this step [s].")


class PublishSequence(PublishingCall):
    """Arguments of a sequence tool."""

    steps: Annotated[list[SequenceStep], Field(min_length=1, max_length=MAX_STEPS)]
    times: int = Field(default=1, ge=1, le=1000, description="Repetitions of the whole sequence.")


class Sequencing:
    """The handler of one sequence tool."""

    def __init__(self, gate: MotionGate, targets: Targets, tool: str) -> None:
        self._gate = gate
        self._targets = targets
        self._tool = tool

    async def __call__(self, arguments: PublishSequence, context: CallContext) -> Delivery:
        """Raises as `MotionGate.play`, and InvalidInputError with the number of the step."""
        exposed = self._targets.of(arguments.robot)
        times = arguments.times
        steps = [self._step(exposed, entry, index) for index, entry in enumerate(arguments.steps)]
        total_s = times * sum(step.duration_s for step in steps)
        if total_s > self._gate.max_duration_s:
            raise InvalidInputError(
                f"The sequence would last {total_s:g} s, allowed is {self._gate.max_duration_s:g} "
                "s.",
                path="steps",
            )
        if times * len(steps) > MAX_STEPS:
            raise InvalidInputError(
                f"{times} x {len(steps)} steps are more than {MAX_STEPS}.", path="times"
            )
        played = steps * times
        starts_s = [0.0, *itertools.accumulate(step.duration_s for step in played)][:-1]
        joint_limited = exposed.endpoint.joint_limited  # needs the end of the previous step
        request = GateRequest.of(
            context,
            self._tool,
            exposed,
            [step.message for step in (played if joint_limited else steps)],
            arguments.given(),
            joints=self._gate.newest_joints(exposed) if joint_limited else None,
            durations_s=[step.duration_s for step in played] if joint_limited else [],
            send_at_s=starts_s,
        )
        halt = threading.Event()
        work = partial(
            publish_steps,
            self._gate,
            exposed,
            request,
            played,
            timeout_s=arguments.timeout_s,
            halt=halt,
        )
        return to_delivery(exposed, await context.run(work, on_cancel=halt.set, on_leave=halt.set))

    def _step(self, exposed: ExposedEndpoint, entry: SequenceStep, index: int) -> MessageStep:
        interface = message_of(exposed)
        try:
            if interface.fields and "message" not in entry.model_fields_set:
                raise InvalidInputError("Argument 'message' is missing.", path="message")
            if self._targets.trajectory and entry.duration_s is None:
                step = encode_step(interface, entry.message, 0.0)
                step.duration_s = duration_s(step.message)
                return step
            if entry.duration_s is None:
                raise InvalidInputError("Argument 'duration_s' is missing.", path="duration_s")
            most_s = self._gate.max_duration_s
            if entry.duration_s > most_s:
                raise InvalidInputError(
                    f"Argument 'duration_s' is {entry.duration_s:g}, expected up to {most_s:g}.",
                    path="duration_s",
                )
            return encode_step(interface, entry.message, entry.duration_s)
        except InvalidInputError as error:
            where = f"steps[{index}]"
            raise InvalidInputError(
                f"{where}: {error.message}",
                hint=error.hint,
                path=f"{where}.{error.path}" if error.path else where,
            ) from error

"""publish_<name>_sequence: messages that follow each other, each with its duration."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Mapping
from typing import Any

from rn_tools_ros.arguments import Number, check_names, inside, take_flag, take_list
from rn_tools_ros.calls import SUBSCRIBER_TIMEOUT, duration_s
from rn_tools_ros.publish import encode_step, to_answer
from rn_tools_ros.targets import Targets
from roboneuron.errors import InvalidInputError
from roboneuron.server.motion.delivery import Sent, Step
from roboneuron.server.motion.exposed import Exposed, gate_request
from roboneuron.server.motion.gate import MotionGate
from roboneuron.server.tool import Answer, CallContext, Stage

MAX_STEPS = 500
TIMES = Number(text="How often the whole sequence is played.", low=1, high=1000, default=1, integer=True)


class Sequencing:
    """The handler of one sequence tool."""

    def __init__(self, gate: MotionGate, targets: Targets, tool: str) -> None:
        self._gate = gate
        self._targets = targets
        self._tool = tool
        self.duration = Number(
            text="How long this step lasts, in seconds.", low=0.0, high=gate.max_duration_s, above=True
        )
        self._names = [*targets.arguments, "steps", "times", "timeout_s", "dry_run"]

    async def __call__(self, arguments: Mapping[str, Any], context: CallContext) -> Answer:
        """Raises as `MotionGate.play`, and InvalidInputError with the number of the step."""
        check_names(arguments, self._names)
        exposed = self._targets.take(arguments)
        timeout_s = SUBSCRIBER_TIMEOUT.take("timeout_s", arguments)
        dry_run = take_flag(arguments, "dry_run")
        times = int(TIMES.take("times", arguments))
        entries = take_list(arguments, "steps", MAX_STEPS)
        steps = [self._step(exposed, entry, index) for index, entry in enumerate(entries)]
        total_s = times * sum(step.duration_s for step in steps)
        if total_s > self._gate.max_duration_s:
            raise InvalidInputError(
                f"The sequence would last {total_s:g} s, allowed is {self._gate.max_duration_s:g} s.", path="steps"
            )
        if times * len(steps) > MAX_STEPS:
            raise InvalidInputError(f"{times} x {len(steps)} steps are more than {MAX_STEPS}.", path="times")
        played = steps * times
        starts_s = [0.0, *itertools.accumulate(step.duration_s for step in played)][:-1]
        joint_limited = exposed.endpoint.joint_limited  # then it matters where the step before ends
        request = gate_request(
            context, self._tool, exposed, [step.message for step in (played if joint_limited else steps)], arguments,
            joints=self._gate.newest_joints(exposed) if joint_limited else None,
            durations_s=[step.duration_s for step in played] if joint_limited else [], send_at_s=starts_s,
            dry_run=dry_run,
        )  # fmt: skip
        halt = threading.Event()

        def work(stage: Stage) -> Sent:
            return self._gate.publish(exposed, request, played, timeout_s=timeout_s, stage=stage, halt=halt)

        return to_answer(exposed, await context.run(work, on_cancel=halt.set, on_leave=halt.set))

    def _step(self, exposed: Exposed, entry: Any, index: int) -> Step:
        where = f"steps[{index}]"
        if not isinstance(entry, Mapping):
            raise InvalidInputError(f"{where} is not an object with `message` and `duration_s`.", path=where)
        try:
            check_names(entry, ["message", "duration_s"])
            if self._targets.trajectory and entry.get("duration_s") is None:
                step = encode_step(exposed, entry, "message", 0.0)
                step.duration_s = duration_s(step.message)
                return step
            return encode_step(exposed, entry, "message", self.duration.take("duration_s", entry))
        except InvalidInputError as error:
            raise inside(error, where) from error

"""publish_<name>_sequence: messages that follow each other, each with its duration."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Mapping
from typing import Any

from roboneuron.errors import InvalidInputError
from roboneuron.server.direct.access import Access
from roboneuron.server.direct.arguments import Number, check_names, inside, take_flag, take_list
from roboneuron.server.direct.delivery import TIMEOUT, Step, carry_out
from roboneuron.server.direct.endpoints import Exposed
from roboneuron.server.direct.joint_commands import duration_s
from roboneuron.server.direct.publish import encode_step
from roboneuron.server.direct.request import gate_request
from roboneuron.server.direct.targets import Targets
from roboneuron.server.tool import Answer, CallContext

MAX_STEPS = 500
TIMES = Number(text="How often the whole sequence is played.", low=1, high=1000, default=1, integer=True)


class Sequencing:
    """The handler of one sequence tool."""

    def __init__(self, access: Access, targets: Targets, tool: str) -> None:
        self._access = access
        self._targets = targets
        self._tool = tool
        self.duration = Number(
            text="How long this step lasts, in seconds.", low=0.0, high=access.max_duration_s, above=True
        )
        self._names = [*targets.arguments, "steps", "times", "timeout_s", "dry_run"]

    async def __call__(self, arguments: Mapping[str, Any], context: CallContext) -> Answer:
        """Raises as `delivery.carry_out`, and InvalidInputError with the number of the step."""
        check_names(arguments, self._names)
        exposed = self._targets.take(arguments)
        timeout_s = TIMEOUT.take("timeout_s", arguments)
        dry_run = take_flag(arguments, "dry_run")
        times = int(TIMES.take("times", arguments))
        entries = take_list(arguments, "steps", MAX_STEPS)
        steps = [self._step(exposed, entry, index) for index, entry in enumerate(entries)]
        total_s = times * sum(step.duration_s for step in steps)
        if total_s > self._access.max_duration_s:
            raise InvalidInputError(
                f"The sequence would last {total_s:g} s, allowed is {self._access.max_duration_s:g} s.", path="steps"
            )
        if times * len(steps) > MAX_STEPS:
            raise InvalidInputError(f"{times} x {len(steps)} steps are more than {MAX_STEPS}.", path="times")
        played = steps * times
        starts_s = [0.0, *itertools.accumulate(step.duration_s for step in played)][:-1]
        joint_limited = exposed.endpoint.joint_limited  # then it matters where the step before ends
        request = gate_request(
            context, self._tool, exposed, [step.message for step in (played if joint_limited else steps)], arguments,
            joints=self._access.traffic.newest_joints(exposed) if joint_limited else None,
            durations_s=[step.duration_s for step in played] if joint_limited else [], send_at_s=starts_s,
            dry_run=dry_run,
        )  # fmt: skip
        halt = threading.Event()
        return await context.run(
            lambda stage: carry_out(self._access, exposed, request, played, timeout_s, stage, halt),
            on_cancel=halt.set,
            on_leave=halt.set,
        )

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

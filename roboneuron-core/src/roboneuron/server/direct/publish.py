"""publish_<name>: one message to whoever listens, or a value that lasts and ends in the stop message."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

from roboneuron.errors import InvalidInputError
from roboneuron.server.direct.access import Access
from roboneuron.server.direct.arguments import Number, check_names, take_flag
from roboneuron.server.direct.delivery import TIMEOUT, Step, carry_out, is_stamp_omitted, send_now
from roboneuron.server.direct.endpoints import Exposed
from roboneuron.server.direct.joint_commands import duration_s as trajectory_s
from roboneuron.server.direct.request import encode_argument, gate_request
from roboneuron.server.direct.targets import Targets
from roboneuron.server.tool import Answer, CallContext


def duration_argument(access: Access) -> Number:
    """How long a value lasts."""
    return Number(
        text="How long it lasts, in seconds; then it is stopped. Joints get there within it.",
        low=0.0, high=access.max_duration_s, default=1.0, above=True,
    )  # fmt: skip


class Publishing:
    """The handler of one publish tool."""

    def __init__(self, access: Access, targets: Targets, tool: str) -> None:
        self._access = access
        self._targets = targets
        self._tool = tool
        self._duration = duration_argument(access)
        lasting = targets.lasting
        self._names = [*targets.arguments, "message", *(["duration_s"] if lasting else []), "timeout_s", "dry_run"]

    async def __call__(self, arguments: Mapping[str, Any], context: CallContext) -> Answer:
        """Raises InvalidInputError, RefusedError, NotReadyError, StateError, ConfigurationError."""
        check_names(arguments, self._names)
        exposed = self._targets.take(arguments)
        timeout_s = TIMEOUT.take("timeout_s", arguments)
        dry_run = take_flag(arguments, "dry_run")
        duration_s = self._duration.take("duration_s", arguments) if self._targets.lasting else 0.0
        step = encode_step(exposed, arguments, "message", duration_s)
        if self._targets.trajectory:
            step.duration_s = trajectory_s(step.message)
            if step.duration_s > self._access.max_duration_s:
                raise InvalidInputError(
                    f"The trajectory would last {step.duration_s:g} s, allowed is {self._access.max_duration_s:g} s.",
                    path="message.points",
                )
        request = gate_request(
            context, self._tool, exposed, [step.message], arguments,
            joints=self._access.traffic.newest_joints(exposed) if exposed.endpoint.joint_limited else None,
            durations_s=[step.duration_s] if exposed.endpoint.joint_limited else [], dry_run=dry_run,
        )  # fmt: skip
        if not step.duration_s:
            answer = send_now(self._access, exposed, request)
            if answer is not None:
                return answer
        halt = threading.Event()
        return await context.run(
            lambda stage: carry_out(self._access, exposed, request, [step], timeout_s, stage, halt),
            on_cancel=halt.set,
            on_leave=halt.set,
        )


def encode_step(exposed: Exposed, arguments: Mapping[str, Any], name: str, duration_s: float) -> Step:
    """The message of a call, encoded. Raises InvalidInputError with the path inside the arguments."""
    message = encode_argument(exposed.message, arguments, name)
    return Step(message=message, duration_s=duration_s, stamped=is_stamp_omitted(exposed, arguments.get(name) or {}))

"""What the gate is asked for a tool call."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from roboneuron.contract import JointSample
from roboneuron.gate import GateRequest
from roboneuron.server.motion.exposed import Exposed
from roboneuron.server.tool import CallContext


def gate_request(
    context: CallContext, tool: str, exposed: Exposed, messages: Sequence[Any], arguments: Mapping[str, Any], *,
    joints: JointSample | None = None, durations_s: Sequence[float] = (),
    send_at_s: Sequence[float] = (), dry_run: bool = False,
) -> GateRequest:  # fmt: skip
    """What the gate is asked for this call."""
    return GateRequest(
        who=context.who,
        role=context.role,
        tool=tool,
        robot=exposed.robot,
        endpoint=exposed.endpoint.name,
        messages=tuple(messages),
        arguments=arguments,
        joints=joints,
        durations_s=tuple(durations_s),
        send_at_s=tuple(send_at_s),
        dry_run=dry_run,
    )

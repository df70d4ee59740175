"""What all handlers do with a call: encode what it holds, ask the gate, tell the verdict."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

from roboneuron.contract import JointSample
from roboneuron.errors import InvalidInputError, RefusedError
from roboneuron.gate import GateRequest, Verdict
from roboneuron.interfaces import MessageInterface
from roboneuron.server.direct.access import Access
from roboneuron.server.direct.arguments import Schema, inside, take_object
from roboneuron.server.direct.endpoints import Exposed
from roboneuron.server.tool import CallContext

VERDICT: dict[str, Schema] = {
    "dry_run": {"type": "boolean", "description": "it was only a question; nothing was sent"},
    "allowed": {"type": "boolean"},
    "rule": {"type": "string", "description": "dry run: the rule that would refuse"},
    "reason": {"type": "string", "description": "dry run: why"},
}
"""Properties of every result of what may be refused."""


def verdict_fields(verdict: Verdict) -> dict[str, Any]:
    """The values of `VERDICT`."""
    return {
        "dry_run": verdict.dry_run,
        "allowed": verdict.allowed,
        "rule": verdict.rule,
        "reason": verdict.reason,
    }


def encode_argument(part: MessageInterface, arguments: Mapping[str, Any], name: str) -> Any:
    """The message in argument `name`; raises InvalidInputError with the path inside the arguments."""
    value = take_object(arguments, name, required=bool(part.fields))
    try:
        return part.encode(value, now_ns=time.time_ns())
    except InvalidInputError as error:
        raise inside(error, name) from error


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


def judge_dry_run(access: Access, exposed: Exposed, request: GateRequest) -> Verdict:
    """The answer to a dry run: may it be done now, and if not, by which rule."""
    try:
        access.desk.check_free(exposed)
    except RefusedError as error:
        return Verdict(allowed=False, dry_run=True, reason=str(error), rule="ownership")
    return access.gate.check(request)

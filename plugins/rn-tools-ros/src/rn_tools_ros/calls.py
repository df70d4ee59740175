"""What the handlers of derived tools share: encoding arguments, telling the gate's verdict."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from rn_tools_ros.arguments import Number, Schema, inside, take_object
from rn_tools_ros.interfaces import MessageInterface
from roboneuron.errors import InvalidInputError
from roboneuron.gate import Verdict

SUBSCRIBER_TIMEOUT = Number(text="How long to wait for a subscriber, in seconds.", low=0.0, high=60.0, default=5.0)
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


def duration_s(trajectory: Any) -> float:
    """When the last point of a JointTrajectory is reached, in seconds after it was sent."""
    if not trajectory.points:
        return 0.0
    last = trajectory.points[-1].time_from_start
    return float(last.sec + last.nanosec * 1e-9)

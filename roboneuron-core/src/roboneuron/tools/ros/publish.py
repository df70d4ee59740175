"""Tool publish_<name>: one message to all subscribers, or a lasting value that ends with the stop
message.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from functools import partial

from pydantic import Field

from roboneuron.errors import InvalidInputError, NotReadyError
from roboneuron.server.motion_gate import ExposedEndpoint, GateRequest, MotionGate
from roboneuron.server.rehearsal import Needs, Rehearsal
from roboneuron.server.tool import CallContext, Result
from roboneuron.server.verdict import Sent
from roboneuron.tools.ros.calls import (
    Judged,
    PublishingCall,
    Value,
    verdict_fields,
)
from roboneuron.tools.ros.calls import duration_s as trajectory_s
from roboneuron.tools.ros.exposed_types import message_of
from roboneuron.tools.ros.interfaces import MessageInterface
from roboneuron.tools.ros.steps import MessageStep, publish_steps
from roboneuron.tools.ros.targets import Targets


class ClampedValue(Result):
    """A value that was moved to its limit."""

    path: str
    asked: float
    sent: float


class Delivery(Judged):
    """Sent messages and their number of subscribers; of a simulated call, what would be sent."""

    robot: str
    topic: str
    type: str
    sent: int = Field(description="messages, repetitions and the stop message included")
    subscribers: int = Field(description="number of matched subscribers")
    duration_s: float = Field(description="duration")
    stopped: bool = Field(description="a stop message was sent at the end")
    clamped: list[ClampedValue] = Field(description="values that were moved to their limit")


class Publish(PublishingCall):
    """Arguments of a publish tool."""

    message: Value = Field(default_factory=dict)
    duration_s: float = Field(
        default=1.0,
        gt=0,
        description="Duration [s]; then it is stopped. Joints reach their targets within it.",
    )


class Publishing:
    """The handler of one publish tool. For trajectories it follows `Rehearsable`."""

    rehearsal_needs: Needs = frozenset()

    def __init__(self, gate: MotionGate, targets: Targets, tool: str) -> None:
        self._gate = gate
        self._targets = targets
        is_only = len(targets.endpoints) == 1  # the call names no robot then
        self._endpoints = {
            "" if is_only else exposed.robot: (exposed, message_of(exposed))
            for exposed in targets.endpoints
        }
        self._tool = tool

    async def __call__(self, arguments: Publish, context: CallContext) -> Delivery:
        """Raises InvalidInputError, RefusedError, NotReadyError, StateError, ConfigurationError."""
        exposed, interface = self._endpoints[arguments.robot]
        step = encode_step(
            interface,
            arguments.message,
            arguments.duration_s if self._targets.lasting else 0.0,
        )
        if self._targets.trajectory:
            step.duration_s = trajectory_s(step.message)
            if step.duration_s > self._gate.max_duration_s:
                raise InvalidInputError(
                    f"The trajectory would last {step.duration_s:g} s, allowed is "
                    f"{self._gate.max_duration_s:g} s.",
                    path="message.points",
                )
        request = GateRequest.of(
            context,
            self._tool,
            exposed,
            [step.message],
            arguments.given(),
            joints=self._gate.newest_joints(exposed) if exposed.endpoint.joint_limited else None,
            durations_s=[step.duration_s] if exposed.endpoint.joint_limited else [],
        )
        if not step.duration_s:
            now = self._gate.publish_now(exposed, request, stamped=step.stamped)
            if now is not None:
                return to_delivery(exposed, now)
        halt = threading.Event()
        work = partial(
            publish_steps,
            self._gate,
            exposed,
            request,
            [step],
            timeout_s=arguments.timeout_s,
            halt=halt,
        )
        sent = await context.run(work, on_cancel=halt.set, on_leave=halt.set)
        return to_delivery(exposed, sent, step.duration_s)

    def rehearse(self, arguments: Publish, rehearsal: Rehearsal) -> None:
        """See `Rehearsable`."""
        exposed, interface = self._endpoints[arguments.robot]
        if exposed.namespace != rehearsal.namespace:
            raise NotReadyError("Only trajectories of this server's own arm can be simulated.")
        rehearsal.play([encode_step(interface, arguments.message, 0.0).message])


def encode_step(
    interface: MessageInterface, value: Mapping[str, object], duration_s: float
) -> MessageStep:
    """Encode the message of a call; it is stamped when it is sent if it has a header whose stamp
    the agent omitted. Raises InvalidInputError with the path inside the arguments.
    """
    message = interface.encode(value, now_ns=time.time_ns(), argument="message")
    header = value.get("header")
    has_stamp = isinstance(header, Mapping) and header.get("stamp") is not None
    return MessageStep(
        message=message, duration_s=duration_s, stamped=interface.has_header and not has_stamp
    )


def to_delivery(exposed: ExposedEndpoint, sent: Sent, planned_s: float = 0.0) -> Delivery:
    """Convert the result of the gate; a simulated call is told with its planned duration [s]."""
    duration_s = planned_s if sent.verdict.simulated else sent.duration_s
    return Delivery(
        robot=exposed.robot,
        topic=exposed.topic,
        type=exposed.endpoint.type,
        sent=sent.messages,
        subscribers=sent.subscribers,
        duration_s=round(duration_s, 6),
        stopped=sent.stopped,
        clamped=[
            ClampedValue(path=c.path, asked=c.asked, sent=c.sent) for c in sent.verdict.clamped
        ],
        **verdict_fields(sent.verdict),
    )

"""Truthful delivery: through the gate, to a matched subscriber, step by step, ended by the stop message."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from pydantic import Field

from roboneuron.errors import NotReadyError, RefusedError, RoboNeuronError, StateError
from roboneuron.gate import GateRequest, Verdict
from roboneuron.server.direct.access import Access
from roboneuron.server.direct.arguments import Number
from roboneuron.server.direct.endpoints import Exposed
from roboneuron.server.direct.joint_commands import hold, is_velocity
from roboneuron.server.direct.motion import Motion
from roboneuron.server.direct.request import judge_dry_run, verdict_fields
from roboneuron.server.tool import Answer, Result, Stage

if TYPE_CHECKING:
    from roboneuron.ros.writer import TopicWriter

log = logging.getLogger(__name__)
TIMEOUT = Number(text="How long to wait for a subscriber, in seconds.", low=0.0, high=60.0, default=5.0)
_LATE_S = 0.25
"""After a longer wait for a subscriber the gate is asked again."""


class ClampedValue(Result):
    """A value that was moved to its limit."""

    path: str
    asked: float
    sent: float


class Delivery(Result):
    """What was sent, to how many; or, in a dry run, what would happen."""

    robot: str
    topic: str
    type: str
    sent: int = Field(description="messages, repetitions and the stop message included")
    subscribers: int = Field(description="how many were matched when it was sent")
    duration_s: float = Field(description="how long it took")
    stopped: bool = Field(description="a message that stops was sent at the end")
    clamped: list[ClampedValue] = Field(description="values that were moved to their limit")
    dry_run: bool = Field(description="it was only a question; nothing was sent")
    allowed: bool
    rule: str = Field(description="dry run: the rule that would refuse")
    reason: str = Field(description="dry run: why")


@dataclass(kw_only=True, slots=True)
class Step:
    """A message and how long it lasts [s]; `stamped` when its header is to carry the time of sending."""

    message: Any
    duration_s: float
    stamped: bool


def is_stamp_omitted(exposed: Exposed, value: Mapping[str, Any]) -> bool:
    """Whether the message has a header whose stamp the agent left to us."""
    if not any(field.name == "header" for field in exposed.message.fields):
        return False
    header = value.get("header")
    return not (isinstance(header, Mapping) and header.get("stamp") is not None)


def send_now(access: Access, exposed: Exposed, request: GateRequest) -> Answer | None:
    """Send one message without blocking; None when something has to be waited for, or a way to be judged, first."""
    writer = access.traffic.known_writer(exposed)
    if writer is None or request.dry_run or exposed.endpoint.joint_limited:
        return None
    matched = writer.matched()
    if not matched:
        return None
    started_s = time.monotonic()
    access.desk.check_free(exposed)
    verdict = access.gate.check(request)
    if verdict.may_send:
        writer.publish(request.messages[0])
    return _answer(exposed, verdict, int(verdict.may_send), matched, time.monotonic() - started_s, False)


def carry_out(
    access: Access,
    exposed: Exposed,
    request: GateRequest,
    steps: Sequence[Step],
    timeout_s: float,
    stage: Stage,
    halt: threading.Event,
) -> Answer:
    """Wait for a subscriber, send the steps, end with the stop message; blocks.

    Raises:
        RefusedError: the gate, or somebody else moves the robot; also when the emergency stop ended it.
        NotReadyError: nobody subscribes.
        StateError: cancelled, or a policy took over.
        ConfigurationError: the topic carries another type.
    """
    if exposed.endpoint.joint_limited and request.joints is None:
        request = replace(request, joints=access.traffic.joints(exposed, timeout_s))
    if request.dry_run:
        verdict = judge_dry_run(access, exposed, request)
        return _answer(exposed, verdict, 0, access.traffic.writer(exposed).listening(), 0.0, False)
    lasting = any(step.duration_s for step in steps)
    with access.desk.claim(exposed, request.tool, halt) if lasting else nullcontext() as motion:
        if motion is None:
            access.desk.check_free(exposed)
        verdict = access.gate.check(request)
        writer = access.traffic.writer(exposed)
        if not verdict.may_send:
            return _answer(exposed, verdict, 0, writer.listening(), 0.0, False)
        matched = _connect(access, exposed, writer, request, timeout_s, owned=motion is not None)
        started_s = time.monotonic()
        if motion is None:
            _send(writer, steps[0])
            return _answer(exposed, verdict, 1, matched, time.monotonic() - started_s, False)
        try:
            sent, stopped = _play(access, exposed, writer, steps, motion, stage)
        finally:
            access.gate.release(request)
        return _answer(exposed, verdict, sent, matched, time.monotonic() - started_s, stopped)


def _connect(
    access: Access, exposed: Exposed, writer: TopicWriter, request: GateRequest, timeout_s: float, *, owned: bool
) -> int:
    started_s = time.monotonic()
    needed = exposed.require_subscriber
    matched = writer.connect(timeout_s if needed or writer.listening() else 0.0)
    if needed and not matched:
        raise NotReadyError(
            f"Nobody subscribes to {exposed.topic} ({exposed.endpoint.type}): nothing was sent.",
            hint="Start the robot, or look at list_topics.",
        )
    if time.monotonic() - started_s > _LATE_S:
        if not owned:
            access.desk.check_free(exposed)
        joints = access.traffic.newest_joints(exposed) if exposed.endpoint.joint_limited else None
        access.gate.check(replace(request, repeated=True, joints=joints))
    return matched


def _play(
    access: Access, exposed: Exposed, writer: TopicWriter, steps: Sequence[Step], motion: Motion, stage: Stage
) -> tuple[int, bool]:
    """Send each step, repeat it while it lasts, and end it. Returns messages sent, and whether one ended it."""
    period_s = 1.0 / exposed.endpoint.repeat_hz if exposed.endpoint.repeat_hz else float("inf")
    total_s = sum(step.duration_s for step in steps)
    began_s = due_s = time.monotonic()
    step, sent, failed = steps[0], 0, True
    failure: RoboNeuronError | None = None
    if exposed.endpoint.stop_message:
        motion.stop_now = lambda: writer.publish_if_possible(exposed.stop_message(time.time_ns()))
    try:
        for number, step in enumerate(steps, start=1):
            stage(f"step {number} of {len(steps)}, {due_s - began_s:.1f} of {total_s:.1f} s")
            end_s = due_s + step.duration_s
            while True:
                motion.check()
                if sent and exposed.require_subscriber and not writer.matched():
                    raise NotReadyError(f"The subscriber of {exposed.topic} is gone.", hint="Look at get_status.")
                _send(writer, step)
                sent += 1
                motion.sleep_until(min(end_s, time.monotonic() + period_s))
                if time.monotonic() >= end_s:
                    break
            due_s = end_s
        failed = False
    except (RefusedError, StateError, NotReadyError) as error:
        failure = error
    finally:
        end = _end(access, exposed, writer, step, failed and sent > 0)
    if failure is not None:
        raise _told(failure, time.monotonic() - began_s, total_s, end) from failure
    return sent + int(bool(end)), bool(end)


def _send(writer: TopicWriter, step: Step) -> None:
    if step.stamped:
        stamp = step.message.header.stamp
        stamp.sec, stamp.nanosec = divmod(time.time_ns(), 1_000_000_000)
    writer.publish(step.message)


def _end(access: Access, exposed: Exposed, writer: TopicWriter, step: Step, moving: bool) -> str:
    """Send what ends the motion, and say in words what it was; empty when nothing has to be or can be sent.

    The stop message was checked when the endpoint was exposed; no gate holds it or a hold back. Joints that have come
    to the end of their command need none, unless it was one of velocities.
    """
    message = exposed.stop_message(time.time_ns())
    if message is not None:
        writer.publish(message)
        return "the stop message was sent"
    if not exposed.endpoint.joint_limited or not (moving or is_velocity(step.message)):
        return ""
    message = hold(step.message, access.traffic.newest_joints(exposed))
    if message is None:
        return ""
    writer.publish(message)
    return "the joints were told to hold"


def _told(error: RoboNeuronError, after_s: float, total_s: float, end: str) -> RoboNeuronError:
    """The same kind of error with what became of the motion."""
    cause = error.message.replace(" Nothing was sent.", "")
    ended = end or "nothing could be sent to end it"
    return type(error)(f"Ended after {after_s:.2f} of {total_s:.2f} s, {ended}: {cause}", hint=error.hint)


def _answer(
    exposed: Exposed, verdict: Verdict, sent: int, subscribers: int, duration_s: float, stopped: bool
) -> Answer:
    return Answer(
        structured={
            "robot": exposed.robot,
            "topic": exposed.topic,
            "type": exposed.endpoint.type,
            "sent": sent,
            "subscribers": subscribers,
            "duration_s": round(duration_s, 6),
            "stopped": stopped,
            "clamped": [{"path": c.path, "asked": c.asked, "sent": c.sent} for c in verdict.clamped],
            **verdict_fields(verdict),
        }
    )

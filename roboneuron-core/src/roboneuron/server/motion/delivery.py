"""Truthful delivery: through the gate, to a matched subscriber, command by command, brought to an end."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from roboneuron.errors import NotReadyError, RefusedError, RoboNeuronError, StateError
from roboneuron.gate import GateRequest
from roboneuron.server.motion.access import Access
from roboneuron.server.motion.arbiter import Motion
from roboneuron.server.motion.ending import Ending, MotionEnd, Sent
from roboneuron.server.motion.exposed import ACTION_LABEL, Exposed
from roboneuron.server.motion.joint_commands import hold, is_velocity
from roboneuron.server.tool import Stage

if TYPE_CHECKING:
    from roboneuron.ros.writer import TopicWriter

_LATE_S = 0.25
"""After a longer wait for a subscriber the gate is asked again."""


@dataclass(kw_only=True, slots=True)
class Step:
    """A message and how long it lasts [s]; `stamped` when its header is to carry the time of sending."""

    message: Any
    duration_s: float
    stamped: bool = False


@dataclass(frozen=True, kw_only=True, slots=True)
class Command:
    """What a motion does next.

    Attributes:
        message: what is sent; None when only time passes. One that is not in the gate's request is judged by the
            gate before it is sent.
        due_s: monotonic time of the next command [s].
        stamped: its header is to carry the time of sending.
    """

    message: Any
    due_s: float
    stamped: bool = False


def publish_now(access: Access, exposed: Exposed, request: GateRequest) -> Sent | None:
    """Send one message without blocking; None when something has to be waited for, or a way to be judged, first."""
    writer = access.traffic.known_writer(exposed)
    if writer is None or request.dry_run or exposed.endpoint.joint_limited:
        return None
    matched = writer.matched()
    if not matched:
        return None
    started_s = time.monotonic()
    access.arbiter.check_free(exposed)
    verdict = access.gate.check(request)
    if verdict.may_send:
        writer.publish(request.messages[0])
    return Sent(
        verdict=verdict,
        messages=int(verdict.may_send),
        subscribers=matched,
        duration_s=time.monotonic() - started_s,
    )


def publish(access: Access, exposed: Exposed, request: GateRequest, step: Step, timeout_s: float) -> Sent:
    """Wait for a subscriber and send one message that lasts no time; blocks. Raises as `play`."""
    request = _with_joints(access, exposed, request, timeout_s)
    if request.dry_run:
        return _asked(access, exposed, request)
    access.arbiter.check_free(exposed)
    verdict = access.gate.check(request)
    writer = access.traffic.writer(exposed)
    if not verdict.may_send:
        return Sent(verdict=verdict, subscribers=writer.listening())
    matched = _connect(access, exposed, writer, request, timeout_s, owned=False)
    started_s = time.monotonic()
    _send(writer, step.message, step.stamped)
    return Sent(verdict=verdict, messages=1, subscribers=matched, duration_s=time.monotonic() - started_s)


def play(
    access: Access, exposed: Exposed, request: GateRequest, commands: Iterable[Command], *, total_s: float,
    timeout_s: float, halt: threading.Event, details: Callable[[], str] = lambda: "",
) -> Sent:  # fmt: skip
    """Wait for a subscriber, own the robot's motion, send the commands, bring the motion to its end; blocks.

    Args:
        access: the gate and what lies behind it.
        exposed: through which endpoint.
        request: holds the messages that are known beforehand.
        commands: asked for the next one when it is due; what it raises ends the motion.
        total_s: how long the motion is to last, for messages.
        timeout_s: longest wait for a subscriber.
        halt: set when the call is cancelled.
        details: more to say of a motion that ended early.

    Raises:
        RefusedError: the gate, or somebody else moves the robot; also when the emergency stop ended it.
        NotReadyError: nobody subscribes.
        StateError: cancelled, or a policy took over.
        ConfigurationError: the topic carries another type.
    """
    request = _with_joints(access, exposed, request, timeout_s)
    if request.dry_run:
        return _asked(access, exposed, request)
    with access.arbiter.claim(exposed, request.tool, halt) as motion:
        verdict = access.gate.check(request)
        writer = access.traffic.writer(exposed)
        if not verdict.may_send:
            return Sent(verdict=verdict, subscribers=writer.listening())
        matched = _connect(access, exposed, writer, request, timeout_s, owned=True)
        try:
            end = _run(access, exposed, writer, request, commands, motion, total_s, details)
        finally:
            access.gate.release(request)
        end.check()
        return Sent(
            verdict=verdict,
            messages=end.sent,
            subscribers=matched,
            duration_s=end.after_s,
            stopped=end.ending in (Ending.STOP_MESSAGE, Ending.HOLD),
        )


def commands_of(steps: Sequence[Step], repeat_hz: float, stage: Stage) -> Iterator[Command]:
    """The commands of steps that follow each other, each repeated while it lasts."""
    period_s = 1.0 / repeat_hz if repeat_hz else float("inf")
    total_s = sum(step.duration_s for step in steps)
    began_s = due_s = time.monotonic()
    for number, step in enumerate(steps, start=1):
        stage(f"step {number} of {len(steps)}, {due_s - began_s:.1f} of {total_s:.1f} s")
        end_s = due_s + step.duration_s
        while True:
            yield Command(message=step.message, due_s=min(end_s, time.monotonic() + period_s), stamped=step.stamped)
            if time.monotonic() >= end_s:
                break
        due_s = end_s


def _run(
    access: Access, exposed: Exposed, writer: TopicWriter, request: GateRequest, commands: Iterable[Command],
    motion: Motion, total_s: float, details: Callable[[], str],
) -> MotionEnd:  # fmt: skip
    """Send each command when it is due, and end the motion, whatever happens."""
    judged = {id(message) for message in request.messages}
    began_s = time.monotonic()
    last: Any = None
    sent, failed, ending = 0, True, Ending.NONE
    cause: RoboNeuronError | None = None
    if exposed.endpoint.stop_message:
        motion.stop_now = lambda: writer.publish_if_possible(exposed.stop_message(time.time_ns()))
    try:
        for command in commands:
            motion.check()
            if command.message is not None:
                if sent and exposed.require_subscriber and not writer.matched():
                    raise NotReadyError(f"The subscriber of {exposed.topic} is gone.", hint="Look at get_status.")
                if id(command.message) not in judged:
                    access.gate.check_next(replace(request, messages=(command.message,)))
                _send(writer, command.message, command.stamped)
                last, sent = command.message, sent + 1
            motion.sleep_until(command.due_s)
        failed = False
    except (RefusedError, StateError, NotReadyError) as error:
        cause = error
    finally:
        after_s = time.monotonic() - began_s
        if last is not None:
            ending = _end(access, exposed, writer, last, failed)
    if cause is not None and not sent:
        raise cause
    return MotionEnd(
        after_s=after_s,
        total_s=total_s,
        ending=ending,
        details=details() if cause is not None else "",
        cause=cause,
        sent=sent + int(ending in (Ending.STOP_MESSAGE, Ending.HOLD)),
    )


def _end(access: Access, exposed: Exposed, writer: TopicWriter, last: Any, moving: bool) -> Ending:
    """Send what ends the motion, where something has to be and can be sent.

    The stop message was checked when the endpoint was exposed; no gate holds it or a hold back. Joints that have come
    to the end of their command need none, unless it was one of velocities. Control holds the arm once actions stop.
    """
    message = exposed.stop_message(time.time_ns())
    if message is not None:
        writer.publish(message)
        return Ending.STOP_MESSAGE
    if exposed.hidden and exposed.label == ACTION_LABEL:
        return Ending.CONTROL
    if not exposed.endpoint.joint_limited or not (moving or is_velocity(last)):
        return Ending.NONE
    message = hold(last, access.traffic.newest_joints(exposed))
    if message is None:
        return Ending.NONE
    writer.publish(message)
    return Ending.HOLD


def _with_joints(access: Access, exposed: Exposed, request: GateRequest, timeout_s: float) -> GateRequest:
    if exposed.endpoint.joint_limited and request.joints is None:
        return replace(request, joints=access.traffic.joints(exposed, timeout_s))
    return request


def _asked(access: Access, exposed: Exposed, request: GateRequest) -> Sent:
    verdict = access.ask(exposed, request)
    return Sent(verdict=verdict, subscribers=access.traffic.writer(exposed).listening())


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
            access.arbiter.check_free(exposed)
        joints = access.traffic.newest_joints(exposed) if exposed.endpoint.joint_limited else None
        access.gate.check(replace(request, repeated=True, joints=joints))
    return matched


def _send(writer: TopicWriter, message: Any, stamped: bool) -> None:
    if stamped:
        stamp = message.header.stamp
        stamp.sec, stamp.nanosec = divmod(time.time_ns(), 1_000_000_000)
    writer.publish(message)

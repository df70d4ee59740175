"""Sending of consecutive messages with durations."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from roboneuron.server.motion_gate import ExposedEndpoint, GateRequest, MotionGate, TimedCommand
from roboneuron.server.verdict import Sent
from roboneuron.supervisor.changes import Stage


@dataclass(kw_only=True, slots=True)
class MessageStep:
    """A message and its duration [s]; if `stamped`, its header gets the time of sending."""

    message: object
    duration_s: float
    stamped: bool = False


def publish_steps(
    gate: MotionGate,
    exposed: ExposedEndpoint,
    request: GateRequest,
    steps: Sequence[MessageStep],
    stage: Stage,
    *,
    timeout_s: float,
    halt: threading.Event,
) -> Sent:
    """Send one message, or consecutive steps with durations; blocks.

    Args:
        gate: sends the messages.
        exposed: the endpoint.
        request: contains the messages of the steps.
        steps: at least one.
        stage: called with the progress.
        timeout_s: longest wait for a subscriber.
        halt: set when the call is cancelled.

    Raises:
        RefusedError, NotReadyError, StateError, ConfigurationError: as `MotionGate.play`.
    """
    total_s = sum(step.duration_s for step in steps)
    if not total_s:
        return gate.publish(exposed, request, timeout_s=timeout_s, stamped=steps[0].stamped)
    commands = commands_of(steps, exposed.endpoint.repeat_hz, stage)
    return gate.play(exposed, request, commands, total_s=total_s, timeout_s=timeout_s, halt=halt)


def commands_of(
    steps: Sequence[MessageStep], repeat_hz: float, stage: Stage
) -> Iterator[TimedCommand]:
    """Yield the commands of consecutive steps, each repeated during its duration."""
    period_s = 1.0 / repeat_hz if repeat_hz else float("inf")
    total_s = sum(step.duration_s for step in steps)
    began_s = due_s = time.monotonic()
    for number, step in enumerate(steps, start=1):
        stage(f"step {number} of {len(steps)}, {due_s - began_s:.1f} of {total_s:.1f} s")
        end_s = due_s + step.duration_s
        while True:
            yield TimedCommand(
                message=step.message,
                due_s=min(end_s, time.monotonic() + period_s),
                stamped=step.stamped,
            )
            if time.monotonic() >= end_s:
                break
        due_s = end_s

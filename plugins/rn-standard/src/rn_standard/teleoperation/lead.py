"""A running lead: a teleoperator, its session and the gate, on a background thread."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from rn_standard.teleoperation.rows import Acting, LeadRow
from rn_standard.teleoperation.samples import LeadFeedback, Teleoperator, ToldTeleoperator
from rn_standard.teleoperation.session import LeadSession
from roboneuron import CallContext, InvalidInputError, NotReadyError, RoboNeuronError
from roboneuron.feature import ExposedEndpoint, GateRequest, MotionGate, TimedCommand

if TYPE_CHECKING:
    from std_msgs.msg import Float64MultiArray

log = logging.getLogger(__name__)
_SUBSCRIBER_S = 2.0
_BEGIN_S = 3.0
"""Longest wait for control's first answer."""
_END_S = 2.0
_BRAKE_S = 0.2


class Lead:
    """Lead of one arm by one person, from `begin` until `hand_back` or a fault. Usable from any
    thread.

    Attributes:
        session: see `LeadSession`; used on the thread of the lead.
        who: the leading client.
        source_name: name of its teleoperator.
        acting: control's newest answer; None before the first.
        reason: reason of its end; empty while it runs, and after a hand-back.
    """

    def __init__(
        self,
        session: LeadSession,
        source: Teleoperator,
        source_name: str,
        gate: MotionGate,
        exposed: ExposedEndpoint,
        context: CallContext,
        may_lead: Callable[[], object],
        on_end: Callable[[Lead], object],
        halt: threading.Event,
    ) -> None:
        """Args:
        session: session of this lead.
        source: the open teleoperator.
        source_name: its name.
        gate: checks every row.
        exposed: the hidden endpoint of leads.
        context: context of the call that began it.
        may_lead: raises RefusedError if its client may no longer act because another one operates
            the robot.
        on_end: called after its end.
        halt: ends it when set, as when the call that began it is cancelled.
        """
        self.session, self.who, self.source_name = session, context.who, source_name
        self.acting: Acting | None = None
        self.reason = ""
        self._source, self._gate, self._exposed = source, gate, exposed
        self._may_lead, self._on_end = may_lead, on_end
        self._answered = threading.Event()
        self._ended = threading.Event()
        self._halt = halt
        self._wants_back = threading.Event()
        self._hears_back = threading.Event()
        first = session.row(time.monotonic(), {}).to_message()
        arguments = {"source": source_name, "mode": session.mode}
        self._request = GateRequest.of(context, "lead_arm", exposed, [first], arguments)
        self._thread = threading.Thread(target=self._run, name="lead", daemon=True)

    @property
    def is_running(self) -> bool:
        """True until its end."""
        return not self._ended.is_set()

    def begin(self) -> None:
        """Start the lead; returns once control has answered.

        Raises:
            RoboNeuronError: the reason if it ends at once.
            NotReadyError: control does not answer.
        """
        self._thread.start()
        deadline_s = time.monotonic() + _BEGIN_S + _SUBSCRIBER_S
        while not self._answered.wait(0.02):
            if self._ended.is_set():
                raise NotReadyError(f"The lead has not begun: {self.reason}")
            if time.monotonic() > deadline_s:
                self.hand_back()
                raise NotReadyError("Control has not answered the lead.", hint="See get_status.")

    def hand_back(self) -> None:
        """End the lead regularly; returns once control lets the policy act again, or the lead is
        over.
        """
        self._wants_back.set()
        self._ended.wait(_END_S)
        self._halt.set()

    def end(self) -> None:
        """End the lead now; control accepts nothing before a new start."""
        self._halt.set()
        self._thread.join(_END_S)

    def note(self, acting: Acting) -> None:
        """Process an answer of control; on the thread of the ROS node."""
        if acting.session != self.session.name:
            if self._wants_back.is_set() and not acting.session:
                self._hears_back.set()
            return
        now_s = time.monotonic()
        self.acting = acting
        self._answered.set()
        found = self.session.sample_of(acting.number)
        if found is None or not isinstance(self._source, ToldTeleoperator):
            return
        number, at_s = found
        feedback = LeadFeedback(
            number=number,
            who=acting.who,
            limits=acting.limits,
            note=acting.note or self.session.why_still,
            delay_s=now_s - at_s,
        )
        self._source.tell(feedback)

    def _run(self) -> None:
        try:
            self._gate.play(
                self._exposed,
                self._request,
                self._commands(),
                total_s=0.0,
                timeout_s=_SUBSCRIBER_S,
                halt=self._halt,
            )
        except RoboNeuronError as error:
            cause = error.__cause__ if isinstance(error.__cause__, RoboNeuronError) else error
            self.reason = str(cause)
        # the border to a plugin's own code: the arm stops when its rows cease
        except Exception as error:
            log.exception("The teleoperator %s failed.", self.source_name)
            self.reason = f"The teleoperator {self.source_name} failed: {error}"
        finally:
            self._close()

    def _close(self) -> None:
        try:
            self._source.close()
        except Exception:  # the border to a plugin's own code
            log.exception("The teleoperator %s could not be closed.", self.source_name)
        self._ended.set()
        with suppress(RoboNeuronError):
            self._on_end(self)
        if isinstance(self._source, ToldTeleoperator):
            self._source.ended(self.reason)

    def _commands(self) -> Iterator[TimedCommand]:
        """Yield one row for each period, as soon as its sample has arrived; the last one contains
        the kind of the end.

        Raises:
            RoboNeuronError: the reason of the end.
        """
        period_s = 1.0 / self.session.rate_hz
        yield _command(self._request.messages[0])
        due_s = time.monotonic() + period_s
        while not self._wants_back.is_set():
            try:
                row = self._next_row(due_s)
            except RoboNeuronError:
                yield _command(self.session.end_row("lost").to_message())
                raise
            due_s = max(due_s, time.monotonic()) + period_s
            yield _command(row.to_message())
        # the arm is braked within its limits, before the policy moves it
        for _ in range(round(_BRAKE_S / period_s) if self.session.mode == "person" else 0):
            yield TimedCommand(
                message=self.session.still_row().to_message(), due_s=time.monotonic() + period_s
            )
        yield _command(self.session.end_row("back").to_message())
        deadline_s = time.monotonic() + _END_S / 2
        while not self._hears_back.is_set() and time.monotonic() < deadline_s:
            self._hears_back.wait(0.01)
            yield TimedCommand(message=None, due_s=time.monotonic())

    def _next_row(self, due_s: float) -> LeadRow:
        """Row of the newest sample, or a row without one if none has arrived by `due_s`."""
        self._may_lead()
        left_s = max(0.0, due_s - time.monotonic())
        sample = self._source.read(left_s)
        if sample is not None:
            self.session.take(sample, time.monotonic())
        left_s = due_s - time.monotonic() - 0.5 / self.session.rate_hz
        if left_s > 0:  # a device that is faster than the lead: the newest sample is used
            time.sleep(left_s)
        joints = self._gate.newest_joints(self._exposed)
        measured = (
            {}
            if joints is None
            else dict(zip(joints.names, np.asarray(joints.position).tolist(), strict=False))
        )
        return self.session.row(time.monotonic(), measured)


def _command(message: Float64MultiArray) -> TimedCommand:
    return TimedCommand(message=message, due_s=time.monotonic())


def lead_endpoint(exposed: tuple[ExposedEndpoint, ...], robot: str) -> ExposedEndpoint:
    """Return the hidden endpoint of a lead. Raises InvalidInputError for a robot without an arm."""
    for one in exposed:
        if one.control_input == "lead" and one.robot == robot:
            return replace(one)
    raise InvalidInputError(f"The robot {robot!r} has no arm that could be led.")

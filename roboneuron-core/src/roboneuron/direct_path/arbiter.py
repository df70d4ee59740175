"""Lasting motions of calls: each holds the claim on its robot (`MotionClaims`), begins once control
holds the arm, and is ended by a stop or a cancelled call.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

from roboneuron.direct_path.gate import Gate
from roboneuron.errors import NotReadyError, StateError
from roboneuron.estop.motion_claims import Claim
from roboneuron.estop.motion_starts import MotionStarts
from roboneuron.server.motion_gate import ExposedEndpoint

FROZEN_S = 2.0
"""Silence of the server after which modules hold the robot by default, and its own motions end; a
motion is checked every 10 ms.
"""
GO_ON = "Nothing resumes by itself: call it again with what is left of it."
"""Hint of a motion that was ended from outside."""
POLL_S = 0.01
"""Period at which a lasting motion checks the latch; with one publish it is well within 50 ms."""


class ActiveMotion(Claim):
    """A motion in progress; used by the thread that plays it.

    Attributes:
        exposed: endpoint of the motion.
        watch: raises RefusedError if measurements require the end of the motion.
    """

    def __init__(
        self,
        gate: Gate,
        exposed: ExposedEndpoint,
        what: str,
        halt: threading.Event,
        ended: Callable[[], str] = lambda: "",
        frozen_s: float = FROZEN_S,
    ) -> None:
        """Args:
        gate: checks whether motion may continue.
        exposed: endpoint of the motion.
        what: the tool, for messages.
        halt: set when the motion has to end.
        ended: why the motion has to end because of others; empty if it has not.
        frozen_s: it ends when this process was frozen for longer [s].
        """
        super().__init__(
            robot=exposed.robot,
            what=what,
            halt=halt,
            topic="" if exposed.moves else exposed.topic,
            is_lead=exposed.control_input == "lead",
        )
        self.exposed = exposed
        self.watch: Callable[[], object] = lambda: None
        self._gate = gate
        self._ended, self._frozen_s = ended, frozen_s
        self._checked_s = time.monotonic()

    def check(self) -> None:
        """Raise if the motion has to end.

        Raises:
            RefusedError: the emergency stop is latched, the audit failed, or as `watch`.
            StateError: the call was cancelled, a policy took over, the robot was stopped or has
                lost a module since this motion began, or this process was frozen: the motion is not
                resumed.
        """
        self._gate.check_running()
        frozen_s, self._checked_s = time.monotonic() - self._checked_s, time.monotonic()
        if frozen_s > self._frozen_s:
            raise StateError(
                f"The server was frozen for {frozen_s:.1f} s; the motion is not resumed."
            )
        if self.halt.is_set():
            self._gate.check_running()  # the stop was triggered since the check above
            raise StateError(self.end_reason or "The call was cancelled.", hint=GO_ON)
        if reason := self._ended():
            raise StateError(reason, hint=GO_ON)
        self.watch()

    def sleep_until(self, end_s: float) -> None:
        """Wait until this monotonic time [s]; raises as `check`, within `POLL_S` of the cause."""
        while True:
            self.check()
            remaining_s = end_s - time.monotonic()
            if remaining_s <= 0:
                return
            self.halt.wait(min(POLL_S, remaining_s))


class MotionArbiter:
    """Lasting motions through the gate, each with its robot's claim. Usable from any thread."""

    def __init__(
        self,
        gate: Gate,
        starts: MotionStarts,
        is_followed: Callable[[ExposedEndpoint], bool] = lambda exposed: False,
        hold_s: float = 2.0,
        frozen_s: float = FROZEN_S,
    ) -> None:
        """Args:
        gate: checks whether motion may continue.
        starts: the stops, and the claims.
        is_followed: returns True if control still follows actions: it will hold, and the hold would
            end another motion.
        hold_s: longest wait for that hold.
        frozen_s: a motion ends when this process was frozen for longer [s].
        """
        self._is_followed, self._hold_s, self._frozen_s = is_followed, hold_s, frozen_s
        self._gate = gate
        self.starts, self.claims = starts, starts.claims

    def check_free(self, exposed: ExposedEndpoint) -> None:
        """Raise RefusedError while a policy or another call moves the robot; endpoints that move
        nothing are free.
        """
        if not exposed.moves:
            return
        reason = self.claims.still_reason(
            exposed.robot, exposed.namespace, is_lead=exposed.control_input == "lead"
        )
        if reason is not None:
            # this reason first: without the other motion nothing moved either
            self._gate.latch.check(" Nothing was sent.")
            raise reason.refusal()

    def stops_until_now(self, exposed: ExposedEndpoint) -> int:
        """Number of stops before a request, which end nothing that it asks for; see
        `MotionStarts.permit`.
        """
        if exposed.moves:
            self.starts.look()
        return self.starts.arm_stops

    @contextmanager
    def claim(
        self, exposed: ExposedEndpoint, what: str, halt: threading.Event
    ) -> Iterator[ActiveMotion]:
        """Claim exclusive use of the robot's motion.

        Args:
            exposed: endpoint of the motion.
            what: the tool, for messages.
            halt: set when the call is cancelled.

        Raises:
            RefusedError: another client or call moves it.
            NotReadyError: control follows actions and does not reach its hold.
            StateError: as `ActiveMotion.check`.
        """
        stops = self.stops_until_now(exposed)

        def ended() -> str:
            if not exposed.moves:
                return ""
            if self.starts.arm_stops != stops:
                return f"It was stopped: {self.starts.reason}. The motion is not resumed."
            if motion.is_lead:  # control lets one of them act
                return ""
            return self.claims.policy(exposed.robot, exposed.namespace)

        motion = ActiveMotion(self._gate, exposed, what, halt, ended, self._frozen_s)
        with self.claims.hold(motion, partial(self.check_free, exposed)):
            if exposed.moves and not exposed.control_input:
                self._await_hold(motion)
            yield motion

    def _await_hold(self, motion: ActiveMotion) -> None:
        """Wait for the hold that follows the last action of a policy or of move_ee."""
        deadline_s = time.monotonic() + self._hold_s
        while self._is_followed(motion.exposed):
            if time.monotonic() > deadline_s:
                raise NotReadyError(
                    "Control still receives actions from another sender; nothing was sent.",
                    hint="Call stop_motion, or see get_status.",
                )
            motion.sleep_until(time.monotonic() + POLL_S)

    def end_all(
        self,
        reason: str,
        timeout_s: float,
        which: Callable[[ExposedEndpoint], bool] = lambda exposed: True,
    ) -> bool:
        """End every motion (through the selected endpoints) and wait; return False if one did not
        end in time.
        """

        def is_meant(claim: Claim) -> bool:
            return isinstance(claim, ActiveMotion) and which(claim.exposed)

        return self.claims.end_all(reason, timeout_s, is_meant)

"""Ownership of each robot: one lasting motion of a call, or a policy with an instruction.

The later request is refused. A motion is ended by a stop or a cancelled call. A policy without an
instruction sends nothing and owns nothing.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from functools import partial

from roboneuron.direct_path.exposed import ACTION_LABELS, LEAD_LABEL
from roboneuron.direct_path.gate import Gate
from roboneuron.errors import NotReadyError, RefusedError, RoboNeuronError, StateError
from roboneuron.gate import StillReason
from roboneuron.server.loop import ClosedLoop
from roboneuron.server.motion_gate import ExposedEndpoint

FROZEN_S = 2.0
"""Silence of the server after which modules hold the robot by default, and its own motions end; a
motion is checked every 10 ms.
"""
FREE = "Wait for its end, or call stop_motion: it ends whatever moves."
"""Hint of a request that is refused because something else moves the robot."""
GO_ON = "Nothing resumes by itself: call it again with what is left of it."
"""Hint of a motion that was ended from outside."""
POLL_S = 0.01
"""Period at which a lasting motion checks the latch; with one publish it is well within 50 ms."""


class Ending(StrEnum):
    """Cause of a motion's end; the values are words of messages."""

    NONE = "nothing could be sent to end it"
    STOP_MESSAGE = "the stop message was sent"
    HOLD = "the joints were told to hold"
    CONTROL = "control holds the arm"
    GOAL_ENDED = "the goal was ended"
    GOAL_UNCONFIRMED = "the goal was asked to end, but did not confirm"


@dataclass(frozen=True, kw_only=True, slots=True)
class MotionEnd:
    """End of a motion.

    Attributes:
        after_s: its duration [s].
        total_s: its planned duration [s]; None if unknown.
        ending: cause of the end.
        details: additional text, such as the position of the arm.
        cause: error that ended it early; None if it was completed.
        sent: number of messages, the one that ended it included.
    """

    after_s: float
    total_s: float | None = None
    ending: Ending = Ending.NONE
    details: str = ""
    cause: RoboNeuronError | None = None
    sent: int = 0

    def check(self) -> None:
        """Raise an error of the cause's kind that describes the end, unless the motion was
        completed.
        """
        if self.cause is None:
            return
        total = "" if self.total_s is None else f" s of the planned {self.total_s:.2f}"
        details = f" ({self.details})" if self.details else ""
        raise type(self.cause)(
            f"Ended early, after {self.after_s:.2f}{total} s; {self.ending}{details}: "
            f"{self.cause.message}",
            hint=self.cause.hint,
        ) from self.cause


def _taken(message: str) -> StillReason:
    """Why a request is refused while something else moves the robot."""
    return StillReason(rank="claim", rule="ownership", message=message, hint=FREE)


class ActiveMotion:
    """A motion in progress; used by the thread that plays it."""

    def __init__(
        self,
        gate: Gate,
        exposed: ExposedEndpoint,
        what: str,
        halt: threading.Event,
        policy: Callable[[], str],
        stopped: Callable[[], str] = lambda: "",
        frozen_s: float = FROZEN_S,
    ) -> None:
        self._stopped, self._frozen_s = stopped, frozen_s
        self._looked_s = self.began_s = time.monotonic()
        self.exposed = exposed
        self.what = what
        self._gate = gate
        self._halt = halt
        self._policy = policy
        self._end_reason = ""
        self.stop_now: Callable[[], object] = lambda: None
        """Send the stop message; set while there is one to send. The emergency stop calls it on the
        triggering thread, independent of the thread that plays the motion, which sends it again
        when it runs.
        """
        self.watch: Callable[[], object] = lambda: None
        """Raises RefusedError if measurements require the end of the motion."""

    @property
    def claim(self) -> str:
        """What moves the robot, as a sentence."""
        return f"{self.what} moves {self.exposed.robot!r} now."

    def check(self) -> None:
        """Raise if the motion has to end.

        Raises:
            RefusedError: the emergency stop is latched, the audit failed, or as `watch`.
            StateError: the call was cancelled, a policy took over, the robot was stopped or has
                lost a module since this motion began, or this process was frozen: the motion is not
                resumed.
        """
        self._gate.check_running()
        frozen_s, self._looked_s = time.monotonic() - self._looked_s, time.monotonic()
        if frozen_s > self._frozen_s:
            raise StateError(
                f"The server was frozen for {frozen_s:.1f} s; the motion is not resumed."
            )
        if self._halt.is_set():
            self._gate.check_running()  # the stop was triggered since the check above
            raise StateError(self._end_reason or "The call was cancelled.", hint=GO_ON)
        if reason := self._stopped() or self._policy():
            raise StateError(reason, hint=GO_ON)
        self.watch()

    def sleep_until(self, end_s: float) -> None:
        """Wait until this monotonic time [s]; raises as `check`, within `POLL_S` of the cause."""
        while True:
            self.check()
            remaining_s = end_s - time.monotonic()
            if remaining_s <= 0:
                return
            self._halt.wait(min(POLL_S, remaining_s))

    def wake(self) -> None:
        """Make the playing thread check at once if the motion has to end."""
        self._halt.set()

    def end(self, reason: str) -> None:
        """End the motion now; callable from any thread."""
        self._end_reason = reason
        self._halt.set()


class MotionArbiter:
    """Exclusive use of each robot by one motion. Usable from any thread."""

    def __init__(
        self,
        gate: Gate,
        policy: Callable[[ExposedEndpoint], str],
        loop: ClosedLoop,
        is_followed: Callable[[ExposedEndpoint], bool] = lambda exposed: False,
        hold_s: float = 2.0,
        frozen_s: float = FROZEN_S,
    ) -> None:
        """Args:
        gate: checks whether motion may continue.
        policy: returns a sentence on the policy that moves the endpoint's robot; empty without one,
            and for one that has no instruction.
        loop: its `starts` record the stops and the policy's instruction.
        is_followed: returns True if control still follows actions: it will hold, and the hold would
            end another motion.
        hold_s: longest wait for that hold.
        frozen_s: a motion ends when this process was frozen for longer [s].
        """
        self._is_followed, self._hold_s, self._frozen_s = is_followed, hold_s, frozen_s
        self._gate = gate
        self._policy = policy
        self.starts = loop.starts
        self._lock = threading.Lock()
        self._moving: dict[str, ActiveMotion] = {}
        self._idle = threading.Condition(self._lock)
        loop.starts.admission = self.admit_policy
        gate.latch.on_press.append(self._stop_now)
        gate.latch.on_pressed.append(self._wake)

    def _stop_now(self) -> None:
        """Send the end of each motion, because the stop was triggered in this process."""
        # one step of the interpreter: no lock that another thread could hold
        for motion in list(self._moving.values()):
            motion.stop_now()

    def _wake(self) -> None:
        """Wake all motions, which need not wait for their next check of the latch."""
        for motion in list(self._moving.values()):
            motion.wake()

    @property
    def is_moving(self) -> bool:
        """True if a call moves a robot now."""
        return bool(self.motions)

    @property
    def motions(self) -> tuple[str, ...]:
        """The calls that move a robot now, a phrase each."""
        now_s = time.monotonic()
        return tuple(
            f"{motion.what} of {motion.exposed.robot!r} (for {now_s - motion.began_s:.1f} s)"
            for motion in list(self._moving.values())
            if motion.exposed.moves
        )

    def check_free(self, exposed: ExposedEndpoint) -> None:
        """Raise RefusedError while a policy or another call moves the robot; endpoints that move
        nothing are free.
        """
        if not exposed.moves:
            return
        reason = self.still_reason(exposed)
        if reason is not None:
            # this reason first: without the other motion nothing moved either
            self._gate.latch.check(" Nothing was sent.")
            raise reason.refusal()

    def still_reason(self, exposed: ExposedEndpoint) -> StillReason | None:
        """What else moves the endpoint's robot now, a policy or a call; None if it is free."""
        if policy := self._policy(exposed):
            return _taken(policy)
        other = self._moving.get(exposed.robot)
        return None if other is None else _taken(other.claim)

    @contextmanager
    def admit_policy(self, instruction: str) -> Iterator[None]:
        """Let a policy of this server begin an instruction; nothing else can claim the robot within
        the block. A person may lead it: then control lets one of them act.

        Raises:
            RefusedError: a call moves the robot, which goes on; the later request is refused.
        """
        with self._lock:
            for motion in self._moving.values() if instruction else ():
                if motion.exposed.moves and motion.exposed.label != LEAD_LABEL:
                    raise _taken(motion.claim).refusal()
            yield

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

        def stopped() -> str:
            if not exposed.moves or self.starts.arm_stops == stops:
                return ""
            return f"It was stopped: {self.starts.reason}. The motion is not resumed."

        policy = partial(self._policy, exposed) if exposed.moves else str
        motion = ActiveMotion(self._gate, exposed, what, halt, policy, stopped, self._frozen_s)
        key = exposed.robot if exposed.moves else f"{exposed.robot}/{exposed.topic}"
        with self._lock:
            self.check_free(exposed)
            if key in self._moving:
                raise RefusedError(
                    f"{self._moving[key].what} uses {exposed.topic} now.",
                    hint="Wait for its end.",
                    rule="ownership",
                )
            self._moving[key] = motion
        try:
            if exposed.moves and exposed.label not in (*ACTION_LABELS, LEAD_LABEL):
                self._await_hold(motion)
            yield motion
        finally:
            with self._idle:
                del self._moving[key]
                self._idle.notify_all()

    def watch(self, exposed: ExposedEndpoint, check: Callable[[], object]) -> None:
        """Add a check for the end of the motion of an endpoint's robot.

        Args:
            exposed: endpoint that has claimed the robot.
            check: raises RefusedError; called every 10 ms on the thread that plays the motion.
        """
        self._moving[exposed.robot].watch = check

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
        with self._idle:
            ended = [motion for motion in self._moving.values() if which(motion.exposed)]
            for motion in ended:
                motion.end(reason)
            return self._idle.wait_for(
                lambda: not any(m in ended for m in self._moving.values()), timeout_s
            )

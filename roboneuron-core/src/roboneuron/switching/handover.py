"""Handover between two modules of one kind at a moment on the time axis of their inputs.

Both modules are active on the same topics. Inputs stamped before the moment belong to the old
module, later ones to the new module. So no input is used twice or lost, even if the messages about
the handover are late. Before the handover, the new module works in shadow: it processes live inputs
and publishes nothing. Inference compares the capture time of images, perception the capture time of
its own images, control the times at which actions were sent and joints measured.

A moment is compared in ROS time only as long as messages from before it may still arrive.
Afterwards it counts as past by the monotonic clock: otherwise a clock that is set back would put a
module into shadow again.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from roboneuron.contract import ActionChunk, Hold, JointCommand, Pose
from roboneuron.modules.status import StatusWriter
from roboneuron.modules.step_filters import StepFilter
from roboneuron.switching.shadow_controller import ControllerComparison
from roboneuron.switching.standby import ACT_FROM, ACT_UNTIL, NEVER_NS, PLAY_FROM, PLAY_UNTIL

_SETTLE_S = 5.0
"""Time after which a moment is finally past: every earlier input has arrived or is too old."""
_PREDECESSOR_S, _PREDECESSOR_PERIODS = 0.1, 1.5
"""Until the handover the predecessor plays its rows; without a message for this time (in seconds or
periods), it has none left.
"""
_FARTHEST_S = 10.0
"""A moment farther ahead was computed before the clock was set."""


class TimedHandover(StepFilter):
    """The three moments of a handover; read by the module's threads, set by the executor's.

    Args:
        shadow: in shadow until the handover is set.
        status: receives the reports.
        now_ns: ROS time [ns].
        now_s: monotonic time [s].

    Attributes:
        moments: the node's parameters and their first values.
        not_before_ns: no predictions on images captured before it, not even in shadow.
        period_s: returns the period of a backend's rows [s]; 0 before the first one.
    """

    phase = StepFilter.StepPhase.HANDOVER

    def __init__(
        self,
        shadow: bool,
        status: StatusWriter,
        now_ns: Callable[[], int] = time.time_ns,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self.status = status
        self.moments = {
            ACT_FROM: NEVER_NS if shadow else 0,
            ACT_UNTIL: 0,
            PLAY_UNTIL: 0,
            PLAY_FROM: 0,
        }
        self.not_before_ns = 0
        self._now_ns = now_ns
        self._now_s = now_s
        self._moments_ns = dict(self.moments)
        self._past_s = dict.fromkeys(self.moments, math.inf)
        self.period_s: Callable[[], float] = lambda: 0.0
        self._heard_s = -math.inf
        self._sent: set[str] = set()
        self._count = 0
        self._begun_s = self._took_s = 0.0
        self._comparison = ControllerComparison(status)

    def set(self, name: str, moment_ns: int) -> None:
        """Set one of `moments` [ROS time, ns]; 0 or more."""
        ahead_s = min(max(0.0, (moment_ns - self._now_ns()) / 1e9), _FARTHEST_S)
        is_moment = moment_ns not in (0, NEVER_NS)
        self._past_s[name] = self._now_s() + ahead_s + _SETTLE_S if is_moment else math.inf
        self._moments_ns[name] = moment_ns

    def admits(self, stamp_ns: int) -> bool:
        """See `StepFilter.admits`: the input does not belong to the successor yet."""
        return not self._has_come(ACT_UNTIL, stamp_ns)

    def sends(self, stamp_ns: int) -> bool:
        """See `StepFilter.sends`: the input does not belong to the predecessor any more, which is
        called shadow.
        """
        return stamp_ns >= self._moments_ns[ACT_FROM] or self._now_s() >= self._past_s[ACT_FROM]

    def may_play(self, now_ns: int) -> bool:
        """See `StepFilter.may_play`: the predecessor has finished."""
        from_ns = self._moments_ns[PLAY_FROM]
        now_s = self._now_s()
        silent_s = max(_PREDECESSOR_S, _PREDECESSOR_PERIODS * self.period_s())
        return (
            now_ns >= from_ns
            or now_s >= self._past_s[PLAY_FROM]
            or now_s - self._heard_s >= silent_s
        )

    def ends_rows(self, now_ns: int) -> bool:
        """See `StepFilter.ends_rows`: the successor replaces them."""
        return self._has_come(PLAY_UNTIL, now_ns)

    def rest(self) -> None:
        """Called before each prediction: skips one in shadow that would still run at the moment of
        the handover.

        So the successor is free for the first image after the moment, and its first action is not
        late. Images captured before are ignored from now on.
        """
        now_s, moment_ns = self._now_s(), self._moments_ns[ACT_FROM]
        ahead_s = (moment_ns - self._now_ns()) / 1e9
        if moment_ns != self.not_before_ns or now_s >= self._past_s[ACT_FROM]:
            self.not_before_ns = 0
        if 0.0 < ahead_s < self._took_s:
            self.not_before_ns = moment_ns
            time.sleep(ahead_s)
            now_s += ahead_s
        self._begun_s = now_s

    def withhold(self, output: ActionChunk | JointCommand | Hold | Pose) -> None:
        """See `StepFilter.withhold`; the outputs are compared in the status."""
        if isinstance(output, ActionChunk):
            self._took_s = self._now_s() - self._begun_s
            for name, value in zip(output.space.keys, output.actions[0].tolist(), strict=True):
                self.status.set_value(f"shadow_action.{name}", value)
            self._count += 1
            self.status.set_value("shadow_count", self._count)
        else:
            self._comparison.answer(output)

    def hear(self, output: JointCommand | Pose, sent_s: float) -> None:
        """Record an output of the predecessor and its time [monotonic s]; called in shadow."""
        self._comparison.hear(output, sent_s)

    def hear_action(self) -> None:
        """Record that the predecessor has sent an action."""
        self._heard_s = self._now_s()

    def has_sent(self, what: str) -> bool:
        """True if an output of that name was sent."""
        return what in self._sent

    def note_sent(self, what: str) -> None:
        """Report the times of the first and newest output of a kind, by which a handover is
        confirmed and measured.
        """
        now_ns = time.time_ns()
        self.status.set_value(f"last_sent_ns.{what}", now_ns)
        if what not in self._sent:
            self._sent.add(what)
            self.status.set_value(f"first_sent_ns.{what}", now_ns)
            self.status.changed.set()

    def _has_come(self, name: str, stamp_ns: int) -> bool:
        until_ns = self._moments_ns[name]
        return until_ns != 0 and (stamp_ns >= until_ns or self._now_s() >= self._past_s[name])

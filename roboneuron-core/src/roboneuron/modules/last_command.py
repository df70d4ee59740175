"""The newest command of a robot: when it is over, and whether the arm still follows it."""

from __future__ import annotations

import math

from roboneuron.contract import JointCommand, JointKinds, JointSample

_NEARER = 1e-3
"""An arm that comes nearer to its target by this much [sum of rad and m] within the timeout is
late, not stuck.
"""


class LastCommand:
    """Tells when commands have ceased.

    A simulation on a busy machine and a controller that scales speeds are late. To hold them at the
    planned end would end a motion that nobody wanted ended.
    """

    def __init__(self, kinds: JointKinds, timeout_s: float) -> None:
        """`timeout_s` is how long no command may come, and the arm come no nearer [s]."""
        self._kinds = kinds
        self._timeout_s = timeout_s
        self._target: JointCommand | None = None
        self._measured: JointSample | None = None
        # when the arm is to be there, or was last seen to come nearer, and what was left then
        self._end_s, self._left = 0.0, math.inf
        self._looked_s = -math.inf

    def measure(self, joints: JointSample | None) -> None:
        """Note the measured joints; None if they cannot be read."""
        self._measured = joints

    def note_sent(self, command: JointCommand, now_s: float) -> None:
        """Note a command as sent, at a monotonic time [s]."""
        self._target, self._end_s, self._left = command, now_s + command.duration_s, math.inf

    def has_ceased(self, now_s: float) -> bool:
        """Return True once when no command has come for the timeout and the arm comes no nearer."""
        if self._target is None or now_s < self._end_s:
            return False
        # After a halt of this process one look tells nothing: a simulation was halted with it, and
        # a measurement may be from before.
        self._end_s += max(0.0, now_s - max(self._looked_s, self._end_s) - self._timeout_s / 2)
        self._looked_s = now_s
        left = self._distance(self._target)
        if math.isinf(self._left):
            self._left = left
        if now_s - self._end_s <= self._timeout_s:
            return False
        if left < self._left - _NEARER:
            self._left, self._end_s = left, now_s
            return False
        self._target = None
        return True

    def _distance(self, target: JointCommand) -> float:
        """What is left to the target [sum of rad and m]; infinite if it is not measured."""
        left = 0.0
        for name, position in zip(target.names, target.position, strict=True):
            at = None if self._measured is None else self._measured.get(name)
            if at is None:
                return math.inf
            left += abs(self._kinds.difference(name, at, float(position)))
        return left

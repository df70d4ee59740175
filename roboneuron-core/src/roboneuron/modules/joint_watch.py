"""Plausibility check of joint states for control."""

from __future__ import annotations

import numpy as np

from roboneuron.contract import F64, JointSample, RobotProfile
from roboneuron.errors import InvalidInputError, NotReadyError, UnsafeError
from roboneuron.gate.motion.command import pick

_SLACK, _SLACK_M = 0.05, 0.01
"""Tolerance for noise and late messages in the displacement between two states [rad; m for
prismatic joints].
"""
_HASTE = 2.0
"""Factor on a joint's velocity limit in the apparent velocity: on a busy machine messages arrive in
bursts.
"""


class JointWatch:
    """Keep the newest plausible joint state; used from the executor's thread.

    After `timeout_s` without one, the next state is accepted without comparison. So a clock that
    was set, or an arm that was moved while no state arrived, stops the arm for that time only.

    Attributes:
        joints: the newest state, or None if there was none.
    """

    def __init__(self, profile: RobotProfile, timeout_s: float) -> None:
        self.joints: JointSample | None = None
        self._position = np.empty(0)
        self._names = profile.arm_joints
        self._velocity = (
            None
            if profile.limits is None
            else np.asarray(profile.limits.velocity, dtype=np.float64)
        )
        slides = profile.kinds.prismatic
        self._span = profile.kinds.span(profile.arm_joints)
        self._slack = np.array(
            [_SLACK_M if name in slides else _SLACK for name in profile.arm_joints]
        )
        self._timeout_s = timeout_s
        self._at_s = 0.0

    def age_s(self, now_s: float) -> float:
        """Monotonic time since the newest state was accepted; infinite without one."""
        return np.inf if self.joints is None else now_s - self._at_s

    def accept(self, joints: JointSample, now_s: float, ros_now_ns: int) -> bool:
        """Accept a state; return False for a repetition of the previous one.

        A refused state is not used for later comparisons, so one outlier does not make its
        successors implausible.

        Args:
            joints: as received.
            now_s: monotonic time.
            ros_now_ns: ROS time, the clock of the stamps.

        Raises:
            NotReadyError: it was measured too long ago.
            InvalidInputError: it is older than the one before, or its stamp lies in the future.
            UnsafeError: a joint of the arm is missing, not finite, or cannot have reached that
                position.
        """
        age_s = (ros_now_ns - joints.stamp_ns) / 1e9
        if abs(age_s) > self._timeout_s:
            late = age_s > 0
            # on a busy machine messages are late now and then
            error = NotReadyError if late else InvalidInputError
            raise error(
                f"A joint state was measured {abs(age_s):.3g} s "
                f"{'ago' if late else 'in the future'}, at most "
                f"{self._timeout_s:g} s are allowed.",
                hint="Is the robot's driver stuck, or are the clocks of two machines apart?",
            )
        if not np.isfinite(joints.position).all():
            raise UnsafeError("A joint state holds non-finite positions.")
        position = pick(joints.names, joints.position, self._names)
        if self.joints is not None and self.age_s(now_s) <= self._timeout_s:
            if joints.stamp_ns < self.joints.stamp_ns:
                raise InvalidInputError("A joint state is older than the one before.")
            if joints.stamp_ns == self.joints.stamp_ns:
                return False
            self._check_displacement(position, now_s)
        self.joints, self._position, self._at_s = joints, position, now_s
        return True

    def _check_displacement(self, position: F64, now_s: float) -> None:
        """Compare with the previous state: |q - q'| <= _HASTE * v_max * dt + slack, for each joint.

        Raises:
            UnsafeError: names the joint with the largest excess.
        """
        if self._velocity is None:
            return
        moved = np.abs(self._span.difference(self._position, position))
        farthest = _HASTE * self._velocity * (now_s - self._at_s) + self._slack
        excess = moved - farthest
        if excess.max() > 0.0:
            i = int(excess.argmax())
            raise UnsafeError(
                f"{self._names[i]} is measured at {position[i]:.4f}, "
                f"{moved[i]:.4f} from where it "
                f"was {now_s - self._at_s:.3f} s before; no arm is that fast.",
                hint="Does something else publish joint states?",
            )

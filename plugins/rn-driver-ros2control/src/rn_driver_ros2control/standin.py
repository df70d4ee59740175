"""Model of ros2_control's joint_trajectory_controller, for tests and experiments without a robot.

Pure computation: time is an argument. It is not the controller itself, and slower; the modelled
behaviour is listed in `docs/ros2-control.md`. Source of the rules: the documentation of
joint_trajectory_controller (ros2_controllers, Jazzy: userdoc.rst, trajectory.rst, parameters) and
of `control_msgs` JointTolerance; of `positions_upsampling` the descriptions of pull requests 2491
and 2573; undocumented behaviour (an empty trajectory is refused, notifications) was read in its
public source at ed360c9.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from rn_driver_ros2control.sampling import TrajectorySampler, seconds
from rn_driver_ros2control.trajectory import to_duration

F64 = NDArray[np.float64]
ERASED = -1.0
"""Tolerance in a goal that removes the default."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Tolerances:
    """Bounds on |reference - measured|; 0 does not bound.

    Attributes:
        path: while moving, by joint [rad or m].
        goal: at the end, by joint.
        goal_time_s: time after the end within which the goal tolerance has to be met; 0: no limit.
    """

    path: Mapping[str, float] = field(default_factory=dict)
    goal: Mapping[str, float] = field(default_factory=dict)
    goal_time_s: float = 0.0

    def with_goal(
        self, path: Mapping[str, float], goal: Mapping[str, float], goal_time_s: float
    ) -> Tolerances:
        """Tolerances changed by an action goal: 0 keeps, a positive value replaces, -1 erases."""

        def resolve(default: float, asked: float) -> float:
            return asked if asked > 0.0 else 0.0 if asked == ERASED else default

        return Tolerances(
            path={**self.path, **{n: resolve(self.path.get(n, 0.0), v) for n, v in path.items()}},
            goal={**self.goal, **{n: resolve(self.goal.get(n, 0.0), v) for n, v in goal.items()}},
            goal_time_s=resolve(self.goal_time_s, goal_time_s),
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class TrajectoryEnd:
    """End of the active trajectory: a code of FollowJointTrajectory.Result and its text."""

    code: int
    text: str


SUCCESSFUL, INVALID_GOAL, PATH_VIOLATED, GOAL_VIOLATED = 0, -1, -4, -5


class StandInController:
    """One controller with its joints, which follow perfectly unless they are blocked."""

    def __init__(
        self,
        joints: Sequence[str],
        start: F64,
        *,
        tolerances: Tolerances | None = None,
        allow_partial: bool = False,
        allow_nonzero_end: bool = False,
        from_desired: bool = False,
        policy_frequency_hz: float = 0.0,
    ) -> None:
        """Start at `start`; the options are the controller's parameters of the same names and
        defaults. `policy_frequency_hz` above 0 enables `positions_upsampling`.
        """
        self.joints = tuple(joints)
        self.defaults = tolerances or Tolerances()
        self.active = True
        self.blocked = False
        self.measured = start.astype(np.float64).copy()
        self.measured_velocity = np.zeros_like(self.measured)
        self.reference = self.measured.copy()
        self.reference_velocity = np.zeros_like(self.measured)
        self._allow_partial, self._allow_nonzero_end, self._from_desired = (
            allow_partial,
            allow_nonzero_end,
            from_desired,
        )
        self._policy_frequency_hz = policy_frequency_hz
        self._tolerances = self.defaults
        self._sampler = TrajectorySampler(self.joints)
        self._is_done = True
        self._now_s = 0.0

    def upsampled(self, trajectory: JointTrajectory) -> JointTrajectory:
        """Result of `positions_upsampling` for a message on the controller's topic.

        Positions without velocities get those of a spline with continuous acceleration, from the
        present velocity to rest; without times, one point per period of the policy is assumed.
        Everything else stays unchanged, also if it will be refused.
        """
        names, points = list(trajectory.joint_names), list(trajectory.points)
        is_positions = bool(points) and all(
            len(point.positions) == len(names) and not len(point.velocities) for point in points
        )
        if not self._policy_frequency_hz or not is_positions or set(names) != set(self.joints):
            return trajectory
        times_s = np.array([seconds(point) for point in points])
        if not times_s.any():
            times_s = np.arange(1, len(points) + 1) / self._policy_frequency_hz
        steps_s = np.diff(times_s, prepend=0.0)
        if (steps_s <= 0.0).any():
            return trajectory
        order = [self.joints.index(name) for name in names]
        start = (self.reference if self._from_desired else self.measured)[order]
        moving = self.reference_velocity if self._from_desired else self.measured_velocity
        positions = np.vstack([start, [point.positions for point in points]])
        velocities = _spline_velocities(positions, steps_s, moving[order])
        filled = JointTrajectory(header=trajectory.header, joint_names=names)
        for position, velocity, due_s in zip(positions[1:], velocities, times_s, strict=True):
            point = JointTrajectoryPoint(positions=position.tolist(), velocities=velocity.tolist())
            point.time_from_start = to_duration(float(due_s))
            filled.points.append(point)
        return filled

    def refusal(self, trajectory: JointTrajectory, now_s: float) -> str:
        """Reason why the controller would refuse this; empty if it would not. `now_s` is
        ROS time.
        """
        names, points = list(trajectory.joint_names), list(trajectory.points)
        if not names:
            return "Empty joint names on incoming trajectory."
        if not self._allow_partial and len(names) != len(self.joints):
            return "Joints on incoming trajectory don't match the controller joints."
        if not points:
            return "Empty trajectory received."
        if unknown := [name for name in names if name not in self.joints]:
            return f"Incoming joint {unknown[0]} doesn't match the controller's joints."
        if not self._allow_nonzero_end and any(abs(v) > 1.2e-7 for v in points[-1].velocities):
            return "Velocity of last trajectory point is not zero."
        stamp_s = trajectory.header.stamp.sec + trajectory.header.stamp.nanosec * 1e-9
        if stamp_s and stamp_s + seconds(points[-1]) < now_s:
            return "Received trajectory with non-zero start time that ends in the past."
        previous_s = -math.inf
        for point in points:
            if seconds(point) <= previous_s:
                return "Time between points is not strictly increasing."
            previous_s = seconds(point)
            if len(point.positions) != len(names) or len(point.velocities) not in (0, len(names)):
                return "Mismatch between joint_names and positions or velocities."
            if len(point.effort):
                return (
                    "Trajectories with effort fields are only supported with the 'effort' "
                    "command interface."
                )
        return ""

    def take(
        self, trajectory: JointTrajectory, now_s: float, tolerances: Tolerances | None = None
    ) -> None:
        """Execute a trajectory that `refusal` accepts; it replaces the previous one at once."""
        base = self.reference if self._from_desired else self.measured
        velocity = self.reference_velocity if self._from_desired else self.measured_velocity
        self._sampler.start(trajectory, now_s, base, velocity)
        self._tolerances = tolerances or self.defaults
        self._is_done = False

    def forward(self, values: Sequence[float]) -> None:
        """Take positions at once, as JointGroupPositionController does: in the order of its joints;
        another number of them is ignored, and so is all while it is inactive.
        """
        if self.active and len(values) == len(self.joints):
            self._sampler.clear()
            self.reference = np.array(values, dtype=np.float64)

    def hold(self) -> None:
        """Hold the measured position, at once."""
        self.reference, self.reference_velocity = self.measured.copy(), np.zeros_like(self.measured)
        self._sampler.clear()
        self._is_done = True

    def update(self, now_s: float) -> TrajectoryEnd | None:
        """Run one cycle at ROS time `now_s`; return the end of the trajectory, once."""
        step_s, self._now_s = now_s - self._now_s, now_s
        if not self.active:
            self.measured_velocity = np.zeros_like(self.measured)
            return None
        if (sampled := self._sampler.sample(now_s)) is not None:
            self.reference, self.reference_velocity = sampled
        if not self.blocked:
            if step_s > 0.0:
                self.measured_velocity = (self.reference - self.measured) / step_s
            self.measured = self.reference.copy()
        else:
            self.measured_velocity = np.zeros_like(self.measured)
        return None if self._is_done else self._judge(now_s)

    def _judge(self, now_s: float) -> TrajectoryEnd | None:
        error = dict(zip(self.joints, np.abs(self.reference - self.measured).tolist(), strict=True))
        end_s, active = self._sampler.end_s or now_s, self._tolerances
        if now_s < end_s:
            if any(0.0 < bound < error[name] for name, bound in active.path.items()):
                self.hold()
                return TrajectoryEnd(
                    code=PATH_VIOLATED, text="Aborted due to path tolerance violation"
                )
            return None
        if all(bound <= 0.0 or error[name] <= bound for name, bound in active.goal.items()):
            self._is_done = True
            return TrajectoryEnd(code=SUCCESSFUL, text="Goal successfully reached!")
        if active.goal_time_s and now_s - end_s > active.goal_time_s:
            self.hold()
            return TrajectoryEnd(
                code=GOAL_VIOLATED, text="Aborted due to goal_time_tolerance exceeding"
            )
        return None


def _spline_velocities(positions: F64, steps_s: F64, velocity: F64) -> F64:
    """Velocities (n, joints) at the points after the first of the cubic spline through them.

    It begins with `velocity` and ends at rest. Source: continuity of the second derivative at each
    inner point of a piecewise cubic in Hermite form.

    Args:
        positions: (n + 1, joints), the present ones first.
        steps_s: (n,), from each to the next, > 0.
        velocity: (joints,), at the first.
    """
    count = len(steps_s)
    slopes = np.diff(positions, axis=0) / steps_s[:, None]
    velocities = np.zeros((count + 1, positions.shape[1]))
    velocities[0] = velocity
    matrix = np.eye(count + 1)
    for i in range(1, count):
        before, after = 1.0 / steps_s[i - 1], 1.0 / steps_s[i]
        matrix[i, i - 1 : i + 2] = before, 2.0 * (before + after), after
        velocities[i] = 3.0 * (slopes[i - 1] * before + slopes[i] * after)
    return np.asarray(np.linalg.solve(matrix, velocities)[1:])

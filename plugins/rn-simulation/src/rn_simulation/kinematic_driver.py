"""Driver of an arm that exists in its profile only: joints follow commands, without physics."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rn_simulation.command import checked
from rn_simulation.setpoint import JointSetpoint
from roboneuron import (
    ConfigurationError,
    InvalidInputError,
    JointCommand,
    JointSample,
    RobotProfile,
    RobotState,
    StateError,
    Topics,
)

F64 = NDArray[np.float64]

_STEP_S = 0.004
_ROUNDING = 1e-9
"""Of a gripper's position, which is computed from its opening [rad or m]."""
_TRAVEL_S = 1.0
"""Time of a gripper from one end to the other if the description has no velocity limit for it."""
_GRIPPER_RISE_S = 0.1


class KinematicArmDriver:
    """Follows the protocol `RobotDriver`; every method may be called from any thread.

    Joints move within the velocity and acceleration limits of the profile, computed from the clock
    when they are read. There are no forces, contacts or delays: it shows directions, limits and
    distances of any arm, not how well a real one follows.
    """

    def __init__(self, config: None, profile: RobotProfile, topics: Topics) -> None:
        """Store the arguments."""
        self._profile = profile
        self._topics = topics
        self._names = (*profile.arm_joints, *(g.joint for g in profile.grippers))
        self._lock = threading.Lock()
        self._setpoint: JointSetpoint | None = None
        self._lower, self._upper = np.empty(0), np.empty(0)
        self._at_s = 0.0

    def open(self) -> None:
        """Stand at home with open grippers.

        Raises:
            ConfigurationError: the profile has no home posture or no limits.
        """
        home, limits = self._profile.home_rad, self._profile.limits
        if home is None or limits is None:
            raise ConfigurationError(
                f"The profile of robot {self._profile.name!r} has no home posture or no limits."
            )
        grippers = self._profile.grippers
        ends = np.array([[g.closed_position, g.open_position] for g in grippers]).reshape(-1, 2)
        told = np.array([self._profile.kinds.velocity_limit(g.joint) for g in grippers])
        travel = np.abs(ends[:, 1] - ends[:, 0]) / _TRAVEL_S
        speed = np.where(np.isfinite(told) & (told > 0.0), told, travel)
        with self._lock:
            self._lower = np.concatenate([limits.lower, ends.min(axis=1)])
            self._upper = np.concatenate([limits.upper, ends.max(axis=1)])
            self._setpoint = JointSetpoint(
                np.concatenate([home, ends[:, 1]]),
                np.concatenate([limits.velocity, speed]),
                np.concatenate([limits.acceleration, speed / _GRIPPER_RISE_S]),
            )
            self._at_s = time.monotonic()

    def _advanced(self) -> JointSetpoint:
        """The joints as they are now; with the lock held. Raises StateError unless open."""
        setpoint = self._setpoint
        if setpoint is None:
            raise StateError(f"The simulated {self._profile.name!r} is not open.")
        now_s = time.monotonic()
        while self._at_s + _STEP_S <= now_s:
            if not setpoint.velocity.any() and np.array_equal(setpoint.position, setpoint.target):
                self._at_s = now_s  # at rest nothing changes, however long that was
                break
            setpoint.advance(_STEP_S)
            self._at_s += _STEP_S
        return setpoint

    def read(self) -> RobotState:
        """Where the joints are now. Raises StateError unless open."""
        with self._lock:
            setpoint = self._advanced()
            position, velocity = setpoint.position.copy(), setpoint.velocity.copy()
        joints = JointSample(
            names=self._names,
            position=position,
            velocity=velocity,
            stamp_ns=self._topics.now_ns(),
        )
        openings = [gripper.opening_in(joints) for gripper in self._profile.grippers]
        return RobotState(joints=joints, gripper_open=openings[0] if openings else None)

    def send(self, command: JointCommand) -> JointCommand:
        """Move towards `command`; it replaces the previous one.

        Returns:
            The command, with the duration that velocity and acceleration allow from rest.

        Raises:
            InvalidInputError: an unknown or repeated joint, a wrong size, a position that is not
                finite or outside the limits, a duration <= 0; nothing is sent.
            StateError: not open.
        """
        with self._lock:
            setpoint = self._advanced()
            goal = setpoint.position.copy()
            rows = []
            for name, position in checked(command, self._names).items():
                row = self._names.index(name)
                low, high = float(self._lower[row]), float(self._upper[row])
                if not low - _ROUNDING <= position <= high + _ROUNDING:
                    raise InvalidInputError(
                        f"Joint {name!r} is sent to {position:g}, expected {low:g} .. {high:g}."
                    )
                rows.append(row)
                goal[row] = min(max(position, low), high)
            duration_s = max(command.duration_s, setpoint.shortest_s(goal, rows))
            setpoint.aim(goal, rows, command.duration_s)
        return replace(command, duration_s=duration_s)

    def hold(self) -> None:
        """Brake to a standstill. Raises StateError unless open."""
        with self._lock:
            self._advanced().halt(list(range(len(self._names))))

    def close(self) -> None:
        """Forget where the joints are; may be called twice."""
        with self._lock:
            self._setpoint = None

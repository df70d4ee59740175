"""The next joint positions for the arm, planned from its own commanded state; pure computation.

The arm differentiates the commands: from the last three positions it gets velocity and
acceleration, and with the next one the jerk. For a cycle without a command it extrapolates with
constant acceleration, and counts the result as commanded (libfranka, docs/overview.rst).
`CommandedState` does the same computation; `Follower` plans from it.

Every course starts on the parabola through the last three positions and has a bounded jerk. So the
third difference of the commands is a mean of jerks within the limit, regardless of missed cycles.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from math import sqrt
from typing import TYPE_CHECKING

from rn_robot_fr3.limits import (
    BRAKING_DECELERATION_RAD_S2,
    BRAKING_OFFSET_RAD_S,
    LOWER_RAD,
    UPPER_RAD,
    VELOCITY_RAD_S,
)

if TYPE_CHECKING:
    import ruckig

STEP_S = 0.001
JOINTS = 7
_ROUNDING = 6.5e-8
"""Tolerance for 32-bit floats in states, with errors of up to 2**-24 of a position."""
_LEAST_RAD = 1e-9
_CLEARLY_RAD_S2 = 0.3
"""Margin by which a missed command must explain a state's acceleration better than a taken one, if
both explain its position.
"""
LONGEST_GAP = 20
"""Cycles without a command after which the arm stops by itself. Source: libfranka,
docs/overview.rst.
"""
LONGEST_UNHEARD = 100
"""Maximum number of consecutive commands not accepted by the arm although states arrive: all are
late.
"""
_VELOCITY_SHARE = 0.97
"""Share of the velocity allowed at the current position; above it the follower brakes."""
_RESTING_RAD_S = 1e-9


@dataclass(frozen=True, kw_only=True, slots=True)
class Course:
    """Target of a motion, with its limits.

    Attributes:
        target: 7 joint positions [rad].
        velocity, acceleration, jerk: 7 limits each [rad/s, rad/s^2, rad/s^3].
    """

    target: tuple[float, ...]
    velocity: tuple[float, ...]
    acceleration: tuple[float, ...]
    jerk: tuple[float, ...]


class CommandedState:
    """Commanded state of the arm, by its own computation.

    Attributes:
        position, velocity, acceleration: 7 each, the newest position and backward differences [rad,
            rad/s, rad/s^2].
    """

    def __init__(
        self, position: list[float], velocity: list[float], acceleration: list[float]
    ) -> None:
        self.position, self.velocity, self.acceleration = position, velocity, acceleration

    def sent(self, position: list[float]) -> CommandedState:
        """State after a cycle with a command."""
        velocity = [(new - old) / STEP_S for new, old in zip(position, self.position, strict=True)]
        acceleration = [
            (new - old) / STEP_S for new, old in zip(velocity, self.velocity, strict=True)
        ]
        return CommandedState(list(position), velocity, acceleration)

    def missed(self, cycles: int) -> CommandedState:
        """State after cycles without a command: constant acceleration."""
        acceleration, position, velocity = self.acceleration, self.position, self.velocity
        for _ in range(cycles):
            velocity = [v + a * STEP_S for v, a in zip(velocity, acceleration, strict=True)]
            position = [q + v * STEP_S for q, v in zip(position, velocity, strict=True)]
        return CommandedState(position, velocity, acceleration)

    def is_at(self, position: list[float]) -> bool:
        """True if a state has this position, within its accuracy."""
        both = zip(self.position, position, strict=True)
        return all(abs(q - p) <= _ROUNDING * abs(q) + _LEAST_RAD for q, p in both)

    def differs_by(self, acceleration: list[float]) -> float:
        """Maximum difference of the accelerations from those of a state [rad/s^2]."""
        return max(abs(a - b) for a, b in zip(self.acceleration, acceleration, strict=True))


class PlannerError(Exception):
    """No trajectory was found."""


class Follower:
    """Moves the arm to the newest target, or brakes; used by one thread.

    Attributes:
        unheard: number of consecutive commands not accepted by the arm.
    """

    def __init__(
        self,
        position: list[float],
        stop_acceleration: tuple[float, ...],
        stop_jerk: tuple[float, ...],
    ) -> None:
        """The arm stands at `position`; the other arguments are the limits of a stop [rad/s^2,
        rad/s^3].
        """
        self._ruckig = importlib.import_module("ruckig")
        self._planner = self._ruckig.Ruckig(JOINTS)
        self._trajectory: ruckig.Trajectory = None  # until planned
        self._time_s = 0.0
        self._stop = (stop_acceleration, stop_jerk)
        self._course: Course | None = None
        self._is_new = False
        self._is_slowing = False
        self._arm = CommandedState(list(position), [0.0] * JOINTS, [0.0] * JOINTS)
        self._sent: list[float] | None = None
        self.unheard = 0

    def aim(self, course: Course) -> None:
        """Set a new target."""
        self._course, self._is_new = course, True

    def brake(self) -> None:
        """Come to rest as soon as the limits allow."""
        if self._course is not None or self._trajectory is None:
            self._course, self._is_new = None, True

    @property
    def is_resting(self) -> bool:
        """True if the newest motion has ended and the arm stands by its own computation."""
        if self._is_new or self._trajectory is None:
            return False
        stands = max(map(abs, self._arm.velocity)) < _RESTING_RAD_S
        return stands and self._time_s >= float(self._trajectory.duration) + 3 * STEP_S

    def next(
        self, position: list[float], velocity: list[float], acceleration: list[float], cycles: int
    ) -> list[float]:
        """Compute the command for a state.

        Args:
            position, velocity, acceleration: q_d, dq_d and ddq_d of the state.
            cycles: number of cycles since the previous state.

        Raises:
            PlannerError: there is no trajectory from the current state.
        """
        is_as_sent = self._observe(position, velocity, acceleration, cycles)
        if self._is_new or not is_as_sent or self._trajectory is None:
            self._plan(is_as_sent)
        elif self._is_slowing and self._time_s >= float(self._trajectory.duration):
            self._is_slowing = False
            self._plan(is_as_sent)
        command = self._sample()
        if not self._is_slowing and self._is_too_fast(command):
            self._is_slowing = True
            self._plan(is_as_sent)
            command = self._sample()
        self._time_s += STEP_S
        self._sent = command
        return command

    def expect(self, position: list[float]) -> None:
        """Replace the last command: the command that begins a motion is the arm's current
        position.
        """
        self._sent = position

    def skip(self) -> None:
        """Report that the newest command was not sent."""
        self._sent = None

    def _observe(
        self, position: list[float], velocity: list[float], acceleration: list[float], cycles: int
    ) -> bool:
        """Update the arm's commanded state; return whether it equals the sent one."""
        before = self._arm
        taken = before.sent(self._sent).missed(cycles - 1) if self._sent is not None else None
        lost = before.missed(cycles)
        is_lost = lost.is_at(position)
        if taken is not None and taken.is_at(position):
            is_lost &= (
                taken.differs_by(acceleration) > lost.differs_by(acceleration) + _CLEARLY_RAD_S2
            )
            self._arm = lost if is_lost else taken
        elif is_lost:
            self._arm = lost
        elif self._sent is not None and cycles > 1 and before.sent(self._sent).is_at(position):
            assert taken is not None  # it came late; the arm extrapolates over the whole gap
            self._arm = taken
        else:
            self._arm = CommandedState(list(position), list(velocity), list(acceleration))
        self.unheard = 0 if self._arm is taken else self.unheard + (self._sent is not None)
        return self._arm is taken and cycles == 1

    def _plan(self, is_as_sent: bool) -> None:
        """Plan a motion from the arm's state, or from the state of the last trajectory."""
        request = self._ruckig.InputParameter(JOINTS)
        if is_as_sent and self._trajectory is not None:
            state = self._trajectory.at_time(self._time_s)
            request.current_position, request.current_velocity, request.current_acceleration = state
        else:
            arm = self._arm
            request.current_position = arm.position
            request.current_velocity = [
                v + a * STEP_S / 2.0 for v, a in zip(arm.velocity, arm.acceleration, strict=True)
            ]
            request.current_acceleration = arm.acceleration
        course = None if self._is_slowing else self._course
        self._trajectory = (course and self._towards(request, course)) or self._to_rest(request)
        self._time_s = 0.0
        self._is_new = False

    def _towards(self, request: ruckig.InputParameter, course: Course) -> ruckig.Trajectory:
        """A trajectory to the target; None if there is none."""
        request.control_interface = self._ruckig.ControlInterface.Position
        request.target_position = course.target
        request.max_velocity, request.max_acceleration = course.velocity, course.acceleration
        request.max_jerk = course.jerk
        trajectory = self._ruckig.Trajectory(JOINTS)
        result = self._planner.calculate(request, trajectory)
        return trajectory if result == self._ruckig.Result.Working else None

    def _to_rest(self, request: ruckig.InputParameter) -> ruckig.Trajectory:
        request.control_interface = self._ruckig.ControlInterface.Velocity
        request.synchronization = self._ruckig.Synchronization.No
        request.target_velocity = [0.0] * JOINTS
        request.target_acceleration = [0.0] * JOINTS
        request.max_acceleration, request.max_jerk = self._stop
        trajectory = self._ruckig.Trajectory(JOINTS)
        result = self._planner.calculate(request, trajectory)
        if result != self._ruckig.Result.Working:
            raise PlannerError(f"planner failed: {result} from {self._arm.velocity} rad/s.")
        return trajectory

    def _sample(self) -> list[float]:
        position: list[float] = list(self._trajectory.at_time(self._time_s + STEP_S)[0])
        return position

    def _is_too_fast(self, command: list[float]) -> bool:
        """True if a joint exceeds the velocity allowed at its position without slowing down."""
        for joint in range(JOINTS):
            speed = (command[joint] - self._arm.position[joint]) / STEP_S
            room = (
                UPPER_RAD[joint] - command[joint]
                if speed > 0.0
                else command[joint] - LOWER_RAD[joint]
            )
            braking = (
                sqrt(2.0 * BRAKING_DECELERATION_RAD_S2[joint] * max(room, 0.0))
                - BRAKING_OFFSET_RAD_S[joint]
            )
            if abs(speed) > _VELOCITY_SHARE * max(0.0, min(VELOCITY_RAD_S[joint], braking)) + 1e-6:
                return True
        return False

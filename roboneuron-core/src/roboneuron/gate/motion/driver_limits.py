"""Joint-space limits of the commands that reach a driver, whoever sends them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from roboneuron.contract import JointCommand, JointSample, RobotProfile
from roboneuron.errors import RefusedError
from roboneuron.gate.motion import acceleration
from roboneuron.gate.motion.command import FARTHEST
from roboneuron.gate.motion.joint_space import JointLimit
from roboneuron.gate.motion.limiter import LOST, LOST_M
from roboneuron.gate.motion.rules import MotionRules

MOST_POINTS = 2000
"""Points of a trajectory; a longer one would occupy the robot module for too long."""
_NOISE = 1e-3
"""Distance beyond a position limit [rad or m] that is measurement noise: a hold commands the
measured posture.
"""
_SETTLED_S = 0.1
"""Time after the end of its command at which a joint without velocity counts as at rest."""
_LONGEST_GAP_S = 0.5
"""Time since the previous command in which a sender without times (JointState) meant the joints to
move, at most.
"""
_CREEP = 0.01
"""Share of the velocity limit that is allowed everywhere within the position limits: an arm that
was moved by hand close to a limit can be held there.
"""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PassedCommand:
    """A command within the limits.

    Attributes:
        command: as received, or with more time, or with positions at their limits.
        acted: the limits that changed it: "position", "velocity", "acceleration".
        reason: one sentence on the last of them.
    """

    command: JointCommand
    acted: tuple[str, ...] = ()
    reason: str = ""


class _Travel(NamedTuple):
    """Motion of one joint by its last command: a straight line, then braking at its end."""

    start: float
    change: float
    duration_s: float
    sent_s: float

    def at(self, now_s: float, braking: float) -> tuple[float, float]:
        """Position and velocity at a monotonic time."""
        passed_s = max(0.0, now_s - self.sent_s)
        velocity = self.change / self.duration_s
        if passed_s <= self.duration_s:
            return self.start + velocity * passed_s, velocity
        left = max(0.0, abs(velocity) - braking * (passed_s - self.duration_s))
        return self.start + self.change, math.copysign(left, velocity)


class DriverLimiter:
    """Limits the joints of one robot in front of its driver: names, positions, velocities,
    accelerations.

    A command that asks for a little more than the joints may gets the time that they need, and is
    otherwise unchanged; so a command that is late by the jitter of messages is no fault. One that
    cannot be meant is refused (`RefusedError.rule` is the reason's name): "malformed_command",
    "unknown_joint", "limit_position", "joint_jump", "not_measured".

    The velocity of a command is its distance from where the previous commands have brought the
    joints, divided by its duration. The acceleration is the change of that velocity over the time
    between the middles of both commands: no joint can do more within its acceleration limit.
    Braking is not limited, because a hold must pass.

    One thread calls `limit`, `note_sent` and `note_hold`; the other methods may be called from any
    thread.

    Args:
        profile: joints, limits and grippers of the robot. For robots without arm joints only the
            form of commands is checked.
        rules: fractions of velocity and acceleration in use.
    """

    def __init__(self, profile: RobotProfile, rules: MotionRules) -> None:
        self._profile = profile
        self._arm = frozenset(profile.arm_joints)
        self._kinds = profile.kinds
        slides = self._kinds.prismatic
        self._lost = {name: LOST_M if name in slides else LOST for name in profile.arm_joints}
        # replaced as a whole, never changed: read by other threads
        self._lines: Mapping[str, _Travel] = {}
        self._measured: Mapping[str, float] = {}
        self.use(rules)

    def use(self, rules: MotionRules) -> None:
        """Apply other fractions from the next command on."""
        found = JointLimit.by_joint(self._profile, rules)
        self._limits = {name: found.get(name, JointLimit()) for name in self._profile.arm_joints}
        self._limits |= found

    def measure(self, joints: JointSample | None) -> None:
        """Record the newest measured joints; None if they are unknown."""
        self._measured = (
            {}
            if joints is None
            else {
                name: place
                for name, place in zip(joints.names, joints.position.tolist(), strict=False)
                if math.isfinite(place)
            }
        )

    @property
    def is_measured(self) -> bool:
        """Whether the joints are known."""
        return bool(self._measured)

    @property
    def ends_s(self) -> float:
        """Monotonic time at which the newest command ends; 0 without one."""
        return max((line.sent_s + line.duration_s for line in self._lines.values()), default=0.0)

    def admit(self, commands: Sequence[JointCommand], now_s: float) -> list[JointCommand]:
        """Check the points of a command that arrives now.

        The first point is returned as it came: `limit` changes it when it is due. The later ones
        are within the limits if the joints reach the point before each of them.

        Raises:
            RefusedError: for the first point that is refused; nothing of the command may be sent.
        """
        lines, admitted = self._lines, list(commands[:1])
        for index, command in enumerate(commands):
            try:
                passed = self._pass(command, lines, now_s, is_planned=index > 0)
            except RefusedError as error:
                where = f"points[{index}]: " if len(commands) > 1 else ""
                raise RefusedError(f"{where}{error.message}", rule=error.rule) from None
            if len(commands) == 1:
                break
            if index:
                admitted.append(passed.command)
            lines = self._after(passed.command, lines, now_s, is_planned=index > 0)
            now_s += passed.command.duration_s
        return admitted

    def limit(self, command: JointCommand, now_s: float) -> PassedCommand:
        """Return the command to give to the driver now.

        Args:
            command: finite positions, a duration > 0.
            now_s: monotonic time.

        Raises:
            RefusedError: see the class.
        """
        return self._pass(command, self._lines, now_s)

    def note_sent(self, command: JointCommand, now_s: float) -> None:
        """Record a command that the driver has accepted, as it was given to it."""
        self._lines = self._after(command, self._lines, now_s)

    def note_hold(self) -> None:
        """Record that the driver brakes: the next command starts from the measured joints."""
        self._lines = {}

    def _pass(
        self,
        command: JointCommand,
        lines: Mapping[str, _Travel],
        now_s: float,
        *,
        is_planned: bool = False,
    ) -> PassedCommand:
        """Limit a command that is sent at `now_s`, or planned for then: the measured joints say
        nothing about the start of a planned one.
        """
        self._check_form(command)
        if not self._arm:
            return PassedCommand(command=command)
        asked_s = needed_s = command.duration_s
        acted: list[str] = []
        position, reason = command.position.tolist(), ""
        for index, (name, target) in enumerate(zip(command.names, position, strict=True)):
            limit = self._limits[name]
            start, velocity, since_s = self._start(name, lines, now_s, is_planned)
            # the same posture, which a continuous joint reaches the shorter way
            near = self._kinds.nearest(name, start, target, limit.lower, limit.upper)
            position[index] = within = self._within(name, near, start)
            if within != near:
                acted.append("position")
                reason = f"{name} would go to {target:.4f}, beyond its limits."
            if name not in self._arm:
                continue
            change = within - start
            distance = abs(change)
            allowed = max(limit.fastest(within, change > 0.0), _CREEP * limit.velocity)
            self._check_jump(name, distance, allowed, asked_s, since_s)
            most = 1.0 + JointLimit.SLACK
            velocity_s = distance / (allowed * most)
            if velocity_s > needed_s:
                needed_s = velocity_s
                acted.append("velocity")
                reason = (
                    f"{name} would move at {distance / asked_s:.4g} per second, allowed is "
                    f"{allowed:.4g}."
                )
            along = max(0.0, math.copysign(1.0, change) * velocity)
            change_s = acceleration.change_s(distance, along, limit.acceleration * most, since_s)
            if change_s > needed_s:
                needed_s = change_s
                acted.append("acceleration")
                reason = f"{name} would change its velocity faster than its acceleration allows."
        if not acted and position == command.position.tolist():
            return PassedCommand(command=command)
        return PassedCommand(
            command=replace(command, position=np.array(position), duration_s=needed_s),
            acted=tuple(dict.fromkeys(acted)),
            reason=reason,
        )

    def _check_form(self, command: JointCommand) -> None:
        names = command.names
        if not names or len(set(names)) != len(names) or command.position.shape != (len(names),):
            raise RefusedError(
                f"A command names {len(names)} joints, {len(set(names))} different, and has "
                f"positions of shape {command.position.shape}.",
                rule="malformed_command",
            )
        if not (math.isfinite(command.duration_s) and command.duration_s > 0.0):
            raise RefusedError(
                f"A command lasts {command.duration_s} s, expected a finite time > 0.",
                rule="malformed_command",
            )
        if not (np.abs(command.position) <= FARTHEST).all():  # false for NaN
            raise RefusedError(
                f"A command sends a joint to no possible position: {command.position.tolist()}.",
                rule="limit_position" if np.isfinite(command.position).all() else "not_finite",
            )
        unknown = [name for name in names if name not in self._limits]
        if unknown and self._arm:
            raise RefusedError(
                f"Joint {unknown[0][:60]!a} is unknown, the robot has {', '.join(self._limits)}.",
                rule="unknown_joint",
            )

    def _start(
        self, name: str, lines: Mapping[str, _Travel], now_s: float, is_planned: bool
    ) -> tuple[float, float, float]:
        """Where a joint is by its commands, its velocity, and the time since the last one [s];
        as measured and at rest without one, or if the joint does not follow it.
        """
        measured = self._measured.get(name)
        line = lines.get(name)
        if line is not None:
            place, velocity = line.at(now_s, self._limits[name].acceleration)
            if measured is not None and not is_planned:
                place = self._kinds.nearest(name, measured, place)
            if (
                is_planned
                or measured is None
                or abs(place - measured) <= self._lost.get(name, math.inf)
            ):
                since_s = now_s - line.sent_s
                # a command that keeps the joint still counts for its duration, as for the gate
                is_settled = not velocity and since_s > line.duration_s + _SETTLED_S
                return place, velocity, math.inf if is_settled else since_s
        if measured is None:
            if name not in self._arm:
                return math.nan, 0.0, math.inf
            raise RefusedError(
                f"{name} was not measured, so that no command can be checked.", rule="not_measured"
            )
        return measured, 0.0, math.inf

    def _within(self, name: str, target: float, start: float) -> float:
        """Return the target within the position limits; a joint that is measured outside may stay
        or move back.
        """
        limit = self._limits[name]
        if limit.allows("position", target):
            return target
        place = self._measured.get(name, start)
        low, high = limit.lower, limit.upper
        if name in self._arm and math.isfinite(place):
            low, high = min(low, place), max(high, place)
        if not low - _NOISE <= target <= high + _NOISE or name not in self._arm:
            raise RefusedError(
                f"{name} would go to {target:.4g}, allowed is {limit.lower:.4g} .. "
                f"{limit.upper:.4g}.",
                rule="limit_position",
            )
        return min(max(target, low), high)

    def _check_jump(
        self, name: str, distance: float, allowed: float, asked_s: float, since_s: float
    ) -> None:
        """Raise RefusedError for a position that is farther away than the joint moves in the time
        of the command, or since the last one, by more than an arm may lag behind.
        """
        meant_s = max(asked_s, since_s) if since_s <= _LONGEST_GAP_S else asked_s
        if distance > allowed * meant_s + self._lost[name]:
            raise RefusedError(
                f"{name} would jump by {distance:.4g} in {asked_s:.4g} s, it moves at most "
                f"{allowed:.4g} per second.",
                rule="joint_jump",
            )

    def _after(
        self,
        command: JointCommand,
        lines: Mapping[str, _Travel],
        now_s: float,
        *,
        is_planned: bool = False,
    ) -> Mapping[str, _Travel]:
        """The lines after a command that is sent now."""
        after = dict(lines)
        for name, target in zip(command.names, command.position.tolist(), strict=False):
            if name in self._arm and math.isfinite(target) and command.duration_s > 0.0:
                try:
                    start, _, _ = self._start(name, lines, now_s, is_planned)
                except RefusedError:
                    continue
                after[name] = _Travel(start, target - start, command.duration_s, now_s)
        return after

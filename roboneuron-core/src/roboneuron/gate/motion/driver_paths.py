"""Places on the paths of the commands that reach a driver, whoever sends them."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from roboneuron.contract import JointCommand, JointSample, RobotProfile
from roboneuron.errors import RefusedError
from roboneuron.gate.motion.path_limits import Leg, LimitError, PathLimiter
from roboneuron.gate.motion.rules import MotionRules

SHORT = 8
"""Postures of a path that are checked where the command arrives; about a millisecond. Longer paths
would delay a stop there.
"""
_CURVE = 1.02
"""Ratio of the TCP's speed to its limit up to which a command keeps its time: control limits the
mean speed of a step, and the TCP is faster in a part of it, because it moves on a curve.
"""
_MOVED = 0.01
"""Distance [rad or m] beyond which the joints have moved during a check."""
_HOLDS_S, _MOST_MEASURED = 1.0, 1024
"""Age of the oldest measured posture to which an arm may be held, and the number of postures kept,
at up to 1000 a second.
"""


def _known(joints: JointSample) -> dict[str, float]:
    """The measured positions by joint; a driver may tell one that is not finite."""
    pairs = zip(joints.names, joints.position.tolist(), strict=False)
    return {name: position for name, position in pairs if math.isfinite(position)}


def _have_moved(before: JointSample, now: JointSample) -> bool:
    return before is not now and (
        before.names != now.names or bool((np.abs(now.position - before.position) > _MOVED).any())
    )


class DriverPaths:
    """Checks the links and the TCP on the way of each command in front of a driver: workspace,
    height, zones, collisions and the TCP's speed, from the measured joints.

    A command that goes to a posture that the driver has measured within the last second is a hold,
    and passes: it must, also where the arm may not be. A gripper that is not measured is left out,
    because a driver may drive none; an arm joint that is not measured refuses the command.

    Usable from any thread.

    Args:
        limiter: of the robot's paths.
        profile: joints of the robot.
    """

    def __init__(self, limiter: PathLimiter, profile: RobotProfile) -> None:
        self._limiter, self._profile = limiter, profile
        self._joints: JointSample | None = None
        # with the times of measuring [monotonic s]
        self._measured: deque[tuple[float, JointSample]] = deque(maxlen=_MOST_MEASURED)

    def use(self, rules: MotionRules) -> None:
        """Apply other rules from the next command on."""
        self._limiter.use(rules)

    def measure(self, joints: JointSample | None, now_s: float) -> None:
        """Record the newest measured joints; None if they are unknown."""
        self._joints = joints
        if joints is not None:
            self._measured.append((now_s, joints))

    def is_short(self, commands: Sequence[JointCommand]) -> bool:
        """Whether the path is checked within about a millisecond."""
        joints, left = self._joints, SHORT
        if joints is None:
            return True
        for leg, start in self._legs(commands, joints):
            left -= self._limiter.count(leg, start)
            if left < 0:
                return False
        return True

    def limit(
        self, commands: Sequence[JointCommand], is_current: Callable[[], bool] = lambda: True
    ) -> tuple[list[JointCommand], str]:
        """Check the path from the measured joints through the points of a command; return it with
        the time that the TCP's speed limits need, and what would be too fast, empty for nothing.

        Args:
            commands: the points.
            is_current: asked before each point; the check ends when it returns False, and says
                nothing then.

        Raises:
            RefusedError: `rule` is "limit_<name>", or "not_measured".
        """
        joints = self._joints
        if joints is None:
            raise RefusedError("The joints are not measured.", rule="not_measured")

        factors, reason, index = [1.0] * len(commands), "", -1

        def legs() -> Iterator[Leg]:
            nonlocal index
            for index, (leg, _) in enumerate(self._legs(commands, joints)):  # noqa: B007
                if not is_current():
                    return
                yield leg

        try:
            for _, times, told in self._limiter.speeds(legs(), joints):
                if times > max(_CURVE, factors[index]):
                    factors[index], reason = times, told
            now = self._joints
            # a long check takes time, in which the command before it goes on
            if now is not None and _have_moved(joints, now) and is_current():
                first = next(self._legs(commands[:1], now))[0]
                for _, times, told in self._limiter.speeds([first], now):
                    if times > max(_CURVE, factors[0]):
                        factors[0], reason = times, told
        except LimitError as error:
            if len(commands) == 1 and self._is_hold(commands[0]):
                return list(commands), ""
            raise RefusedError(error.message, rule=f"limit_{error.limit}") from error
        if not reason:
            return list(commands), ""
        slower = [
            replace(command, duration_s=command.duration_s * factor)
            for command, factor in zip(commands, factors, strict=True)
        ]
        return slower, reason

    def _legs(
        self, commands: Sequence[JointCommand], joints: JointSample
    ) -> Iterator[tuple[Leg, Mapping[str, float]]]:
        """Each point, and the positions before it; continuous joints the shorter way."""
        kinds, limits = self._profile.kinds, self._profile.limits
        before = known = _known(joints)
        bounds: dict[str, tuple[float, float]] = {}
        if kinds.continuous and limits is not None:
            pairs = zip(limits.lower.tolist(), limits.upper.tolist(), strict=True)
            bounds = dict(zip(self._profile.arm_joints, pairs, strict=True))
        for index, command in enumerate(commands):
            there = self._judged(command, known)
            if kinds.continuous:
                there = {
                    name: kinds.nearest(
                        name, before.get(name, target), target, *bounds.get(name, ())
                    )
                    for name, target in there.items()
                }
            leg = Leg(
                names=tuple(there),
                position=np.array(list(there.values())),
                duration_s=command.duration_s,
                where=f"points[{index}]: " if len(commands) > 1 else "",
            )
            yield leg, before
            before = {**before, **there}

    def _judged(self, command: JointCommand, known: Mapping[str, float]) -> dict[str, float]:
        """Targets of a command by joint, but for grippers that are not measured."""
        left_out = {gripper.joint for gripper in self._profile.grippers} - known.keys()
        targets = dict(zip(command.names, command.position.tolist(), strict=True))
        return {name: target for name, target in targets.items() if name not in left_out}

    def _is_hold(self, command: JointCommand) -> bool:
        """Whether a command goes to a posture that was measured lately: exactly, because a little
        more each time would lead anywhere.
        """
        recent = self._measured.copy()
        if not recent:
            return False
        newest_s, newest = recent[-1]
        asked = self._judged(command, _known(newest))
        for at_s, joints in recent:
            if at_s < newest_s - _HOLDS_S:
                continue
            known = dict(zip(joints.names, joints.position.tolist(), strict=False))
            if all(known.get(name) == place for name, place in asked.items()):
                return True
        return False

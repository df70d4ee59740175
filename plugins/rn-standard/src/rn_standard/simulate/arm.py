"""The arm of a twin, moved by control's own controller and limits."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from rn_standard.simulate.results import Survey
from rn_standard.simulate.twin import Twin
from roboneuron import (
    F64,
    ControlSpace,
    JointCommand,
    JointSample,
    Pose,
)
from roboneuron.gate.motion.path_limits import Leg
from roboneuron.tools.arm.prediction import ArmControl

_LOOK_S = 0.1
_HOLD_S = 0.05
"""Duration of control's command to hold; see `HoldingModule`."""
_STILL, _STILL_S = 5e-4, 0.1
"""As move_joints: a joint that moves by less [rad or m] in this time is at rest."""
_SETTLE_S = 3.0


class TooLongError(Exception):
    """The simulation has used up its time."""


class TwinArm:
    """Follows the protocol `RehearsedArm`; used from one thread. It has a twin, and no publisher.

    Attributes:
        held: why the newest row was not carried out.
        rule: the limit, or code of the controller, by which it was not; empty when it was.
        survey: what was seen on the way.
        passed_s: simulated time since the beginning [s].
        rested_s: how much of it came after the end of calls [s].
    """

    def __init__(
        self,
        twin: Twin,
        control: ArmControl,
        survey: Survey,
        end_s: float,
    ) -> None:
        """Args:
        twin: open.
        control: of the arm, and used by nobody else.
        survey: to be told of each posture.
        end_s: monotonic time by which the simulation has to be over [s].
        """
        self.held = self.rule = ""
        self.survey = survey
        self.passed_s = self.rested_s = 0.0
        self._twin, self._control, self._end_s = twin, control, end_s
        self._is_holding = False
        control.rest(twin.joints(), 0.0)
        self._look()

    def joints(self) -> JointSample:
        """What the twin measures."""
        return self._twin.joints()

    def poses(self) -> tuple[Pose, ...]:
        """TCP pose of each arm, of the joints that the twin measures. Raises UnsafeError."""
        return self._control.poses(self._twin.joints())

    def follow(self, space: ControlSpace, row: F64, step_s: float) -> None:
        """As `command`, and let its time pass. Raises TooLongError."""
        self.command(space, row, step_s)
        self.advance(step_s)

    def command(self, space: ControlSpace, row: F64, step_s: float) -> None:
        """Send what control makes of a row: the same controller, limits and holds."""
        joints = self._twin.joints()
        answered = self._control.answer(space, row, joints, self.passed_s, step_s)
        self.held = answered.held
        self.rule = answered.rules[-1] if answered.held and answered.rules else ""
        self.survey.limits.update(dict.fromkeys(answered.rules, 1))
        if answered.command is not None:
            self._is_holding = False
            self._twin.send(answered.command)
        elif not (answered.is_ignored or self._is_holding):
            self._is_holding = True
            self._hold(joints)

    def play(self, legs: Sequence[Leg]) -> bool:
        """Send a joint path as the robot module does, and wait until the joints rest; whether they
        are where it ends. Raises TooLongError.
        """
        target: dict[str, float] = {}
        for leg in legs:
            target |= dict(zip(leg.names, leg.position.tolist(), strict=True))
            if leg.duration_s:
                self._twin.send(
                    JointCommand(names=leg.names, position=leg.position, duration_s=leg.duration_s)
                )
                self.advance(leg.duration_s)
        before, end_s = self._of(target), self.passed_s + _SETTLE_S
        while self.passed_s < end_s:
            self.advance(_STILL_S)
            here = self._of(target)
            still = all(abs(here[name] - before[name]) <= _STILL for name in target)
            if still and self._is_there(target, here):
                return True
            before = here
        return self._is_there(target, before)

    def hold(self) -> None:
        """Hold the arm where it is measured, as control does when actions cease."""
        if not self._is_holding:
            self._is_holding = True
            self._hold(self._twin.joints())

    def settle(self) -> None:
        """Let the arm come to rest where it is. Raises TooLongError."""
        began_s = self.passed_s
        self._hold(self._twin.joints())
        self.advance(5 * _LOOK_S)
        self.rested_s += self.passed_s - began_s

    def advance(self, duration_s: float) -> None:
        """Let simulated time pass, and look. Raises TooLongError."""
        left_s = duration_s
        while left_s > 1e-9:
            if time.monotonic() > self._end_s:
                raise TooLongError
            part_s = min(left_s, _LOOK_S)
            self._twin.advance(part_s)
            left_s -= part_s
            self.passed_s += part_s
            self._look()

    def _look(self) -> None:
        joints = self._twin.joints()
        self.survey.look(joints, self._control.poses(joints), self.passed_s)

    def _hold(self, joints: JointSample) -> None:
        arm = self._control.profile.arm_joints
        here = dict(zip(joints.names, joints.position.tolist(), strict=True))
        position = np.array([here[name] for name in arm])
        self._twin.send(JointCommand(names=arm, position=position, duration_s=_HOLD_S))
        self._control.rest(joints, self.passed_s)

    def _of(self, target: dict[str, float]) -> dict[str, float]:
        joints = self._twin.joints()
        here = dict(zip(joints.names, joints.position.tolist(), strict=True))
        return {name: here[name] for name in target}

    def _is_there(self, target: dict[str, float], here: dict[str, float]) -> bool:
        return all(
            abs(here[name] - value) < self._control.profile.tolerance(name)
            for name, value in target.items()
        )

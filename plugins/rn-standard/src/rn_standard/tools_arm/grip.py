"""The gripper of an arm: the opening that was last commanded, by whomever, and whether the hand
holds something.
"""

from __future__ import annotations

import time

from roboneuron import GripperProfile, Host, NotReadyError
from roboneuron.feature import ExposedEndpoint, MotionGate, Report

_MEASURED_S = 2.0
_BLOCKED = 0.03
"""Share of the travel: fingers that rest this much wider than commanded are blocked by something.
"""
_STILL, _STILL_S = 0.005, 0.06
"""Fingers that move by less than this share of their travel in this time are at rest."""
_SETTLE_S = 1.0
_POLL_S = 0.02


class Grip:
    """What a gripper was told and what came of it; usable from any thread.

    The robot module reports the opening that was last commanded, whether a policy, a task or a
    direct call did it.
    """

    def __init__(
        self, host: Host, gate: MotionGate, exposed: ExposedEndpoint, arm: str = ""
    ) -> None:
        """Args:
        host, gate: of the feature.
        exposed: an endpoint of the robot.
        arm: name of one of several arms; "" for the only one.
        """
        self._host = host
        self._gate = gate
        self._exposed = exposed
        self.arm = arm

    @property
    def profile(self) -> GripperProfile | None:
        """The gripper of the arm; None without one."""
        profile = self._exposed.profile
        arms = () if profile is None else profile.each_arm
        return next((arm.gripper for arm in arms if arm.name == self.arm), None)

    def commanded(self) -> float | None:
        """The opening that was last commanded, 0 closed .. 1 open; None when none was since the
        robot started.
        """
        report = self._report()
        return None if report is None else report.gripper_commanded_of(self.arm)

    def kept(self) -> float:
        """The opening that keeps what the hand holds: as last commanded, else as measured; 1
        without a gripper.

        Raises:
            NotReadyError: the gripper is not measured.
        """
        if self.profile is None:
            return 1.0
        opening = self.commanded()
        return self.measured() if opening is None else opening

    def measured(self) -> float:
        """The measured opening. Raises NotReadyError."""
        gripper = self.profile
        joints = self._gate.joints(self._exposed, _MEASURED_S)
        if gripper is None or joints is None or gripper.joint not in joints.names:
            raise NotReadyError(
                "The gripper was not measured.", hint="Is the robot running? See get_status."
            )
        return gripper.to_opening(float(joints.position[joints.names.index(gripper.joint)]))

    def holding(self) -> bool | None:
        """Whether the hand holds something; None when that is unknown.

        The driver says so itself, or fingers rest wider than they were told. Waits up to a second
        for their rest.
        """
        report = self._report()
        key = f"{self.arm}/holding" if self.arm else "holding"
        told = "" if report is None else report.detail.get(key, "")
        if told:
            return told == "true"
        opening = self.commanded()
        if self.profile is None or opening is None:
            return None
        try:
            return self._is_blocked(opening)
        except NotReadyError:
            return None

    def _is_blocked(self, commanded: float) -> bool | None:
        """Whether the fingers rest wider than commanded; None when they do not come to rest."""
        began_s = since_s = time.monotonic()
        rested = self.measured()
        while True:
            now_s, opening = time.monotonic(), self.measured()
            if opening - commanded <= _BLOCKED:
                return False
            if abs(opening - rested) > _STILL:
                rested, since_s = opening, now_s
            if now_s - since_s >= _STILL_S:
                return True
            if now_s - began_s > _SETTLE_S:
                return None
            time.sleep(_POLL_S)

    def _report(self) -> Report | None:
        """What the module of this very robot reports."""
        if self._exposed.namespace != self._host.config.namespace:
            return None
        return self._host.modules.view("robot").report


def is_lost(
    before: bool | None, after: bool | None, asked: float | None, kept: float | None
) -> bool:
    """Whether a motion lost what the hand held: held before, not after, and nobody asked for a
    wider opening.
    """
    is_opened = asked is not None and (kept is None or asked > kept)
    return bool(before) and after is False and not is_opened

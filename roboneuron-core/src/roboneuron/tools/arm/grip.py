"""Gripper of an arm: the last commanded opening, from any source, and detection of a held
object.
"""

from __future__ import annotations

import time

from roboneuron.contract import GripperProfile, JointSample, RobotProfile
from roboneuron.errors import NotReadyError, RefusedError
from roboneuron.modules.report import Report
from roboneuron.server.host import Host
from roboneuron.server.motion_gate import ExposedEndpoint, MotionGate
from roboneuron.tools.arm.grip_reports import commanded_opening
from roboneuron.tools.arm.joint_rest import measured_ns

__all__ = ["check_gripper"]
"""Names that other distributions may use."""

_MEASURED_S = 2.0
_BLOCKED = 0.03
"""Fraction of the travel: fingers at rest this much wider than commanded are blocked by an
object.
"""
_STILL, _STILL_NS = 0.005, 60_000_000
"""Fingers that move by less than this fraction of their travel in this time are at rest."""
_SETTLE_S = 1.0
_POLL_S = 0.02


class Grip:
    """Commanded and measured state of a gripper; usable from any thread.

    The robot module reports the last commanded opening, whether it came from a policy, a task or a
    direct call.
    """

    def __init__(
        self, host: Host, gate: MotionGate, exposed: ExposedEndpoint, arm: str = ""
    ) -> None:
        """Args:
        host, gate: host of the feature, and the gate.
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
        return _gripper_of(self._exposed.profile, self.arm)

    def commanded(self) -> float | None:
        """The last commanded opening, 0 closed .. 1 open; None if there was none since the robot
        started.
        """
        report = self._report()
        return None if report is None else commanded_opening(report, self.arm)

    def kept(self) -> float:
        """Opening that keeps the grasp: as last commanded, else as measured; 1 without a gripper,
        where nothing follows it.

        Raises:
            NotReadyError: the gripper is not measured.
        """
        if self.is_missing:
            return 1.0
        opening = self.commanded()
        return self.measured() if opening is None else opening

    @property
    def is_missing(self) -> bool:
        """The arm has no gripper: by its profile, or because its driver reports that it drives
        none.
        """
        return _is_missing(self._exposed.profile, self._report(), self.arm)

    def check_fitted(self) -> None:
        """Raise RefusedError for an arm without a gripper."""
        if self.is_missing:
            raise _no_gripper(self.arm)

    def measured(self) -> float:
        """The measured opening. Raises NotReadyError."""
        return self._measure()[0]

    def _measure(self) -> tuple[float, int]:
        """The opening, and the time of its measurement [ns]. Raises NotReadyError."""
        gripper = self.profile
        joints = self._gate.joints(self._exposed, _MEASURED_S)
        opening = None if gripper is None else gripper.opening_in(joints)
        if joints is None or opening is None:
            raise NotReadyError(
                "The gripper was not measured.", hint="Is the robot running? See get_status."
            )
        return opening, measured_ns(joints, time.monotonic())

    def holding(self) -> bool | None:
        """True if the hand holds an object; None if unknown.

        Either the driver reports it, or the fingers rest wider than commanded. Waits up to a second
        for them to rest.
        """
        if self.is_missing:
            return None
        if told := self._detail("holding"):
            return told == "true"
        opening = self.commanded()
        if opening is None:
            return None
        try:
            return self._is_blocked(opening)
        except NotReadyError:
            return None

    def _is_blocked(self, commanded: float) -> bool | None:
        """True if the fingers rest wider than commanded; None if they do not come to rest."""
        began_s = time.monotonic()
        rested, since_ns = self._measure()
        while True:
            opening, at_ns = self._measure()
            if not is_blocked(opening, commanded):
                return False
            if abs(opening - rested) > _STILL:
                rested, since_ns = opening, at_ns
            if at_ns - since_ns >= _STILL_NS:
                return True
            if time.monotonic() - began_s > _SETTLE_S:
                return None
            time.sleep(_POLL_S)

    def would_hold(self, joints: JointSample, commanded: float) -> bool:
        """True if the fingers of a twin with these joints are kept from a commanded opening."""
        opening = None if self.profile is None else self.profile.opening_in(joints)
        return opening is not None and is_blocked(opening, commanded)

    def _detail(self, name: str) -> str:
        """A fact of the driver on this arm; empty if it reports none."""
        return _detail(self._report(), self.arm, name)

    def _report(self) -> Report | None:
        """Report of the module of this robot."""
        if self._exposed.namespace != self._host.config.namespace:
            return None
        return self._host.modules.view("robot").report


def check_gripper(host: Host, profile: RobotProfile | None, arm: str) -> None:
    """Raise RefusedError for an arm of the present robot that has no gripper, by its profile or by
    what its driver reports.

    Args:
        host: of the feature.
        profile: of the robot.
        arm: name of one of several arms; "" for the only or first one.
    """
    arms = () if profile is None else profile.arms
    named = arm or (arms[0].name if arms else "")
    if _is_missing(profile, host.modules.view("robot").report, named):
        raise _no_gripper(arm)


def _gripper_of(profile: RobotProfile | None, arm: str) -> GripperProfile | None:
    arms = () if profile is None else profile.each_arm
    return next((one.gripper for one in arms if one.name == arm), None)


def _detail(report: Report | None, arm: str, name: str) -> str:
    key = f"{arm}/{name}" if arm else name
    return "" if report is None else report.detail.get(key, "")


def _is_missing(profile: RobotProfile | None, report: Report | None, arm: str) -> bool:
    return _gripper_of(profile, arm) is None or _detail(report, arm, "no_gripper") == "true"


def _no_gripper(arm: str) -> RefusedError:
    subject = f"The arm {arm!r}" if arm else "This robot"
    return RefusedError(
        f"{subject} has no gripper.",
        hint="Move the arm without it; if it has one, its driver has to be told by its options.",
        rule="no_gripper",
    )


def is_blocked(opening: float, commanded: float) -> bool:
    """True if fingers at rest at this opening are kept from the commanded one."""
    return opening - commanded > _BLOCKED


def is_lost(
    before: bool | None, after: bool | None, asked: float | None, kept: float | None
) -> bool:
    """True if a motion lost the held object: held before, not after, and no wider opening was
    commanded.
    """
    is_opened = asked is not None and (kept is None or asked > kept)
    return bool(before) and after is False and not is_opened

"""Reports of the robot module on grippers: commanded and measured openings.

Fingers around an object measure another opening than the commanded one.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from roboneuron.contract import JointCommand, RobotProfile, RobotState

if TYPE_CHECKING:
    from collections.abc import Callable

    from roboneuron.modules.module_host import Module, ModuleHost
    from roboneuron.modules.report import Report
    from roboneuron.modules.status import StatusWriter

COMMANDED = "gripper_commanded"
"""Metric: the last commanded opening, 0 closed .. 1 open, from any source."""
OPEN = "gripper_open"
"""Metric: the measured opening, 0 closed .. 1 open."""
_CHANGE = 0.02
"""Least change of the commanded opening that is reported at once."""


@runtime_checkable
class ReportingRobot(Protocol):
    """Used parts of the robot module."""

    profile: RobotProfile
    status: StatusWriter
    on_sent: list[Callable[[JointCommand], None]]
    on_state: list[Callable[[RobotState | None], None]]


def join(host: ModuleHost) -> None:
    """Called in every module process; see `FeatureSpec.on_join`."""
    if host.settings.kind == "robot":
        host.on_configured.append(_extend)


def _extend(module: Module) -> None:
    if isinstance(module, ReportingRobot):
        reports = GripReports(module.profile, module.status)
        module.on_sent.append(reports.note_sent)
        module.on_state.append(reports.note_state)


def commanded_opening(report: Report, arm: str) -> float | None:
    """The last commanded opening, 0 closed .. 1 open; None if there was none since the robot
    started.

    Args:
        report: report of the robot module.
        arm: name of one of several arms; "" for the only one.
    """
    try:
        opening = float(report.metrics.get(_metric(COMMANDED, arm), ""))
    except ValueError:
        return None
    return opening if math.isfinite(opening) else None


class GripReports:
    """Reports the openings of each arm's gripper; each method is called on one thread."""

    def __init__(self, profile: RobotProfile, status: StatusWriter) -> None:
        self._status = status
        self._grippers = {
            arm.name: arm.gripper for arm in profile.each_arm if arm.gripper is not None
        }
        self._has_several_arms = bool(profile.arms)
        self._openings: dict[str, float] = {}

    def note_sent(self, sent: JointCommand) -> None:
        """Report the commanded openings; a command without a gripper's joint leaves its opening
        unchanged.
        """
        for arm, gripper in self._grippers.items():
            opening = gripper.opening_in(sent)
            if opening is None:
                continue
            self._status.set_value(_metric(COMMANDED, arm), opening)
            if abs(opening - self._openings.get(arm, -1.0)) > _CHANGE:
                self._openings[arm] = opening
                self._status.changed.set()

    def note_state(self, state: RobotState | None) -> None:
        """Report the measured opening of each gripper: from the driver, or for several arms from
        their joints; nothing while the robot cannot be read.
        """
        arms = tuple(self._grippers) if self._has_several_arms else ("",)
        if state is None:
            self._status.forget_details(*(_metric(OPEN, arm) for arm in arms))
            return
        for arm in arms:
            opening = state.gripper_open
            if self._has_several_arms:
                opening = self._grippers[arm].opening_in(state.joints)
            if opening is not None:
                self._status.set_value(_metric(OPEN, arm), float(opening))


def _metric(name: str, arm: str) -> str:
    """Such as "left/gripper_open"; the plain name for the only arm."""
    return f"{arm}/{name}" if arm else name

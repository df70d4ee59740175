"""Which inputs are this module's, where a feature replaces running modules by others."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import cast

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from roboneuron.contract import ActionChunk, Hold, JointCommand, Pose
from roboneuron.modules.settings import ModuleSettings
from roboneuron.modules.status import ModuleStatus
from roboneuron.plugins.loading import load_attribute

log = logging.getLogger(__name__)


class Handover:
    """What a module asks about its inputs; the answers here are those of a module that nobody replaces.

    A feature names its own class in `Supervisor.handover`; it decides and compares, and has no access to ROS. Inputs
    are told apart by their time stamps [ROS time, ns]: capture times of images, times at which actions were sent and
    joints measured. Methods are called from any of the module's threads.

    Args:
        shadow: the module was started beside a running one.
        status: where to report.

    Attributes:
        moments: integer parameters of the node and their first values; `set` is told of every change.
    """

    moments: Mapping[str, int] = MappingProxyType({})

    def __init__(self, shadow: bool, status: ModuleStatus) -> None:
        self.status = status

    def set(self, moments: Mapping[str, int]) -> None:
        """Take over new values, each 0 or more."""

    def begin(self) -> None:
        """The module is configured."""

    def is_shadow(self, stamp_ns: int) -> bool:
        """Whether that input is still the predecessor's: work on it, and send nothing."""
        return False

    def is_over(self, stamp_ns: int) -> bool:
        """Whether that input is already the successor's."""
        return False

    def is_ours(self, stamp_ns: int) -> bool:
        """Whether this module is to act on that input."""
        return not self.is_shadow(stamp_ns) and not self.is_over(stamp_ns)

    def may_send(self, now_ns: int) -> bool:
        """Whether the predecessor has finished, so that this module may send its own."""
        return True

    def must_fall_silent(self, now_ns: int) -> bool:
        """Whether the successor replaces what is left of a chunk."""
        return False

    def withhold(self, output: ActionChunk | JointCommand | Hold | Pose) -> None:
        """What the module would have sent for an input of the predecessor."""

    def hear(self, output: JointCommand | Pose, sent_s: float) -> None:
        """What the predecessor has sent, and when [monotonic s]; called in shadow."""

    def note_sent(self, what: str) -> None:
        """An output of that name has gone out."""


def load_handover(node: Node, settings: ModuleSettings, status: ModuleStatus) -> Handover:
    """Build the class that the settings name, and declare its parameters on `node`; logs when it cannot be had."""
    target = Handover
    if settings.handover is not None:
        try:
            target = cast("type[Handover]", load_attribute(settings.handover, "handover of a feature"))
        except Exception:  # the border to a feature's own code; under another interpreter it may not be installed
            log.exception("This module cannot be replaced while it runs.")
    handover = target(settings.shadow, status)

    def check(parameters: Sequence[Parameter]) -> SetParametersResult:
        wrong = [p for p in parameters if p.name in handover.moments and not _is_moment(p)]
        reason = f"{wrong[0].name} must be a ROS time in nanoseconds" if wrong else ""
        return SetParametersResult(successful=not wrong, reason=reason)

    def take(parameters: Sequence[Parameter]) -> None:
        handover.set({p.name: int(p.value) for p in parameters if p.name in handover.moments})

    node.add_on_set_parameters_callback(cast(Callable[..., SetParametersResult], check))
    node.add_post_set_parameters_callback(take)
    for name, value_ns in handover.moments.items():
        node.declare_parameter(name, value_ns)
    return handover


def _is_moment(parameter: Parameter) -> bool:
    return parameter.type_ is Parameter.Type.INTEGER and parameter.value >= 0

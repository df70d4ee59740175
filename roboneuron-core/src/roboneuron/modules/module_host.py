"""What a module process lends to features, how they join it, and what they may answer in its
place.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, Protocol, cast

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from roboneuron.contract import ActionChunk, Hold, JointCommand, Pose
from roboneuron.modules.execution import Bounds, ChunkExecutor
from roboneuron.modules.settings import ModuleSettings
from roboneuron.modules.status import StatusWriter
from roboneuron.plugins.loading import load_attribute
from roboneuron.plugins.specs import BackendSpec

if TYPE_CHECKING:
    from roboneuron.modules.module import Module

log = logging.getLogger(__name__)


class Handover:
    """What a module asks about its inputs; the answers here are those of a module that nobody
    replaces.

    A feature puts its own into the module's process (`ModuleHost.handover`). Inputs are told apart
    by their time stamps [ROS time, ns]: capture times of images, times at which actions were sent
    and joints measured. Methods are called from any of the module's threads.

    Attributes:
        not_before_ns: images captured before it are not predicted on, not even in shadow.
    """

    not_before_ns = 0

    def __init__(self, status: StatusWriter) -> None:
        """Args:
        status: where to report.
        """
        self.status = status

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

    def note_sent(self, what: str) -> None:
        """An output of that name has gone out."""


class ModuleHost(Protocol):
    """What a module process lends to features (`FeatureSpec.on_join`): the part of ModuleNode that
    publishes nothing.

    Attributes:
        settings: what the process was told.
        status: where to report.
        resources: what is released at cleanup, from `configure` on.
        handover: which inputs are this module's; a feature that replaces modules puts its own
            object here.
        make_executor: how an inference module gets what executes its chunks; see `make_sequential`.
        on_configured: called with the module at the end of every `configure`, which fails if one
            raises.
    """

    settings: ModuleSettings
    status: StatusWriter
    resources: ExitStack
    handover: Handover
    make_executor: Callable[[BackendSpec, str, Bounds], ChunkExecutor]
    on_configured: list[Callable[[Module], None]]

    def add_parameter(
        self,
        name: str,
        value: str | int,
        take: Callable[[Any], None],
        refuse: Callable[[Any], str] = lambda _: "",
    ) -> Callable[[], None]:
        """Declare a ROS parameter, which only the server of this module can set; call what is
        returned to remove it.

        Args:
            name: of the parameter.
            value: the first one; ROS refuses values of other types.
            take: called with each later value, on the executor's thread.
            refuse: says what is wrong with a value; empty for nothing.
        """
        ...

    def require_start(self, reason: str) -> None:
        """A stop has come, such as a recovery: nothing moves before somebody asks for it anew. From
        any thread.
        """
        ...


def join(host: ModuleHost, reference: str) -> None:
    """Call what a feature wants called in every module process, "module:attribute"; a failure is
    logged.
    """
    try:
        cast("Callable[[ModuleHost], None]", load_attribute(reference, "`on_join` of a feature"))(
            host
        )
    except (
        Exception
    ):  # the border to a feature's own code; under another interpreter it may not be installed
        log.exception("%s cannot be used in this module.", reference)


def add_parameter(
    node: Node,
    name: str,
    value: str | int,
    take: Callable[[Any], None],
    refuse: Callable[[Any], str] = lambda _: "",
) -> Callable[[], None]:
    """See `ModuleHost.add_parameter`; a method of ModuleNode."""

    def check(parameters: list[Parameter]) -> SetParametersResult:
        reason = next((r for p in parameters if p.name == name and (r := refuse(p.value))), "")
        return SetParametersResult(successful=not reason, reason=reason)

    def take_all(parameters: list[Parameter]) -> None:
        for parameter in parameters:
            if parameter.name == name:
                take(parameter.value)

    def remove() -> None:
        node.remove_on_set_parameters_callback(check)
        node.remove_post_set_parameters_callback(take_all)
        node.undeclare_parameter(name)

    node.declare_parameter(name, value)
    node.add_on_set_parameters_callback(check)
    node.add_post_set_parameters_callback(take_all)
    return remove

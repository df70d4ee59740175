"""What a module process lends to features, and how they join it."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, Protocol, cast

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from roboneuron.modules.execution import Bounds, ChunkExecutor
from roboneuron.modules.handover import Handover
from roboneuron.modules.settings import ModuleSettings
from roboneuron.modules.status import ModuleStatus
from roboneuron.plugins.loading import load_attribute
from roboneuron.plugins.specs import BackendSpec

if TYPE_CHECKING:
    from roboneuron.modules.module import Module

log = logging.getLogger(__name__)


class ModuleHost(Protocol):
    """What a module process lends to features (`FeatureSpec.on_join`): the part of ModuleNode that publishes nothing.

    Attributes:
        settings: what the process was told.
        status: where to report.
        resources: what is released at cleanup, from `configure` on.
        handover: which inputs are this module's; a feature that replaces modules puts its own object here.
        make_executor: how an inference module gets what executes its chunks; see `make_sequential`.
        on_configured: called with the module at the end of every `configure`, which fails if one raises.
    """

    settings: ModuleSettings
    status: ModuleStatus
    resources: ExitStack
    handover: Handover
    make_executor: Callable[[BackendSpec, str, Bounds], ChunkExecutor]
    on_configured: list[Callable[[Module], None]]

    def add_parameter(
        self, name: str, value: str | int, take: Callable[[Any], None], refuse: Callable[[Any], str] = lambda _: ""
    ) -> Callable[[], None]:
        """Declare a ROS parameter, which only the server of this module can set; call what is returned to remove it.

        Args:
            name: of the parameter.
            value: the first one; ROS refuses values of other types.
            take: called with each later value, on the executor's thread.
            refuse: says what is wrong with a value; empty for nothing.
        """
        ...


def join(host: ModuleHost, reference: str) -> None:
    """Call what a feature wants called in every module process, "module:attribute"; a failure is logged."""
    try:
        cast("Callable[[ModuleHost], None]", load_attribute(reference, "`on_join` of a feature"))(host)
    except Exception:  # the border to a feature's own code; under another interpreter it may not be installed
        log.exception("%s cannot be used in this module.", reference)


def add_parameter(
    node: Node, name: str, value: str | int, take: Callable[[Any], None], refuse: Callable[[Any], str]
) -> Callable[[], None]:
    """Do on a node what `ModuleHost.add_parameter` says."""

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

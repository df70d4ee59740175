"""Compatibility check of a controller with the robot, from descriptors alone."""

from __future__ import annotations

from roboneuron.config.models import Config
from roboneuron.errors import PlanningError
from roboneuron.planning import Plan, find_robot
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import ControllerSpec, RobotSpec

__all__ = ["find_controller"]
"""Names that other distributions may use."""


def plan_control(config: Config, registry: Registry) -> Plan:
    """Plan the module of `[control]`.

    Raises:
        ConfigurationError: a name is not installed or unusable.
        PlanningError: the controller does not support this robot.
    """
    section = config.control
    assert section is not None
    robot, driver = find_robot(
        registry,
        config.robot.name,
        config.robot.driver,
        is_elsewhere=config.robot.python is not None,
    )
    is_elsewhere = section.python is not None
    spec = find_controller(registry, section.controller, robot, is_elsewhere=is_elsewhere)
    return Plan(
        kind="control",
        config=config,
        robot=robot,
        driver=driver,
        spec=spec,
        names={"controller": spec.name},
        inputs=("robot",),
    )


def find_controller(
    registry: Registry, name: str, robot: RobotSpec, *, is_elsewhere: bool = False
) -> ControllerSpec:
    """Return the controller of that name.

    Raises:
        ConfigurationError: it is not installed or unusable.
        PlanningError: it does not move robots of that kind.
    """
    controller = registry.get(ControllerSpec, name, elsewhere=is_elsewhere)
    if robot.robot_kind not in controller.robot_kinds:
        kinds = ", ".join(controller.robot_kinds) or "none"
        raise PlanningError(
            f"Controller {name!r} moves robots of kind {kinds}, but {robot.name!r} is of kind "
            f"{robot.robot_kind!r}."
        )
    return controller

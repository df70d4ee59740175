"""Compatibility check of an image source with the robot and its driver, from descriptors alone."""

from __future__ import annotations

from collections.abc import Iterable

from roboneuron.config.models import Config
from roboneuron.errors import InvalidInputError, PlanningError
from roboneuron.planning import Plan, find_robot
from roboneuron.plugins.registry import Registry
from roboneuron.plugins.specs import PerceptionSpec


def plan_perception(config: Config, registry: Registry) -> Plan:
    """Plan the module of `[perception]`.

    Raises:
        ConfigurationError: a name is not installed or unusable.
        PlanningError: the source does not support this robot, or this driver.
        InvalidInputError: the robot has no such camera.
    """
    section = config.perception
    assert section is not None
    robot, driver = find_robot(
        registry,
        config.robot.name,
        config.robot.driver,
        is_elsewhere=config.robot.python is not None,
    )
    source = registry.get(PerceptionSpec, section.source, elsewhere=section.python is not None)
    if source.robots and robot.name not in source.robots:
        raise PlanningError(
            f"Perception {source.name!r} serves only the robots {_listed(source.robots)}, "
            f"not {robot.name!r}."
        )
    if source.drivers and driver.name not in source.drivers:
        raise PlanningError(
            f"Perception {source.name!r} works only with the drivers {_listed(source.drivers)}, "
            f"not with {driver.name!r} of robot {robot.name!r}."
        )
    known = [camera.name for camera in robot.cameras]
    for camera in section.cameras:
        if camera not in known:
            raise InvalidInputError(
                f"Robot {robot.name!r} has no camera {camera!r}.",
                hint=f"Its cameras: {_listed(known)}.",
            )
    return Plan(
        kind="perception",
        config=config,
        robot=robot,
        driver=driver,
        spec=source,
        names={"source": source.name, "cameras": ", ".join(section.cameras or known)},
        inputs=("robot",) if source.drivers else (),
    )


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names) or "none"

"""The twin of a cell: what it has to do, and where it comes from."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from roboneuron import (
    DriverSpec,
    Host,
    JointCommand,
    JointSample,
    NotReadyError,
    RobotSpec,
)

_SCENE_S = 1.0


@runtime_checkable
class Twin(Protocol):
    """A world beside the robot's own, in which time passes when it is told to; from one thread.

    Attributes:
        scene_topic, scene_type: where the simulated cell tells where its objects are.
    """

    scene_topic: str
    scene_type: type[object]

    def open(self, joints: JointSample, scene: object = None) -> None:
        """Build it, the joints at rest where they are measured; without a scene no objects. Raises
        RoboNeuronError.
        """

    def send(self, command: JointCommand) -> None:
        """Move towards a command, as the driver does. Raises InvalidInputError."""

    def advance(self, duration_s: float) -> None:
        """Let simulated time pass [s]."""

    def joints(self) -> JointSample:
        """What is measured now."""

    def moved(self) -> tuple[str, ...]:
        """Objects that are not where they were."""

    def picture(self, camera: str, width: int, height: int) -> NDArray[np.uint8]:
        """What a camera sees, uint8 (height, width, 3) RGB. Raises InvalidInputError."""

    def close(self) -> None:
        """Release it; may be called twice."""


@runtime_checkable
class HasTwin(Protocol):
    """A simulated driver with a twin of its cell."""

    def twin(self) -> Twin:
        """A new one; the driver itself is not open."""


def driver_of(host: Host) -> tuple[DriverSpec, Mapping[str, object]]:
    """The simulated driver of the present robot, and its options. Raises NotReadyError."""
    robot = host.config.robot
    spec = host.registry.get(RobotSpec, robot.name)
    driver = next((one for one in spec.drivers if one.simulated), None)
    if driver is None:
        raise NotReadyError(
            f"There is no simulated twin of {robot.name!r}: the way cannot be simulated.",
            hint="move_ee and move_joints answer simulate=true by the limits alone.",
        )
    configured = spec.driver(robot.driver)
    # the options of a real driver are not those of the simulated one
    is_same = configured is not None and configured.config == driver.config
    return driver, host.config.options(robot.name) if is_same else {}


def has_twin(host: Host) -> bool:
    """Whether the present robot has a simulated driver."""
    spec = host.registry.get(RobotSpec, host.config.robot.name)
    return any(driver.simulated for driver in spec.drivers)


def scene_of(host: Host, twin: Twin) -> object | None:
    """The newest scene of a simulated cell; None where none is told, as of a real one.

    The topic is the simulation's own, and not for clients: what they get of it is with what the arm
    would collide, and a picture.
    """
    robot = host.config.robot
    driver = host.registry.get(RobotSpec, robot.name).driver(robot.driver)
    is_running = host.modules.view("robot").phase == "running"
    if driver is None or not driver.simulated or not is_running:
        return None
    _ = host.graph  # first: two threads must not import rclpy at the same time
    arrived, found = threading.Event(), list[object]()

    def take(message: object) -> None:
        found.append(message)
        arrived.set()

    unsubscribe = host.subscribe(twin.scene_type, twin.scene_topic, take)
    try:
        arrived.wait(_SCENE_S)
    finally:
        unsubscribe()
    return found[-1] if found else None

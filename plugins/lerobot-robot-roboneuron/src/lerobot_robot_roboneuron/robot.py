"""The robot `roboneuron` of LeRobot."""

from __future__ import annotations

import logging
import ssl  # noqa: F401  before rclpy: both bring a libcrypto
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from lerobot.robots import Robot
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from lerobot_robot_roboneuron.config_roboneuron import RoboNeuronConfig
from lerobot_robot_roboneuron.serve import OwnServer
from rn_robot_lerobot.units import motors_of
from roboneuron import CameraProfile, ConfigurationError, RobotProfile, robot_space
from roboneuron.command import discover, environment
from roboneuron.feature import load_profile

if TYPE_CHECKING:
    from lerobot_robot_roboneuron.topics import RobotTopics

log = logging.getLogger(__name__)


class RoboNeuron(Robot):
    """Any arm of RoboNeuron: joints and images arrive over ROS, actions pass control's limits and
    stops.

    Attributes:
        cameras: cameras of the robot's profile, by name in the data set.
    """

    config_class = RoboNeuronConfig
    name = "roboneuron"

    def __init__(self, config: RoboNeuronConfig) -> None:
        """Read the robot's profile.

        Raises:
            ConfigurationError: no installed plugin provides the robot, or it has no such camera.
            InvalidInputError: it has no arm.
        """
        super().__init__(config)
        self.config = config
        self.profile: RobotProfile = load_profile(discover(), config.robot)
        self.cameras: dict[str, CameraProfile] = _chosen_cameras(config, self.profile)
        self._motors = motors_of(self.profile, use_degrees=config.use_degrees)
        self._space = robot_space("joint_position", self.profile)
        self._server: OwnServer | None = None
        self._topics: RobotTopics | None = None
        self._is_held = False

    @cached_property
    def observation_features(self) -> dict[str, type | tuple[int, int, int]]:
        """Joints by `<name>.pos`, images by their names as (height, width, 3)."""
        return {**self.action_features, **self._image_features}

    @cached_property
    def action_features(self) -> dict[str, type]:
        """Joints by `<name>.pos`."""
        return dict.fromkeys(self._motors.keys, float)

    @property
    def _image_features(self) -> dict[str, tuple[int, int, int]]:
        height, width = self.config.height, self.config.width
        return {
            name: (height or camera.height, width or camera.width, 3)
            for name, camera in self.cameras.items()
        }

    @property
    def is_connected(self) -> bool:
        """True if the topics are subscribed."""
        return self._topics is not None

    @property
    def is_calibrated(self) -> bool:
        """Always True: calibration belongs to the robot's driver."""
        return True

    def calibrate(self) -> None:
        """Nothing to do, see `is_calibrated`."""

    def configure(self) -> None:
        """Nothing to do: RoboNeuron's own configuration covers it."""

    def connect(self, calibrate: bool = True) -> None:
        """Start the server if one is configured, and return once states and images arrive and
        control accepts actions.

        Raises:
            NotReadyError, ConfigurationError, StateError, RefusedError: as `RobotTopics.open` and
                `OwnServer.start`; nothing moves.
        """
        if self._topics is not None:
            raise DeviceAlreadyConnectedError(f"{self} is connected already.")
        environment.prepare_environment()
        # heavy: rclpy, which needs the environment
        from lerobot_robot_roboneuron.topics import RobotTopics

        config = self.config
        namespace = config.namespace or config.robot.replace("-", "_")
        named = {name: camera.name for name, camera in self.cameras.items()}
        if config.serve:
            self._server = OwnServer(config.serve, with_perception=bool(self.cameras))
            self._server.start(config.start_timeout_s)
        robot = RobotTopics(namespace, self._space, named)
        try:
            robot.open(config.start_timeout_s)
            for name, (height, width, _) in self._image_features.items():
                size = robot.image_size(name)
                if size != (height, width):
                    robot.close()
                    raise ConfigurationError(
                        f"Camera {named[name]!r} sends {size[1]}x{size[0]}, expected "
                        f"{width}x{height}.",
                        hint=f"Say --robot.width={size[1]} --robot.height={size[0]}.",
                    )
        except BaseException:
            self._end_server()
            raise
        self._topics = robot

    def get_observation(self) -> dict[str, float | np.ndarray]:
        """Newest joints and images. Raises NotReadyError if one is too old, or not measured."""
        topics, config = self._connected(), self.config
        values = self._motors.measured_values(topics.joints(config.state_timeout_s))
        images = {name: topics.image(name, config.image_timeout_s) for name in self.cameras}
        return {**values, **images}

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        """Send positions; returns the limited command that control sent to the arm, or the measured
        positions if control holds.

        Raises:
            InvalidInputError, UnsafeError: unknown, missing or invalid values; nothing is sent.
                UnsafeError, RefusedError, NotReadyError, ConfigurationError: as `RobotTopics.send`.
        """
        topics = self._connected()
        positions = self._motors.positions({key: float(value) for key, value in action.items()})
        row = self._row(dict(zip(self._motors.joints, positions.tolist(), strict=True)))
        sent = topics.send(row, self.config.answer_timeout_s)
        measured = topics.joints(self.config.state_timeout_s)
        reason = "" if sent is not None else topics.why_held()
        if reason and not self._is_held:
            log.warning("The arm does not follow: %s", reason)
        self._is_held = bool(reason)
        return self._motors.measured_values(measured | (sent or {}))

    def disconnect(self) -> None:
        """Disconnect: control holds the arm within its timeout. A server started by `connect` is
        stopped.
        """
        topics = self._connected()
        self._topics = None
        topics.close()
        self._end_server()

    def _connected(self) -> RobotTopics:
        if self._topics is None:
            raise DeviceNotConnectedError(f"{self} is not connected.")
        return self._topics

    def _end_server(self) -> None:
        server, self._server = self._server, None
        if server is not None:
            server.stop()

    def _row(self, positions: dict[str, float]) -> np.ndarray:
        """The action in the robot's joint space, float64 (n,)."""
        row = []
        for arm in self.profile.each_arm:
            row += [positions[joint] for joint in arm.joints]
            if arm.gripper is not None:
                row.append(arm.gripper.to_opening(positions[arm.gripper.joint]))
        return np.array(row)


def _chosen_cameras(config: RoboNeuronConfig, profile: RobotProfile) -> dict[str, CameraProfile]:
    """Cameras by name in the data set. Raises ConfigurationError for one that the robot lacks."""
    if not config.perception:
        return {}
    known = {camera.name: camera for camera in profile.cameras}
    chosen = config.images or {name: name for name in known}
    unknown = [camera for camera in chosen if camera not in known]
    if unknown:
        raise ConfigurationError(
            f"Robot {profile.name!r} has no camera {unknown[0]!r}; it has "
            f"{', '.join(known) or 'none'}."
        )
    return {name: known[camera] for camera, name in chosen.items()}

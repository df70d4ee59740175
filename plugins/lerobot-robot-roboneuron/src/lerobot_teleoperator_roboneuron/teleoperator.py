"""The teleoperator `roboneuron` of LeRobot."""

from __future__ import annotations

import ssl  # noqa: F401  before rclpy: both bring a libcrypto
import time
from typing import Any

from lerobot.teleoperators import Teleoperator
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from lerobot_teleoperator_roboneuron.config_roboneuron_teleop import RoboNeuronTeleopConfig
from lerobot_teleoperator_roboneuron.leaders import TopicLeader
from rn_robot_lerobot.units import motors_of
from roboneuron import InvalidInputError, NotReadyError, RobotProfile
from roboneuron.command import discover
from roboneuron.feature import load_profile


class RoboNeuronTeleop(Teleoperator):
    """Follows the joint states of a leader: an arm, a program or another robot."""

    config_class = RoboNeuronTeleopConfig
    name = "roboneuron"

    def __init__(self, config: RoboNeuronTeleopConfig) -> None:
        """Read the robot's profile.

        Raises:
            ConfigurationError: no installed plugin provides the robot.
        """
        super().__init__(config)
        self.config = config
        profile: RobotProfile = load_profile(discover(), config.robot)
        self._motors = motors_of(profile, use_degrees=config.use_degrees)
        self._leader = TopicLeader(config.topic)
        self._is_connected = False

    @property
    def action_features(self) -> dict[str, type]:
        """The same as the robot's."""
        return dict.fromkeys(self._motors.keys, float)

    @property
    def feedback_features(self) -> dict[str, type]:
        """Empty: a leader takes no feedback."""
        return {}

    @property
    def is_connected(self) -> bool:
        """True while the leader is subscribed to."""
        return self._is_connected

    @property
    def is_calibrated(self) -> bool:
        """Always True: a leader gives joint positions."""
        return True

    def calibrate(self) -> None:
        """Nothing to do."""

    def configure(self) -> None:
        """Nothing to do."""

    def connect(self, calibrate: bool = True) -> None:
        """Start listening; `get_action` waits for the first state, so a leader may start later."""
        if self._is_connected:
            raise DeviceAlreadyConnectedError(f"{self} is connected already.")
        self._leader.open()
        self._is_connected = True

    def get_action(self) -> dict[str, float]:
        """Positions of the newest state.

        Raises:
            NotReadyError: no state arrived, or the newest one is too old.
            InvalidInputError: a joint of the robot is missing in it, or it cannot be used.
        """
        self._check_connected()
        led = self._leader.newest(self.config.start_timeout_s)
        if led.problem:
            raise InvalidInputError(led.problem)
        age_s = time.monotonic() - led.at_s if led.at_s else float("inf")
        if age_s > self.config.timeout_s:
            raise NotReadyError(
                f"The leader {self._leader.name} has been silent for {age_s:.2g} s.",
                hint="Does it publish joint states there, in the same ROS domain?",
            )
        return self._motors.values(led.positions)

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Nothing to do: a leader takes no feedback."""

    def disconnect(self) -> None:
        """Stop listening."""
        self._check_connected()
        self._is_connected = False
        self._leader.close()

    def _check_connected(self) -> None:
        if not self._is_connected:
            raise DeviceNotConnectedError(f"{self} is not connected.")

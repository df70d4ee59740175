"""The teleoperator `roboneuron` of LeRobot."""

from __future__ import annotations

import ssl  # noqa: F401  before rclpy: both bring a libcrypto
import threading
import time
from typing import TYPE_CHECKING, Any

from lerobot.teleoperators import Teleoperator
from lerobot.utils.errors import DeviceAlreadyConnectedError, DeviceNotConnectedError

from lerobot_teleoperator_roboneuron.config_roboneuron_teleop import RoboNeuronTeleopConfig
from rn_robot_lerobot.units import motors_of
from roboneuron import InvalidInputError, NotReadyError, RobotProfile
from roboneuron.command import discover, environment, load_profile

if TYPE_CHECKING:
    from roboneuron.command import RosLink


class RoboNeuronTeleop(Teleoperator):
    """Follows the newest joint state of a topic."""

    config_class = RoboNeuronTeleopConfig
    name = "roboneuron"

    def __init__(self, config: RoboNeuronTeleopConfig) -> None:
        """Read the robot's profile. Raises ConfigurationError when no plugin here offers it."""
        super().__init__(config)
        self.config = config
        profile: RobotProfile = load_profile(discover(), config.robot)
        self._motors = motors_of(profile, use_degrees=config.use_degrees)
        self._link: RosLink | None = None
        self._changed = threading.Condition()
        self._positions: dict[str, float] = {}
        self._at_s = 0.0
        self._problem = ""

    @property
    def action_features(self) -> dict[str, type]:
        """Those of the robot."""
        return dict.fromkeys(self._motors.keys, float)

    @property
    def feedback_features(self) -> dict[str, type]:
        """None."""
        return {}

    @property
    def is_connected(self) -> bool:
        """Whether the topic is subscribed."""
        return self._link is not None

    @property
    def is_calibrated(self) -> bool:
        """Always: a topic has joint positions."""
        return True

    def calibrate(self) -> None:
        """Nothing to do."""

    def configure(self) -> None:
        """Nothing to do."""

    def connect(self, calibrate: bool = True) -> None:
        """Subscribe; `get_action` waits for the first state, so that a leader may begin later."""
        if self._link is not None:
            raise DeviceAlreadyConnectedError(f"{self} is connected already.")
        environment.prepare_environment()
        from sensor_msgs.msg import JointState  # heavy: needs the environment

        from roboneuron.command import RosLink, qos  # likewise

        link = RosLink("lerobot_teleoperator")
        link.open()
        link.subscribe(JointState, self.config.topic, self._take, qos.NEWEST)
        self._link = link

    def get_action(self) -> dict[str, float]:
        """Positions of the newest state.

        Raises:
            NotReadyError: none came, or the newest one is too old.
            InvalidInputError: a joint of the robot lacks in it.
        """
        self._check_connected()
        config = self.config
        with self._changed:
            self._changed.wait_for(lambda: self._at_s > 0.0, config.start_timeout_s)
            positions, age_s, problem = dict(self._positions), self._age_s(), self._problem
        if problem:
            raise InvalidInputError(problem)
        if age_s > config.timeout_s:
            raise NotReadyError(
                f"The leader on {config.topic} has been silent for {age_s:.2g} s.",
                hint="Is it publishing joint states there, in the same ROS domain?",
            )
        return self._motors.values(positions)

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Nothing: a topic of states takes none."""

    def disconnect(self) -> None:
        """Leave the graph."""
        link = self._check_connected()
        self._link = None
        link.close()

    def _check_connected(self) -> RosLink:
        if self._link is None:
            raise DeviceNotConnectedError(f"{self} is not connected.")
        return self._link

    def _age_s(self) -> float:
        return time.monotonic() - self._at_s if self._at_s else float("inf")

    def _take(self, message: Any) -> None:
        from roboneuron.command import messages  # heavy: needs the environment

        problem, positions = "", dict[str, float]()
        try:
            joints = messages.joints_from_message(message)
            positions = dict(zip(joints.names, joints.position.tolist(), strict=True))
        except InvalidInputError as error:
            problem = f"A state on {self.config.topic} is malformed: {error}"
        with self._changed:
            self._positions, self._at_s, self._problem = positions, time.monotonic(), problem
            self._changed.notify_all()

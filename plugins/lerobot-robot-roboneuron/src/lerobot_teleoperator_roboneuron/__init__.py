"""A teleoperator for LeRobot that follows joint states on a ROS topic."""

from lerobot_teleoperator_roboneuron.config_roboneuron_teleop import RoboNeuronTeleopConfig
from lerobot_teleoperator_roboneuron.teleoperator import RoboNeuronTeleop

__all__ = ["RoboNeuronTeleop", "RoboNeuronTeleopConfig"]

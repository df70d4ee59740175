"""RoboNeuron's robots for LeRobot; importing it registers the robot and the teleoperator."""

from lerobot_teleoperator_roboneuron import RoboNeuronTeleop, RoboNeuronTeleopConfig

from lerobot_robot_roboneuron.config_roboneuron import RoboNeuronConfig
from lerobot_robot_roboneuron.robot import RoboNeuron

__all__ = ["RoboNeuron", "RoboNeuronConfig", "RoboNeuronTeleop", "RoboNeuronTeleopConfig"]

"""A command that imports ROS before its help is requested."""

import rclpy  # noqa: F401
from broken_features import GoodCommand


class Heavy(GoodCommand):
    """Imports too much."""

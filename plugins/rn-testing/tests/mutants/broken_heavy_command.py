"""A command that imports ROS before anybody asked for its help."""

import rclpy  # noqa: F401
from broken_features import GoodCommand


class Heavy(GoodCommand):
    """Imports too much."""

"""The direct path: tools that are derived at run time from the ROS interfaces a robot exposes."""

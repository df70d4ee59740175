"""ROS interfaces from their definitions at run time, without colcon."""

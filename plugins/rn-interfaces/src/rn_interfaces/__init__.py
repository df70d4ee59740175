"""ROS interfaces from their definitions at run time, without a compiler."""

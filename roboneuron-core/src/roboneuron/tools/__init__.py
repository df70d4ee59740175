"""Tools that every server has: of the closed loop, of arms, of ROS interfaces, and to look."""

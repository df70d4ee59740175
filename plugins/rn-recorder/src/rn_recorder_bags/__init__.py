"""Bags of ROS 2 from other programs as data sets: the command `roboneuron runs import`."""

"""ROS 2 types of ros2_control (`control_msgs`), and how they are built from their definitions
without colcon.
"""

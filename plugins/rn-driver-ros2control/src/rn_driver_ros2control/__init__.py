"""Driver `ros2-control`: any arm that a `joint_trajectory_controller` of ros2_control moves."""

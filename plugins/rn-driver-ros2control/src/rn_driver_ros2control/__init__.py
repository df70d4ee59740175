"""Driver `ros2-control` for any arm with a `joint_trajectory_controller` of ros2_control."""

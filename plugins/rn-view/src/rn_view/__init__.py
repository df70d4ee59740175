"""A live view of the robot in a browser."""

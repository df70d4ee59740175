"""Real cameras: images on ROS topics of a driver, USB cameras and video files."""

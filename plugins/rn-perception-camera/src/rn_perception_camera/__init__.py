"""Real cameras: images that a driver publishes on ROS topics, USB cameras and video files."""

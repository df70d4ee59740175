"""Perception modules: from the frames of a source to images on ROS topics."""

"""Perception modules: frames of a source in, images on ROS topics out."""

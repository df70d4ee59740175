"""Inference modules: from images and states to the actions of a policy."""

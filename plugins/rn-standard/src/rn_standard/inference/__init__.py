"""Inference modules: images and states in, the actions of a policy out."""

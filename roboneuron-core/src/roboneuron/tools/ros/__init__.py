"""Typed tools for ROS topics, services, actions and parameters, derived from their interfaces at
run time.
"""

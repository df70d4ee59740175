"""Execution of chunks without pauses: rules for when to predict and which rows to send. No threads,
no ROS.
"""

"""Execution of chunks without pauses: rules that decide when to predict and which rows to send. No
thread, no ROS.
"""

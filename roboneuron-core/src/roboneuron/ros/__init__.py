"""ROS 2 as modules and server use it: environment, quality of service, topic names, message
conversions, nodes.
"""

"""ROS 2 for modules and server: environment, quality of service, topic names, message conversions,
nodes.
"""

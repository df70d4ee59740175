"""RoboNeuron: typed MCP tools and supervised closed loops between LLM agents, ROS 2 robots and VLA models."""

__version__ = "0.1.0"

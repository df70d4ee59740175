"""The fixed image -> action contract: the only types exchanged between models, perception, control
and robots.

It uses numpy only, and is independent of ROS, MCP, torch and plugins.
"""

from roboneuron.listing import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

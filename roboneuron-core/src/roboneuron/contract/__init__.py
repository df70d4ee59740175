"""The fixed image -> action contract: the only types that cross between models, perception, control
and robots.

numpy only. Nothing here knows ROS, MCP, torch or a plugin.
"""

from roboneuron.listing import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

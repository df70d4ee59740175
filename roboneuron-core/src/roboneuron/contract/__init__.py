"""The fixed image -> action contract: the only types that cross between models, perception, control
and robots.

numpy only. Nothing here knows ROS, MCP, torch or a plugin.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

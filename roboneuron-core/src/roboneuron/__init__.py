"""RoboNeuron: typed MCP tools and supervised closed loops between LLM agents, ROS 2 robots and VLA
models.

The public API, all that a plugin needs of core, is listed in `__init__.pyi`. A name is imported on
first use, so that a plugin module, which imports descriptors only, stays light. CHANGELOG.md
records every change to it.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__ = [*__all__, "__version__"]

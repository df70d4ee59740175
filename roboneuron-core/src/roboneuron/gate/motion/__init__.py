"""Limits on how an arm moves, for the commands of control and for joint motions: pure computation,
numpy only.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

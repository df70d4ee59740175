"""Limits on the motion of an arm, for the commands of control and for joint motions: pure
computation, numpy only.
"""

from roboneuron.listing import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)

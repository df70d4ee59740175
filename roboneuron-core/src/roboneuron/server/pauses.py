"""Short pauses of the interpreter: what could keep a thread that has to stop a robot from running when it wakes."""

from __future__ import annotations

import gc
import sys

SWITCH_S = 0.001
"""How long a thread that computes keeps the others waiting; the interpreter's own default is 5 ms."""


def shorten_pauses() -> None:
    """Call it once everything is imported and derived; holds the interpreter for about 0.1 s itself.

    A full garbage collection looks at every object there is and stops all threads meanwhile: 80 to 130 ms with ROS, MCP
    and 3 to 1,000 endpoints loaded. What is there now stays until the end, so it is not looked at again.
    """
    sys.setswitchinterval(SWITCH_S)
    gc.collect()
    gc.freeze()

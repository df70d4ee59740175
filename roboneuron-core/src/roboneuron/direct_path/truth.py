"""Ground truth of the simulator: a simulation's data on objects that no camera or sensor has
observed.
"""

from __future__ import annotations

import os
import re

__all__ = ["is_withheld"]
"""Names that other distributions may use."""

SWITCH = "ROBONEURON_SIMULATOR_TRUTH"
"""Environment variable of a server: "on" for servers that judge by ground truth, such as demos;
otherwise simulated robots do not report it, and clients cannot read it.
"""
_TOPIC = re.compile(r"(^|/)sim/(state|handed_over)$")


def is_told() -> bool:
    """True if clients of this process's server may read it."""
    return os.environ.get(SWITCH, "") == "on"


def is_withheld(topic: str) -> bool:
    """True if a topic of a simulation contains it and is withheld from clients."""
    return bool(_TOPIC.search(topic)) and not is_told()

"""The simulator's truth: what a simulation says of objects, which no camera or sensor has seen."""

from __future__ import annotations

import os
import re

SWITCH = "ROBONEURON_SIMULATOR_TRUTH"
"""Environment variable of a server: "on" for those that judge by the simulator, such as demos;
otherwise simulated robots do not report it, and clients cannot read it.
"""
_TOPIC = re.compile(r"(^|/)sim/(state|handed_over)$")


def is_told() -> bool:
    """Whether clients of this process's server may know it."""
    return os.environ.get(SWITCH, "") == "on"


def is_withheld(topic: str) -> bool:
    """Whether a topic of a simulation carries it and is not for clients."""
    return bool(_TOPIC.search(topic)) and not is_told()

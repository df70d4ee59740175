"""Names of derived tools: readable, at most 64 characters, unique, and stable for the same
endpoints.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection

LONGEST = 64
"""Length limit of tool names in many clients."""
PATTERNS = {
    "publish": "publish_{}",
    "sequence": "publish_{}_sequence",
    "read": "read_{}",
    "service": "call_{}",
    "action": "send_{}_goal",
    "lookup": "lookup_{}",
    "battery": "get_{}",
    "detections": "get_{}",
}
"""Pattern of a tool's name by its use of an endpoint."""


def tool_name(use: str, label: str, robot: str, taken: Collection[str]) -> str:
    """Return the name for `label`; if it is taken, the robot's name or else a digest is added.

    Args:
        use: a key of PATTERNS.
        label: the endpoint's name.
        robot: name of the robot.
        taken: names in use.
    """
    pattern = PATTERNS[use]
    plain = shorten(pattern, label)
    if plain not in taken:
        return plain
    told_apart = shorten(pattern, f"{to_label(robot)}_{label}")
    if told_apart not in taken:
        return told_apart
    return shorten(pattern, f"{to_label(robot)}_{label}", digest=True)


def shorten(pattern: str, label: str, *, digest: bool = False) -> str:
    """Insert `label` into `pattern`; a name that is too long is truncated and gets a digest of the
    whole.
    """
    name = pattern.format(label)
    if len(name) <= LONGEST and not digest:
        return name
    mark = hashlib.sha256(name.encode()).hexdigest()[:6]
    room = LONGEST - len(pattern.format("")) - len(mark) - 1
    return pattern.format(f"{label[:room].rstrip('_')}_{mark}")


def to_label(name: str) -> str:
    """Convert a ROS name to a label: lower case, underscores. "/Arm/cmd_vel" -> "arm_cmd_vel"."""
    text = re.sub(r"[^a-z0-9]+", "_", re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()).strip(
        "_"
    )
    return text if text[:1].isalpha() else f"x_{text}"

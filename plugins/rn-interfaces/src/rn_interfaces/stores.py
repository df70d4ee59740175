"""Definitions in rosbags: the common interfaces of each distribution of ROS 2."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

from rn_interfaces.found import FoundDefinition
from rn_interfaces.store import Name

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

_RULE = "=" * 80
_NEWEST = ("ROS2_JAZZY", "ROS2_LYRICAL", "ROS2_KILTED", "ROS2_IRON", "ROS2_HUMBLE")
"""Distributions in the order of the search: that of the wheels, then others, newest first."""


def known_definition(name: Name) -> FoundDefinition | None:
    """Return the definition of a message from the first distribution that has it; without comments.

    Services and actions are not included.
    """
    for distribution in _NEWEST:
        store = _store(distribution)
        if str(name) in store.types:
            text, _ = store.generate_msgdef(str(name), ros_version=2)
            return FoundDefinition(text.partition(_RULE)[0], f"rosbags, {distribution.lower()}")
    return None


@cache
def _store(distribution: str) -> Typestore:
    from rosbags.typesys import Stores, get_typestore  # heavy

    return get_typestore(Stores[distribution])

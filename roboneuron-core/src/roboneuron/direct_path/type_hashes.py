"""Comparison of type definitions between peers, by the RIHS01 hashes of REP 2016."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from roboneuron import foreign
from roboneuron.errors import ConfigurationError, ForeignDataError

if TYPE_CHECKING:
    from rclpy.topic_endpoint_info import TopicEndpointInfo

KNOWN = "RIHS01_"
"""Prefix of a hash; ROS 2 before Iron and programs without ROS send none."""
NAMELESS = "_NODE_NAME_UNKNOWN_"
"""rcl's name for the node of an endpoint that was discovered before its node."""
BARE = "_CREATED_BY_BARE_DDS_APP_"
"""rcl's name for the node of an endpoint of a program without ROS."""


@cache
def _own_hash(type_name: str, part: str) -> str:
    """Hash of a part of the type in this process, empty if unknown; cached like the class.

    Raises ConfigurationError if its description is damaged.
    """
    for prefix in [*os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep), sys.prefix]:
        path = Path(prefix, "share", f"{type_name}.json")
        if prefix and path.is_file():
            return read_type_hashes(path).get(f"{type_name}{part}", "")
    return ""


def read_type_hashes(path: Path) -> dict[str, str]:
    """Hashes by full name, from rosidl's description. Raises ConfigurationError if damaged."""
    try:
        description = foreign.read_json(path, most_bytes=foreign.MOST_DESCRIPTION_BYTES)
        return foreign.type_hashes(description)
    except (FileNotFoundError, ForeignDataError) as error:
        reason = error.message if isinstance(error, ForeignDataError) else "it is not there"
        raise ConfigurationError(
            f"{path} is no description of a type: {reason}.",
            hint="Install its package again, or learn the type again: `roboneuron ros learn`.",
        ) from error


def check_type_hash(
    topic: str, type_name: str, infos: Sequence[TopicEndpointInfo], part: str = ""
) -> None:
    """Refuse a topic, service or action whose other end has another definition of the type.

    ROS 2 before Iron and other vendors send no hash; they cannot be checked.

    Args:
        topic: for the message.
        type_name: as in the exposure, package/msg/Name.
        infos: the publishers or subscriptions.
        part: part of a service or action, as named in the hash: `_Request`.

    Raises:
        ConfigurationError: names the node and a remedy.
    """
    own = _own_hash(type_name, part)
    for info in infos:
        spoken = str(info.topic_type_hash)
        if own and spoken.startswith(KNOWN) and spoken != own:
            who = "A node" if info.node_name in (NAMELESS, BARE) else str(info.node_name)
            raise ConfigurationError(
                f"{who} has another definition of {type_name} on {topic} than this "
                f"server: {spoken[:15]}, not {own[:15]}.",
                hint="Learn the node's: `roboneuron ros learn graph`, and start the server again; "
                "or install the package of its version.",
            )

"""Message definitions of ROS 2 types, in the format of MCAP files with the profile "ros2".

Source of the format: MCAP well-known schema encodings, "ros2msg": the definition, then that of each
type it uses, each after a line of 80 "=" and a line "MSG: package/Name".
"""

from __future__ import annotations

import os
import re
import sys
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

ROS_2 = "ros2msg"
"""Encoding of the definitions of ROS 2."""
_IDL = ("ros2idl", "omgidl")
_RULE = "=" * 80
_WIDTHS = (8, 16, 32, 64)
_BUILT_IN = frozenset({"bool", "byte", "char", "float32", "float64", "string", "wstring"}).union(
    *({f"int{bits}", f"uint{bits}"} for bits in _WIDTHS)
)
_FIELD = re.compile(r"\s*([A-Za-z][\w/]*)(?:<=\d+)?(?:\[[^\]]*\])?\s+[A-Za-z]\w*")
_NO_IDL = re.compile(r"^(?:[ \t]*#|IDL:).*$", re.MULTILINE)
_OWN = {("tf2_msgs", "TFMessage"): "geometry_msgs/TransformStamped[] transforms\n"}
"""Types of messages that the recorder itself creates, whose package need not be installed."""


@cache
def definition(type_name: str) -> str:
    """The concatenated definition of a message type such as "sensor_msgs/msg/Image".

    Raises:
        FileNotFoundError: it, or a type that it uses, is not installed.
    """
    package, _, name = type_name.partition("/msg/")
    parts = [_read(package, name)]
    known, pending = {(package, name)}, _used(package, parts[0])
    while pending:
        used = pending.pop(0)
        if used in known:
            continue
        known.add(used)
        text = _read(*used)
        parts.append(f"{_RULE}\nMSG: {used[0]}/{used[1]}\n{text}")
        pending += _used(used[0], text)
    return "\n".join(part.rstrip("\n") for part in parts) + "\n"


def to_definition(type_name: str, encoding: str, text: str) -> str:
    """The concatenated definition of a type from a recording's own schema; empty if that is not of
    ROS 2, or is IDL and rosbags is not installed.

    Source of the format of IDL: MCAP well-known schema encodings, "ros2idl": the IDL of each type
    after a line of 80 "=" and a line "IDL: package/msg/Name".
    """
    if encoding == ROS_2:
        return text
    if encoding not in _IDL or not find_spec("rosbags"):
        return ""
    from rosbags.typesys import Stores, TypesysError, get_types_from_idl, get_typestore  # heavy

    store = get_typestore(Stores.EMPTY)
    types: dict[str, Any] = {}
    try:
        for part in filter(str.strip, text.split(f"{_RULE}\n")):
            # rosbags 0.11.9 parses no lines of the preprocessor
            types |= get_types_from_idl(_NO_IDL.sub("", part))
        store.register(types)
        return store.generate_msgdef(type_name, ros_version=2)[0]
    except (TypesysError, KeyError, RecursionError):
        return ""


def _read(package: str, name: str) -> str:
    for prefix in [*os.environ.get("AMENT_PREFIX_PATH", "").split(":"), sys.prefix]:
        path = Path(prefix) / "share" / package / "msg" / f"{name}.msg"
        if prefix and path.is_file():
            return path.read_text(encoding="utf-8")
    if (package, name) in _OWN:
        return _OWN[package, name]
    raise FileNotFoundError(f"No definition of {package}/msg/{name} is installed.")


def _used(package: str, text: str) -> list[tuple[str, str]]:
    """Types of the fields of a definition, without the built-in ones."""
    found = []
    for line in text.splitlines():
        match = _FIELD.match(line.split("#", 1)[0])
        if match is None or match[1] in _BUILT_IN:
            continue
        *outer, name = match[1].split("/")
        found.append((outer[0] if outer else "std_msgs" if name == "Header" else package, name))
    return found

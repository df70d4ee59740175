"""Labels of recorded actions: the control space of a serialized action, and the meaning of its
values.
"""

from __future__ import annotations

import struct

from roboneuron import ACTION_LABEL, channel_keys

ACTION_TYPE = "std_msgs/msg/Float64MultiArray"
_LITTLE_ENDIAN = b"\x00\x01"
_LONGEST = 10_000


def is_action(topic: str, type_name: str) -> bool:
    """True if the messages of a topic are actions."""
    return topic.rpartition("/")[2] == "action" and type_name == ACTION_TYPE


def label_of(data: bytes) -> str:
    """Label of a CDR `std_msgs/Float64MultiArray`; empty for one that cannot be read.

    A message without a layout counts as the contract's 7-vector, as for control.

    Source: OMG CDR: encapsulation header of 4 bytes, then the sequence of dimensions, each
    beginning with its label as a string of that many bytes with NUL.
    """
    if data[:2] != _LITTLE_ENDIAN or len(data) < 8:
        return ""
    (dimensions,) = struct.unpack_from("<I", data, 4)
    if not dimensions:
        return ACTION_LABEL
    if len(data) < 12:
        return ""
    (length,) = struct.unpack_from("<I", data, 8)
    if not 0 < length <= min(_LONGEST, len(data) - 12):
        return ""
    return data[12 : 11 + length].decode("utf-8", "replace")


def named_values(label: str) -> dict[str, str]:
    """Names and units of the values of an action, as metadata of its channel."""
    if not label:
        return {}
    told = " ".join(f"data[{at}]={name}" for at, name in enumerate(channel_keys(label)))
    return {"roboneuron.fields": told, "roboneuron.space": label}

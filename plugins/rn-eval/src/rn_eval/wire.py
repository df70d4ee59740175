"""Messages of vla-eval's model servers: msgpack over a websocket, images and arrays as tagged maps.

Source: vla-eval 0.8.0, vla_eval/protocol (protocol version 1).
"""

from __future__ import annotations

import time
from typing import Any, Literal, NamedTuple, cast

import msgpack
import numpy as np

from roboneuron import ForeignDataError, InvalidInputError, foreign, frame_from_compressed

PROTOCOL_VERSION = 1
MOST_MESSAGE_BYTES = 64 * 1024 * 1024
Kind = Literal["hello", "observation", "action", "episode_start", "episode_end", "error"]
_KINDS = ("hello", "observation", "action", "episode_start", "episode_end", "error")
_NUMBERS = "biuf"


class WireMessage(NamedTuple):
    """One message.

    Attributes:
        kind: type of the message.
        payload: content, depending on the kind; arrays are numpy arrays.
        seq: number of the request, repeated in its answer.
    """

    kind: Kind
    payload: dict[str, object]
    seq: int


def pack(message: WireMessage) -> bytes:
    """Serialise a message."""
    raw = {
        "type": message.kind,
        "payload": message.payload,
        "seq": message.seq,
        "timestamp": time.time(),
    }
    return cast("bytes", msgpack.packb(raw, default=_to_map, use_bin_type=True))


def unpack(data: object) -> WireMessage:
    """Parse a message. Raises ForeignDataError if it violates the protocol."""
    if not isinstance(data, bytes):
        raise ForeignDataError("Expected a binary message.")
    try:
        raw = msgpack.unpackb(data, object_hook=_from_map, raw=False)
    except (
        *(ValueError, TypeError, KeyError, OverflowError),
        *(msgpack.UnpackException, InvalidInputError),
    ) as error:
        raise ForeignDataError(
            f"A message could not be read: {type(error).__name__}: {error}."
        ) from error
    foreign.check_value(raw, "a message")
    kind = foreign.choice(foreign.field(raw, "type"), "the type of a message", _KINDS)
    payload = foreign.table(foreign.field(raw, "payload"), "the payload", 4096)
    seq = foreign.integer(foreign.field(raw, "seq"), "seq")
    return WireMessage(cast("Kind", kind), payload, seq)


def _to_map(value: object) -> object:
    if isinstance(value, np.ndarray):
        return {
            "__ndarray__": True,
            "data": value.tobytes(),
            "dtype": value.dtype.str,
            "shape": list(value.shape),
        }
    raise TypeError(f"{type(value).__name__} is not sent")


def _from_map(value: dict[str, Any]) -> object:
    if "__image__" in value and value["format"] != "raw":
        return frame_from_compressed(value["data"], str(value["format"]))
    if "__image__" not in value and "__ndarray__" not in value:
        return value
    dtype = np.dtype(value["dtype"])
    if dtype.kind not in _NUMBERS:
        raise ValueError(f"arrays of {dtype} are not taken")
    return np.frombuffer(value["data"], dtype=dtype).reshape(value["shape"])

"""The protocol between the evaluation and the simulator's process: typed messages in frames of
bounded size.

A frame is MAGIC, two little-endian uint32 (lengths of header and payload), a JSON header and the
arrays' bytes. No content is executed. Both ends import this file, each in its own environment.
"""

from __future__ import annotations

import dataclasses
import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

MAGIC = b"RNL1"
MOST_HEADER_BYTES = 64 * 1024
MOST_PAYLOAD_BYTES = 32 * 1024 * 1024
_LENGTHS = struct.Struct("<II")
_DTYPES = ("|u1", "<f8")
_BAD_VALUES = (ValueError, OverflowError, RecursionError)
_SCALARS: dict[str, type] = {"str": str, "int": int, "bool": bool}

F64 = NDArray[np.float64]
Array = NDArray[np.generic]


class PipeError(Exception):
    """The other end has closed, or its data violate the protocol."""


@dataclass(frozen=True)
class Hello:
    """First request."""


@dataclass(frozen=True)
class Ready:
    """Answer to `Hello`: versions of simulator packages, "name version, name version"."""

    versions: str


@dataclass(frozen=True)
class Open:
    """Start an episode: initial state `state` of task `task`, square images of `image_px`
    pixels.
    """

    suite: str
    task: int
    state: int
    image_px: int


@dataclass(frozen=True)
class PipeStep:
    """One control period with a simulator action: float64 (7,), gripper -1 open, 1 closed."""

    action: F64


@dataclass(frozen=True)
class State:
    """Answer to `Open` and `PipeStep`: the simulator's observation.

    Attributes:
        instruction: the task's sentence.
        is_done: the task is done.
        joints: float64 (9,), seven arm joints [rad] and both fingers [m].
        eef_pos: float64 (3,) [m], in the world frame.
        eef_quat: float64 (4,), x, y, z, w, with MuJoCo's sign.
        flat: float64 (n,), time, positions and velocities of the simulation.
    """

    instruction: str
    is_done: bool
    joints: F64
    eef_pos: F64
    eef_quat: F64
    flat: F64


@dataclass(frozen=True)
class Render:
    """Request the image of one camera for the last `State`."""

    camera: str


@dataclass(frozen=True)
class Image:
    """Answer to `Render`: uint8 (H, W, 3), rows as in MuJoCo's buffer (lowest first)."""

    pixels: NDArray[np.uint8]


@dataclass(frozen=True)
class Failed:
    """Answer to a failed request: the exception's text."""

    reason: str


Message = Hello | Ready | Open | PipeStep | State | Render | Image | Failed
_KINDS: dict[str, type[object]] = {
    cls.__name__: cls for cls in (Hello, Ready, Open, PipeStep, State, Render, Image, Failed)
}


def send(stream: BinaryIO, message: Message) -> None:
    """Write one message. Raises PipeError if the other end has closed."""
    fields: dict[str, object] = {}
    arrays: list[tuple[str, str, tuple[int, ...]]] = []
    payload = bytearray()
    for field in dataclasses.fields(message):
        value = getattr(message, field.name)
        if isinstance(value, np.ndarray):
            whole = np.ascontiguousarray(value)
            arrays.append((field.name, whole.dtype.str, whole.shape))
            payload += whole.tobytes()
        else:
            fields[field.name] = value
    header = json.dumps(
        {"kind": type(message).__name__, "fields": fields, "arrays": arrays}
    ).encode()
    if len(header) > MOST_HEADER_BYTES or len(payload) > MOST_PAYLOAD_BYTES:
        raise PipeError(
            f"{type(message).__name__} is too large: {len(header)} and {len(payload)} bytes."
        )
    try:
        stream.write(MAGIC + _LENGTHS.pack(len(header), len(payload)) + header + payload)
        stream.flush()
    except OSError as error:
        raise PipeError(f"The other end has gone: {error}.") from error


def receive(read: Callable[[int], bytes]) -> Message:
    """Read one message.

    Args:
        read: returns exactly this many bytes, or raises PipeError.

    Raises:
        PipeError: the stream has ended, or the data are no message of this protocol.
    """
    start = read(len(MAGIC) + _LENGTHS.size)
    header_bytes, payload_bytes = _LENGTHS.unpack(start[len(MAGIC) :])
    if (
        start[: len(MAGIC)] != MAGIC
        or header_bytes > MOST_HEADER_BYTES
        or payload_bytes > MOST_PAYLOAD_BYTES
    ):
        raise PipeError(f"No frame of this protocol: {start!r}.")
    header, payload = read(header_bytes), read(payload_bytes)
    try:
        parsed = json.loads(header)
        values = dict(parsed["fields"])
        at = 0
        for name, dtype, shape in parsed["arrays"]:
            if dtype not in _DTYPES:
                raise ValueError(f"arrays of type {dtype!r} are not sent")
            size = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
            if not 0 <= size <= len(payload) - at:
                raise ValueError(
                    f"array {name!r} of shape {shape} is not in a payload of {len(payload)} bytes"
                )
            values[name] = np.frombuffer(payload[at : at + size], dtype=dtype).reshape(shape)
            at += size
        return _checked(_KINDS[parsed["kind"]], values, at, len(payload))
    # not the core's decoder: the simulator's environment does not have it
    except (LookupError, TypeError, AttributeError, *_BAD_VALUES) as error:
        raise PipeError(f"A message could not be read: {type(error).__name__}: {error}.") from error


def _checked(kind: type[Any], values: dict[str, Any], used: int, given: int) -> Message:
    fields = {field.name: str(field.type) for field in dataclasses.fields(kind)}
    if set(values) != set(fields) or used != given:
        raise ValueError(
            f"{kind.__name__} has the fields {sorted(fields)}, got {sorted(values)}, "
            f"{given - used} bytes"
        )
    for name, expected in fields.items():
        wanted = _SCALARS.get(expected, np.ndarray)
        if type(values[name]) is not wanted:
            raise ValueError(
                f"{kind.__name__}.{name} is {type(values[name]).__name__}, expected "
                f"{wanted.__name__}"
            )
    message: Message = kind(**values)
    return message

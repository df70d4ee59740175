"""Messages between robots and server: a JSON document and the arrays it refers to, in one frame of
bounded size.
"""

from __future__ import annotations

import json
import math
import socket
import struct
import time
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

import roboneuron
from roboneuron import (
    EE_DELTA,
    ActionChunk,
    CameraCalibration,
    CheckpointError,
    ConfigurationError,
    ControlSpace,
    Frame,
    InvalidInputError,
    JointSample,
    MissingDependencyError,
    NotReadyError,
    Observation,
    PluginError,
    Pose,
    RoboNeuronError,
    StateError,
    UngroundedError,
    UnsafeError,
)

Document = dict[str, Any]
_HEAD = struct.Struct("!II")
"""Bytes of the document, and of everything behind it."""
_LONG_S = 1e6
_LEAST_S = 1e-3
_MOST_BYTES = 1 << 26
_DTYPES = ("|u1", "<f8", "<i8", "<f4")
_ARRAY = "$array"
_ERRORS: dict[str, type[RoboNeuronError]] = {
    kind.code: kind
    for kind in (
        CheckpointError,
        ConfigurationError,
        InvalidInputError,
        MissingDependencyError,
        NotReadyError,
        PluginError,
        StateError,
        UngroundedError,
        UnsafeError,
    )
}


def encode(document: Mapping[str, object]) -> bytes:
    """One frame of a document that may hold arrays anywhere."""
    return b"".join(_buffers(document))


def _buffers(document: Mapping[str, object]) -> list[bytes | memoryview]:
    """The frame in parts; arrays are not copied."""
    parts: list[NDArray[Any]] = []

    def default(value: object) -> object:
        if not isinstance(value, np.ndarray):
            raise TypeError(f"{type(value).__name__} cannot be sent")
        parts.append(np.ascontiguousarray(value))
        return {_ARRAY: len(parts) - 1}

    text = json.dumps(document, default=default)
    heads = [[part.dtype.str, part.shape] for part in parts]
    head = f"[{text}, {json.dumps(heads)}]".encode()
    size = sum(part.nbytes for part in parts)
    tails = [part.reshape(-1).view(np.uint8).data for part in parts if part.size]
    return [_HEAD.pack(len(head), size) + head, *tails]


def decode(head: bytes | memoryview, tail: bytes | memoryview) -> Document:
    """The document of a frame, whose arrays keep its memory. Raises ValueError for what is none."""
    document, heads = json.loads(bytes(head))
    arrays: list[NDArray[Any]] = []
    offset = 0
    for dtype, shape in heads:
        if dtype not in _DTYPES or any(not isinstance(n, int) or n < 0 for n in shape):
            raise ValueError(f"an array {dtype} {shape} is not expected")
        count = math.prod(shape)
        size = count * np.dtype(dtype).itemsize
        if offset + size > len(tail):
            raise ValueError("the frame ends within an array")
        arrays.append(np.frombuffer(tail, dtype, count, offset).reshape(shape))
        offset += size
    found = _filled(document, arrays)
    if not isinstance(found, dict) or offset != len(tail):
        raise ValueError("the frame is no document")
    return found


def _filled(value: object, arrays: list[NDArray[Any]]) -> object:
    if isinstance(value, dict):
        if value.keys() == {_ARRAY}:
            return arrays[value[_ARRAY]]
        return {key: _filled(inner, arrays) for key, inner in value.items()}
    return [_filled(inner, arrays) for inner in value] if isinstance(value, list) else value


class Channel:
    """Frames over a connected socket. One thread reads; `send` from any thread that holds no other
    `send`.
    """

    def __init__(self, connected: socket.socket) -> None:
        self._in, self._out = connected, connected.dup()  # each with a time limit of its own
        self._buffer, self._filled = bytearray(_HEAD.size), 0
        self._head_size: int | None = None  # of the frame that is being received

    def send(self, document: Mapping[str, object], timeout_s: float) -> None:
        """Raises OSError when the other side is gone, or does not read in time."""
        end_s = time.monotonic() + timeout_s
        for part in _buffers(document):
            self._out.settimeout(max(end_s - time.monotonic(), _LEAST_S))
            self._out.sendall(part)

    def receive(self, deadline_s: float | None) -> Document:
        """The next document; what has come of a frame by the deadline (monotonic [s]) is kept for
        the next call.

        Raises:
            TimeoutError: none by then.
            OSError: the other side is gone.
            ValueError: it sent something else.
        """
        if self._head_size is None:
            self._fill(deadline_s)
            head_size, tail_size = _HEAD.unpack(self._buffer)
            if head_size + tail_size > _MOST_BYTES:
                with suppress(OSError):  # unread bytes would reset the connection at its end
                    self._in.recv(1 << 20, socket.MSG_DONTWAIT)
                raise ValueError(f"a frame of {head_size + tail_size} bytes is more than expected")
            self._head_size = head_size
            self._buffer, self._filled = bytearray(head_size + tail_size), 0
        self._fill(deadline_s)
        frame, end = memoryview(self._buffer), self._head_size
        self._buffer, self._filled, self._head_size = bytearray(_HEAD.size), 0, None
        return decode(frame[:end], frame[end:])

    def _fill(self, deadline_s: float | None) -> None:
        """Receive until the buffer is full."""
        rest = memoryview(self._buffer)
        while self._filled < len(rest):
            left_s = _LONG_S if deadline_s is None else deadline_s - time.monotonic()
            if left_s <= 0:
                raise TimeoutError("no answer in time")
            self._in.settimeout(left_s)  # never None: it would make the other half blocking too
            count = self._in.recv_into(rest[self._filled :])
            if not count:
                raise ConnectionError("the other side has closed the connection")
            self._filled += count

    def close(self) -> None:
        """Hang up, also for a thread that reads; idempotent."""
        with suppress(OSError):
            self._in.shutdown(socket.SHUT_RDWR)
        self._in.close()
        self._out.close()


def from_observation(observation: Observation) -> Document:
    """What is sent of an observation; rows ahead stay at home, since no shared backend continues
    them.
    """
    joints, pose = observation.joints, observation.ee_pose
    return {
        "frames": {role: _from_frame(frame) for role, frame in observation.frames.items()},
        "instruction": observation.instruction,
        "joints": None
        if joints is None
        else [list(joints.names), joints.position, joints.velocity, joints.stamp_ns],
        "ee_pose": None if pose is None else [pose.position_m, pose.quaternion_xyzw, pose.stamp_ns],
        "gripper_open": observation.gripper_open,
        "stamp_ns": observation.stamp_ns,
    }


def _from_frame(frame: Frame) -> Document:
    known = frame.calibration
    return {
        "camera": frame.camera,
        "image": frame.image,
        "stamp_ns": frame.stamp_ns,
        "frame_id": frame.frame_id,
        "calibration": None
        if known is None
        else [known.intrinsics, known.mount, known.T_mount_camera],
    }


def to_observation(document: Document) -> Observation:
    """The observation that was sent. Raises KeyError, TypeError, ValueError or RoboNeuronError for
    anything else.
    """
    joints, pose = document["joints"], document["ee_pose"]
    return Observation(
        frames={role: _to_frame(frame) for role, frame in document["frames"].items()},
        instruction=document["instruction"],
        joints=None
        if joints is None
        else JointSample(
            names=tuple(joints[0]), position=joints[1], velocity=joints[2], stamp_ns=joints[3]
        ),
        ee_pose=None
        if pose is None
        else Pose(position_m=pose[0], quaternion_xyzw=pose[1], stamp_ns=pose[2]),
        gripper_open=document["gripper_open"],
        stamp_ns=document["stamp_ns"],
    )


def _to_frame(document: Document) -> Frame:
    known = document["calibration"]
    calibration = None
    if known is not None:
        calibration = CameraCalibration(
            intrinsics=known[0], mount=known[1], T_mount_camera=known[2]
        )
    return Frame(
        camera=document["camera"],
        image=document["image"],
        stamp_ns=document["stamp_ns"],
        frame_id=document["frame_id"],
        calibration=calibration,
    )


def from_answer(answer: ActionChunk | RoboNeuronError) -> Document:
    """What is sent of a chunk, or of an error."""
    if isinstance(answer, RoboNeuronError):
        return {"error": answer.code, "message": answer.message, "hint": answer.hint}
    metrics = {name: float(value) for name, value in answer.metrics.items()}
    space = answer.space
    channels = [[c.name, c.unit, c.frame, c.arm] for c in space.channels]
    return {
        "actions": answer.actions,
        "space": [space.kind, space.rate_hz, channels],
        "step_s": answer.step_s,
        "metrics": metrics,
        "note": answer.note,
    }


def to_answer(document: Document) -> ActionChunk:
    """The chunk that was sent.

    Raises:
        RoboNeuronError: the error that was sent instead.
        KeyError, TypeError, ValueError: neither.
    """
    if "error" in document:
        raise _ERRORS.get(document["error"], PluginError)(
            str(document["message"]), hint=str(document["hint"])
        )
    return ActionChunk(
        actions=document["actions"],
        step_s=document["step_s"],
        metrics=document["metrics"],
        note=document["note"],
        space=_to_space(*document["space"]),
    )


def _to_space(kind: str, rate_hz: float, channels: list[list[str]]) -> ControlSpace:
    """The space that was sent; the default is the contract's own object."""
    space = ControlSpace(
        kind=kind,
        channels=tuple(
            roboneuron.Channel(name=name, unit=unit, frame=frame, arm=arm)
            for name, unit, frame, arm in channels
        ),
        rate_hz=rate_hz,
    )
    return EE_DELTA if space == EE_DELTA else space

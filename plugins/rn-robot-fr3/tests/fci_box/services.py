"""TCP requests that the box refuses, with the status that the real one is reported to return."""

from __future__ import annotations

import struct
from math import isfinite

from fci_box import wire
from fci_box.wire import Service

_LARGEST = 1e4
_HEAVIEST_KG = 10.0
_LEAST_MOVE_BYTES = 56
"""Newer clients append data for asynchronous motions."""
_DOUBLES = {
    Service.SET_COLLISION_BEHAVIOR: 52,
    Service.SET_JOINT_IMPEDANCE: 7,
    Service.SET_CARTESIAN_IMPEDANCE: 6,
    Service.SET_EE_TO_K: 16,
    Service.SET_NE_TO_EE: 16,
    Service.SET_LOAD: 13,
}
_TORQUES, _FORCES = 7, 6


def refusal(service: int, payload: bytes, mode: int, is_latched: bool) -> bytes | None:
    """The payload of a refusal, or None to forward the request.

    Args:
        service: value of `Service`.
        payload: data after the header.
        mode: mode of the newest state.
        is_latched: settings are refused until an error recovery, in any mode.
    """
    if service in wire.SETTERS:
        if mode != wire.IDLE or is_latched:
            return _status(wire.NOT_POSSIBLE)
        return None if is_valid(service, payload) else _status(wire.INVALID_ARGUMENT)
    if service == Service.MOVE:
        if mode != wire.IDLE or is_latched:
            return _status(wire.MOVE_NOT_POSSIBLE)
        return None if len(payload) >= _LEAST_MOVE_BYTES else _status(wire.MOVE_INVALID)
    if service == Service.AUTOMATIC_ERROR_RECOVERY and mode in (
        wire.OTHER,
        wire.GUIDING,
        wire.USER_STOPPED,
    ):
        return _status(wire.NOT_POSSIBLE)
    return None


def is_valid(service: int, payload: bytes) -> bool:
    """True if the arguments of a setter are valid."""
    if service == Service.SET_GUIDING_MODE:
        return len(payload) == 7
    count = _DOUBLES[Service(service)]
    if len(payload) != 8 * count:
        return False
    values = struct.unpack(f"<{count}d", payload)
    if not all(isfinite(value) and abs(value) < _LARGEST for value in values):
        return False
    if service == Service.SET_LOAD:
        inertia = values[4:]
        return 0.0 <= values[0] <= _HEAVIEST_KG and (inertia[1], inertia[2], inertia[5]) == (
            inertia[3],
            inertia[6],
            inertia[7],
        )
    if service == Service.SET_COLLISION_BEHAVIOR:
        torques, forces = values[: 4 * _TORQUES], values[4 * _TORQUES :]
        return _are_thresholds(torques, _TORQUES) and _are_thresholds(forces, _FORCES)
    return True


def _are_thresholds(values: tuple[float, ...], size: int) -> bool:
    """True for lower and upper values while accelerating, then lower and upper otherwise: positive,
    with lower <= upper.
    """
    parts = [values[begin : begin + size] for begin in range(0, 4 * size, size)]
    is_ordered = all(
        low <= high for pair in (parts[:2], parts[2:]) for low, high in zip(*pair, strict=True)
    )
    return is_ordered and min(values) > 0.0


def _status(code: int) -> bytes:
    return struct.pack("<B3x", code)

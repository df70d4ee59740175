"""The FCI's messages, protocol version 10, as far as the box uses them.

Source: research_interface/robot/{rbk_types,service_types}.h of libfranka 0.18, as transcribed in
franka-sim 1.1.7.
"""

from __future__ import annotations

import struct
from enum import IntEnum

PORT = 1337
HEADER = struct.Struct("<III")
"""TCP header: command, number, size including this header."""
STATE_BYTES, COMMAND_BYTES = 1377, 371
_ID = struct.Struct("<Q")
_DESIRED = struct.Struct("<7f")
_Q_D, _DQ_D, _DDQ_D = 624, 680, 708
_GENERATOR, _MODE = 1288, 1372
_Q_C = struct.Struct("<7d")
_FINISHED = 313


class Service(IntEnum):
    """Commands of the TCP connection."""

    CONNECT = 0
    MOVE = 1
    STOP_MOVE = 2
    SET_COLLISION_BEHAVIOR = 3
    SET_JOINT_IMPEDANCE = 4
    SET_CARTESIAN_IMPEDANCE = 5
    SET_GUIDING_MODE = 6
    SET_EE_TO_K = 7
    SET_NE_TO_EE = 8
    SET_LOAD = 9
    AUTOMATIC_ERROR_RECOVERY = 10
    GET_ROBOT_MODEL = 11


SETTERS = frozenset(range(Service.SET_COLLISION_BEHAVIOR, Service.SET_LOAD + 1))
NOT_POSSIBLE, INVALID_ARGUMENT = 1, 2
"""Status of setters and of the recovery."""
MOVE_NOT_POSSIBLE, MOVE_INVALID = 5, 7
OTHER, IDLE, MOVE, GUIDING, REFLEX, USER_STOPPED, RECOVERING = range(7)
"""Robot modes."""


def message_id(datagram: bytes) -> int:
    """Number of a state, or of the state that a command answers."""
    number: int = _ID.unpack_from(datagram)[0]
    return number


def desired(state: bytes) -> list[float]:
    """q_d of a state."""
    return list(_DESIRED.unpack_from(state, _Q_D))


def with_desired(
    state: bytes, position: list[float], velocity: list[float], acceleration: list[float]
) -> bytes:
    """Return the state with other q_d, dq_d and ddq_d."""
    changed = bytearray(state)
    for offset, values in ((_Q_D, position), (_DQ_D, velocity), (_DDQ_D, acceleration)):
        _DESIRED.pack_into(changed, offset, *values)
    return bytes(changed)


def is_following(state: bytes) -> bool:
    """True if the state shows a joint position motion."""
    return state[_GENERATOR] == 1 and state[_MODE] == MOVE


def robot_mode(state: bytes) -> int:
    """Robot mode of a state."""
    return state[_MODE]


def position(command: bytes) -> list[float]:
    """q_c of a command."""
    return list(_Q_C.unpack_from(command, 8))


def is_finish(command: bytes) -> bool:
    """True if a command ends the motion."""
    return command[_FINISHED] == 1

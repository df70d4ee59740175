"""What the simulation tells its cameras: one message with everything that is needed to draw it.

`std_msgs/Float64MultiArray`: the label of the only dimension describes the scene as JSON, the data
are stamp (seconds, nanoseconds), joints in the order of `JOINTS`, then position and quaternion
(x y z w) of each cube.
"""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from std_msgs.msg import Float64MultiArray, MultiArrayDimension

from rn_robot_lerobot.arm import JOINTS, NAME
from rn_simulation.cubes import RGBA_BY_COLOUR
from roboneuron import InvalidInputError

F64 = NDArray[np.float64]

TOPIC = "sim/state"
_NANOSECONDS = 1_000_000_000
_POSE_SIZE = 7


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class SceneState:
    """The simulated cell at one moment.

    Attributes:
        cubes: name and edge [m] of each cube.
        joints: float64 (6,), in the order of `JOINTS` [rad].
        cube_poses: float64 (n, 7), position [m] and quaternion x y z w in the base frame, in the
            order of `cubes`.
        stamp_ns: ROS time of this moment [ns].
    """

    cubes: tuple[tuple[str, float], ...]
    joints: F64
    cube_poses: F64
    stamp_ns: int


def to_message(state: SceneState) -> Float64MultiArray:
    """The message that carries `state`."""
    message = Float64MultiArray()
    values = [*divmod(state.stamp_ns, _NANOSECONDS), *state.joints, *state.cube_poses.ravel()]
    message.data = [float(value) for value in values]
    label = json.dumps({"robot": NAME, "cubes": state.cubes}, separators=(",", ":"))
    message.layout.dim = [MultiArrayDimension(label=label, size=len(values), stride=len(values))]
    return message


def from_message(message: Float64MultiArray) -> SceneState:
    """The state that `message` carries.

    Raises:
        InvalidInputError: not a message of `to_message`, or values that are not finite.
    """
    try:
        described = json.loads(message.layout.dim[0].label)
        robot = described["robot"]
        cubes = tuple((str(name), float(edge_m)) for name, edge_m in described["cubes"])
    except (IndexError, KeyError, TypeError, ValueError) as error:
        raise InvalidInputError(
            f"A message on {TOPIC!r} does not describe a scene: {error}."
        ) from error
    unknown = [name for name, _ in cubes if name not in RGBA_BY_COLOUR]
    if robot != NAME or unknown:
        what = f"the robot {robot!r}" if robot != NAME else f"a cube {unknown[0]!r}"
        raise InvalidInputError(f"A message on {TOPIC!r} names {what}, which is not known.")
    values = np.array(message.data, dtype=np.float64)
    expected = 2 + len(JOINTS) + _POSE_SIZE * len(cubes)
    if values.shape != (expected,) or not np.isfinite(values).all():
        raise InvalidInputError(
            f"A message on {TOPIC!r} holds {values.size} values, expected {expected} finite ones."
        )
    poses = values[2 + len(JOINTS) :]
    return SceneState(
        cubes=cubes,
        joints=values[2 : 2 + len(JOINTS)],
        cube_poses=poses.reshape(len(cubes), _POSE_SIZE),
        stamp_ns=int(values[0]) * _NANOSECONDS + int(values[1]),
    )

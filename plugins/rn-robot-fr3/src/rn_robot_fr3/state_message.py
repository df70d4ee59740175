"""What the simulation tells its cameras: one message with everything that is needed to draw it.

`std_msgs/Float64MultiArray`: the label of the only dimension describes the scene as JSON, the data
are stamp (seconds, nanoseconds), joints in the order of the cell's `joints`, then position and
quaternion (x y z w) of each cube.
"""

from __future__ import annotations

import json
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from std_msgs.msg import Float64MultiArray, MultiArrayDimension

from rn_robot_fr3.cell import CELLS, FR3
from rn_simulation.cubes import RGBA_BY_COLOUR
from rn_simulation.engine import ENGINES, Engine
from roboneuron import InvalidInputError

F64 = NDArray[np.float64]

TOPIC = "sim/state"
HANDED_OVER_TOPIC = "sim/handed_over"
"""std_msgs/Float64: for how long a cube has been handed over [s]; of cells with several arms."""
_NANOSECONDS = 1_000_000_000
_POSE_SIZE = 7


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class SceneState:
    """The simulated cell at one moment.

    Attributes:
        robot: whose arms stand there, a key of `CELLS`.
        engine: that moves it, and is to draw it.
        seed: of the scene.
        cubes: name and edge [m] of each cube.
        joints: float64 (9 for each arm,), in the order of the cell's `joints` [rad, m].
        cube_poses: float64 (n, 7), position [m] and quaternion x y z w in the base frame, in the
            order of `cubes`.
        stamp_ns: ROS time of this moment [ns].
    """

    robot: str = FR3.robot
    engine: Engine
    seed: int
    cubes: tuple[tuple[str, float], ...]
    joints: F64
    cube_poses: F64
    stamp_ns: int


def to_message(state: SceneState) -> Float64MultiArray:
    """The message that carries `state`."""
    message = Float64MultiArray()
    values = [*divmod(state.stamp_ns, _NANOSECONDS), *state.joints, *state.cube_poses.ravel()]
    message.data = [float(value) for value in values]
    label = json.dumps(
        {
            "robot": state.robot,
            "engine": state.engine,
            "seed": state.seed,
            "cubes": state.cubes,
        },
        separators=(",", ":"),
    )
    message.layout.dim = [MultiArrayDimension(label=label, size=len(values), stride=len(values))]
    return message


def from_message(message: Float64MultiArray) -> SceneState:
    """The state that `message` carries.

    Raises:
        InvalidInputError: not a message of `to_message`, or values that are not finite.
    """
    try:
        described = json.loads(message.layout.dim[0].label)
        cell = CELLS[described["robot"]]
        engine = ENGINES[ENGINES.index(described["engine"])]
        seed = int(described["seed"])
        cubes = tuple((str(name), float(edge_m)) for name, edge_m in described["cubes"])
    except (IndexError, KeyError, TypeError, ValueError) as error:
        raise InvalidInputError(
            f"A message on {TOPIC!r} does not describe a scene: {error}."
        ) from error
    strange = [name for name, _ in cubes if name not in RGBA_BY_COLOUR]
    if strange:
        raise InvalidInputError(
            f"A message on {TOPIC!r} names a cube {strange[0]!r}, which has no known colour."
        )
    values = np.array(message.data, dtype=np.float64)
    count = len(cell.joints)
    expected = 2 + count + _POSE_SIZE * len(cubes)
    if values.shape != (expected,) or not np.isfinite(values).all():
        raise InvalidInputError(
            f"A message on {TOPIC!r} holds {values.size} values, expected {expected} finite ones."
        )
    return SceneState(
        robot=cell.robot,
        engine=engine,
        seed=seed,
        cubes=cubes,
        joints=values[2 : 2 + count],
        cube_poses=values[2 + count :].reshape(len(cubes), _POSE_SIZE),
        stamp_ns=int(values[0]) * _NANOSECONDS + int(values[1]),
    )

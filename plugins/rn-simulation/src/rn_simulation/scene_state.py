"""Message from the simulation of an arm to its cameras, with everything needed to render it.

`std_msgs/Float64MultiArray`: the label of the only dimension describes the scene as JSON; the data
are stamp (seconds, nanoseconds), joints in the order of the cell's `joints`, then position and
quaternion (x y z w) of each cube.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from std_msgs.msg import Float64MultiArray, MultiArrayDimension

from rn_simulation.cubes import RGBA_BY_COLOUR, Cube
from rn_simulation.engine import ENGINES, Engine
from rn_simulation.ground_truth import CubeState
from roboneuron import (
    ForeignDataError,
    InvalidInputError,
    foreign,
)

F64 = NDArray[np.float64]

TOPIC = "sim/state"
HANDED_OVER_TOPIC = "sim/handed_over"
"""std_msgs/Float64: time since the handover of a cube [s]; in cells with several arms."""
_NANOSECONDS = 1_000_000_000
_POSE_SIZE = 7
_MOST_LABEL = 65_536
_FAR_S = 1e12


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class SceneState:
    """State of a simulated cell at one time.

    Attributes:
        robot: name of the robot.
        engine: engine of the simulation, also used for rendering.
        seed: seed of the scene.
        cubes: name and edge [m] of each cube.
        joints: float64 (n,), in the order of the cell's `joints` [rad, m].
        cube_poses: float64 (n, 7), position [m] and quaternion x y z w in the base frame, in the
            order of `cubes`.
        stamp_ns: ROS time of the state [ns].
    """

    robot: str
    engine: Engine
    seed: int
    cubes: tuple[tuple[str, float], ...]
    joints: F64
    cube_poses: F64
    stamp_ns: int


def at_rest(cubes: Sequence[Cube]) -> F64:
    """Start poses of cubes, as `SceneState.cube_poses`."""
    return np.array(
        [
            (c.x_m, c.y_m, c.edge_m / 2, 0.0, 0.0, math.sin(c.yaw_rad / 2), math.cos(c.yaw_rad / 2))
            for c in cubes
        ]
    )


def poses_of(cubes: Mapping[str, CubeState]) -> F64:
    """Current poses of cubes, as `SceneState.cube_poses`."""
    return np.array([np.concatenate([c.position_m, c.quaternion_xyzw]) for c in cubes.values()])


def to_message(state: SceneState) -> Float64MultiArray:
    """Convert `state` to a message."""
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


def from_message(message: Float64MultiArray, joint_counts: Mapping[str, int]) -> SceneState:
    """Convert a message to a state.

    Args:
        message: created by `to_message`.
        joint_counts: number of moving joints of each supported robot.

    Raises:
        InvalidInputError: another kind of message, another robot, or non-finite values.
    """
    try:
        label = message.layout.dim[0].label if message.layout.dim else ""
        described = foreign.decode_json(label, "the label", most_bytes=_MOST_LABEL)
        robot = foreign.text(foreign.field(described, "robot"), "robot")
        named = foreign.choice(foreign.field(described, "engine"), "engine", ENGINES)
        engine = ENGINES[ENGINES.index(named)]
        seed = foreign.integer(foreign.field(described, "seed"), "seed")
        listed = foreign.items(foreign.field(described, "cubes"), "cubes", most=256)
        pairs = [foreign.items(pair, "a cube", least=2, most=2) for pair in listed]
        cubes = tuple(
            (foreign.text(name, "a cube"), foreign.number(edge_m, "an edge", 0.0))
            for name, edge_m in pairs
        )
    except ForeignDataError as error:
        raise InvalidInputError(
            f"A message on {TOPIC!r} does not describe a scene: {error}."
        ) from error
    unknown = [name for name, _ in cubes if name not in RGBA_BY_COLOUR]
    if robot not in joint_counts or unknown:
        is_cube = robot in joint_counts
        what = f"a cube {unknown[0]!r}" if is_cube else f"the robot {robot!r}"
        raise InvalidInputError(f"A message on {TOPIC!r} names {what}, which is not known.")
    values = np.array(message.data, dtype=np.float64)
    count = joint_counts[robot]
    expected = 2 + count + _POSE_SIZE * len(cubes)
    is_finite = np.isfinite(values).all() and (np.abs(values[:2]) < _FAR_S).all()
    if values.shape != (expected,) or not is_finite:
        raise InvalidInputError(
            f"A message on {TOPIC!r} holds {values.size} values, expected {expected} finite ones."
        )
    return SceneState(
        robot=robot,
        engine=engine,
        seed=seed,
        cubes=cubes,
        joints=values[2 : 2 + count],
        cube_poses=values[2 + count :].reshape(len(cubes), _POSE_SIZE),
        stamp_ns=int(values[0]) * _NANOSECONDS + int(values[1]),
    )

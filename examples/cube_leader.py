"""A scripted leader arm: it demonstrates how the simulated FR3 picks up a red cube, and puts the
cube elsewhere between two demonstrations. With `record_lerobot.py`, `lerobot-record` follows it.

It gets the cube's position from the simulator. Motions are planned once, at their start, by the
teacher of the cubes policy, as rows of joint positions.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rn_controller_urdf.controller import UrdfController
from rn_policy_cubes.teacher import Situations, act, after, tilt_of, yaw_of
from rn_robot_fr3.cell import FR3
from rn_robot_fr3.profile import HOME_RAD, profile
from rn_robot_fr3.scene import REGION_X_M, REGION_Y_M
from roboneuron import (
    Action,
    Hold,
    JointSample,
    NotReadyError,
    joints_from_message,
    matrix_from_quaternion,
)
from roboneuron.command import RosLink, qos

F64 = NDArray[np.float64]

ROW_S = 0.16
"""Duration of one row of a motion [s]; limits the speed to 0.19 m/s."""
_LEASH_RAD = 0.12
"""The leader waits for an arm that lags more than this, because control refuses a step of 0.1 m."""
_PLANNED_S = 0.1
"""Duration of a row for the teacher [s]."""
DEMONSTRATION_ROWS = 70
LIFTED_M = 0.10
"""Height at which a cube counts as picked up."""
_TELL_S = 0.02
_REACHED = 0.93
"""As in the teacher: its actions move the arm by this share."""
_FINGERS_PER_ROW = 0.13
_STEP_M, _TURN_RAD, _JOINT_RAD = 0.03, 0.15, 0.09
"""Largest displacement and rotation of the TCP per row, and of a joint on its way home."""
_PLACE_M, _ABOVE_M = 0.024, 0.15
"""TCP height for releasing the cube, and before and after."""
_KICKED_SHARE, _KICK_M, _KICK_RAD = 0.6, 0.016, 0.08
"""Share of the demonstrations that are pushed off their path, and the push per row, so that the
policy learns to return.
"""
_KICK_HEIGHT_M, _LONGEST_M = 0.14, 0.045
"""Lowest TCP height for a push, and the largest displacement per row with it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class CubePlace:
    """Pose of the cube.

    Attributes:
        position_m: centre in the base frame, float64 (3,).
        yaw_rad: yaw of any of its side faces.
        edge_m: edge length.
    """

    position_m: F64
    yaw_rad: float
    edge_m: float


class LeaderArm:
    """Joint positions of the leader, moved by TCP deltas."""

    def __init__(self, joints: Mapping[str, float], *, holds: bool = False) -> None:
        """Start at measured positions [rad, m]; `holds` closes the gripper, because at their
        measured position the fingers would not press.
        """
        robot = profile()
        assert robot.gripper is not None  # the FR3 has one
        self._gripper = robot.gripper
        self._controller = UrdfController(None, robot)
        self._controller.load()
        self.names = (*robot.arm_joints, self._gripper.joint)
        self._positions = np.array([joints[name] for name in self.names])
        if holds:
            self._positions[-1] = self._gripper.to_position(0.0)
        self._open = self._gripper.to_opening(float(self._positions[-1]))
        self.rows = [self._positions.copy()]

    @property
    def opening(self) -> float:
        """Opening of the gripper, 0 closed .. 1 open."""
        return self._open

    def tcp(self) -> tuple[F64, F64]:
        """TCP position [m], float64 (3,), and rotation (3, 3) in the base frame."""
        pose = self._controller.forward(self._sample())
        return pose.position_m, matrix_from_quaternion(pose.quaternion_xyzw)

    def move(self, delta: F64, gripper_open: float) -> None:
        """Add a row: move the TCP by `delta` (6,) [m, rad], and the fingers towards an opening.

        Raises:
            NotReadyError: the arm cannot go there.
        """
        change = np.clip(gripper_open - self._open, -_FINGERS_PER_ROW, _FINGERS_PER_ROW)
        # a grasp must press, so the commanded opening is that of the hand, not of the cube
        self._open = float(self._open + change)
        action = Action.from_vector(np.append(delta, self._open))
        command = self._controller.compute(action, self._sample(), _PLANNED_S)
        if isinstance(command, Hold):
            raise NotReadyError(f"The leader cannot go on: {command.reason}")
        by_name = dict(zip(command.names, command.position.tolist(), strict=True))
        self._keep(np.array([by_name[name] for name in self.names]))

    def go_home(self) -> None:
        """Add rows that end at home with an open gripper."""
        home = np.append(HOME_RAD, self._gripper.to_position(1.0))
        way = home - self._positions
        count = max(1, math.ceil(float(np.abs(way).max()) / _JOINT_RAD))
        start = self._positions.copy()
        for share in np.linspace(0.0, 1.0, count + 1)[1:]:
            # smooth at both ends
            self._keep(start + way * (0.5 - 0.5 * math.cos(math.pi * share)))

    def _keep(self, positions: F64) -> None:
        self._positions = positions
        self.rows.append(positions)

    def _sample(self) -> JointSample:
        return JointSample(names=self.names, position=self._positions, stamp_ns=0)


def demonstrate(joints: Mapping[str, float], cube: CubePlace, random: np.random.Generator) -> F64:
    """Plan rows (n, 8) of joint positions, in the order of `LeaderArm.names`, that pick up the
    cube.
    """
    arm = LeaderArm(joints)
    position, rotation = arm.tcp()
    now = Situations(
        tcp_m=position[None],
        yaw_rad=np.array([yaw_of(rotation)]),
        tilt_rad=tilt_of(rotation[None]),
        opening=np.array([arm.opening]),
        cube_m=cube.position_m[None],
        cube_yaw_rad=np.array([cube.yaw_rad]),
        edge_m=np.array([cube.edge_m]),
    )
    kicked = range(0)
    if random.random() < _KICKED_SHARE:
        begin = int(random.integers(3, 11))
        kicked = range(begin, begin + int(random.integers(2, 5)))
    kick = np.concatenate(
        [random.normal(0.0, _KICK_M, 3), [0.0, 0.0, random.normal(0.0, _KICK_RAD)]]
    )
    for row in range(DEMONSTRATION_ROWS):
        action = act(now)
        if row in kicked and now.tcp_m[0, 2] > _KICK_HEIGHT_M:
            action[0, :6] += kick
            length_m = float(np.linalg.norm(action[0, :3]))
            action[0, :3] *= min(1.0, _LONGEST_M / length_m)
        arm.move(_REACHED * action[0, :6], float(action[0, 6]))
        now = after(now, action)
    return np.array(arm.rows)


def put_elsewhere(joints: Mapping[str, float], random: np.random.Generator) -> F64:
    """Plan rows as `demonstrate` does that put a held cube at a random position, and end at
    home.
    """
    arm = LeaderArm(joints, holds=True)
    place = np.array([random.uniform(*REGION_X_M), random.uniform(*REGION_Y_M)])
    turn_rad = float(random.uniform(-math.pi / 4.0, math.pi / 4.0))
    for height_m, gripper_open in ((_ABOVE_M, 0.0), (_PLACE_M, 0.0)):
        turn_rad = _go(arm, np.append(place, height_m), turn_rad, gripper_open)
    for _ in range(math.ceil(1.0 / _FINGERS_PER_ROW)):
        arm.move(np.zeros(6), 1.0)
    _go(arm, np.append(place, _ABOVE_M), 0.0, 1.0)
    arm.go_home()
    return np.array(arm.rows)


def _go(arm: LeaderArm, goal_m: F64, turn_rad: float, gripper_open: float) -> float:
    """Move straight to a position while turning; return the remaining rotation, zero."""
    while True:
        position, _ = arm.tcp()
        way = goal_m - position
        length = float(np.linalg.norm(way))
        if length < 1e-3 and abs(turn_rad) < 1e-3:
            return 0.0
        turn = float(np.clip(turn_rad, -_TURN_RAD, _TURN_RAD))
        turn_rad -= turn
        way *= min(1.0, _STEP_M / max(length, 1e-9))
        arm.move(np.array([*way, 0.0, 0.0, turn]), gripper_open)


class CubeLeader:
    """Publishes the leader's joint states at 50 Hz, from `open` to `close`."""

    def __init__(self, seed: int, topic: str = "/leader/joint_states") -> None:
        """Args:
        seed: seed of the positions and of the pushes.
        topic: topic of its joint states, sensor_msgs/JointState.
        """
        self._random = np.random.default_rng([seed, 0x6C65])
        self._topic = topic
        self._link = RosLink("cube_leader")
        self._lock = threading.Lock()
        self._joints: dict[str, float] = {}
        self._cube: CubePlace | None = None
        self._rows: F64 | None = None
        self._at = 0.0
        self._end = threading.Event()
        self._thread: threading.Thread | None = None

    def open(self) -> None:
        """Join the graph; needs `prepare_environment`."""
        from sensor_msgs.msg import JointState
        from std_msgs.msg import Float64MultiArray

        link = self._link
        link.open()
        link.subscribe(JointState, "/fr3/joint_states", self._take_joints, qos.NEWEST)
        link.subscribe(Float64MultiArray, "/fr3/sim/state", self._take_state, qos.NEWEST)
        self._publish = link.advertise(JointState, self._topic, qos.NEWEST)
        self._thread = threading.Thread(target=self._lead, name="cube-leader", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Leave the graph."""
        self._end.set()
        if self._thread is not None:
            self._thread.join()
        self._link.close()

    def cube(self) -> CubePlace:
        """Pose of the cube from the simulator. Raises NotReadyError before the first one."""
        with self._lock:
            cube = self._cube
        if cube is None:
            raise NotReadyError("The simulator has not told where the cube is.")
        return cube

    def demonstrate(self) -> None:
        """Start to pick up the cube."""
        self._play(demonstrate(self._measured(), self.cube(), self._random))

    def put_elsewhere(self) -> None:
        """Start to put it at another position; a cube that is not held stays where it is."""
        self._play(put_elsewhere(self._measured(), self._random))

    def _measured(self) -> dict[str, float]:
        with self._lock:
            return dict(self._joints)

    def _play(self, rows: F64) -> None:
        with self._lock:
            self._rows, self._at = rows, 0.0

    def _lead(self) -> None:
        from sensor_msgs.msg import JointState

        robot = profile()
        assert robot.gripper is not None
        names = [*robot.arm_joints, robot.gripper.joint]
        told_s = time.monotonic()
        while not self._end.wait(_TELL_S):
            since_s, told_s = time.monotonic() - told_s, time.monotonic()
            with self._lock:
                if not self._joints:
                    continue
                measured = np.array([self._joints[name] for name in names])
                rows = self._rows if self._rows is not None else measured[None]
                behind_rad = np.abs(_between(rows, self._at) - measured)[:-1].max()
                if behind_rad < _LEASH_RAD:
                    self._at += since_s / ROW_S
                row = _between(rows, self._at)
            self._publish(JointState(name=names, position=row.tolist()))

    def _take_joints(self, message: object) -> None:
        sample = joints_from_message(message)
        with self._lock:
            self._joints = dict(zip(sample.names, sample.position.tolist(), strict=True))

    def _take_state(self, message: object) -> None:
        from rn_simulation.scene_state import from_message

        state = from_message(message, {FR3.robot: len(FR3.joints)})
        (_, edge_m), pose = state.cubes[0], state.cube_poses[0]
        cube = CubePlace(
            position_m=pose[:3], yaw_rad=yaw_of(matrix_from_quaternion(pose[3:])), edge_m=edge_m
        )
        with self._lock:
            self._cube = cube


def _between(rows: F64, at: float) -> F64:
    """Interpolated row at the index `at`; the last row at the end."""
    below = min(int(at), len(rows) - 1)
    above = min(below + 1, len(rows) - 1)
    return np.asarray(rows[below] + min(at - below, 1.0) * (rows[above] - rows[below]))

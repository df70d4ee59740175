"""The physics of the FR3 cell, stepped by hand: tests and benchmarks run it faster than real
time.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rn_robot_fr3.cameras import cell_cameras
from rn_robot_fr3.cell import FR3, MOVED, Cell
from rn_robot_fr3.limits import (
    ACCELERATION_RAD_S2,
    ARM_JOINTS,
    EFFORT_NM,
    FINGER_OPEN_M,
    FINGER_VELOCITY_M_S,
    LOWER_RAD,
    UPPER_RAD,
    VELOCITY_RAD_S,
)
from rn_robot_fr3.profile import HOME_RAD
from rn_robot_fr3.scene import random_cubes
from rn_robot_fr3.world import JOINTS, ArmWorld, build_world
from rn_simulation.command import checked
from rn_simulation.cubes import DEFAULT_COLOURS
from rn_simulation.engine import EngineChoice, choose_engine
from rn_simulation.ground_truth import CubeState, LiftClock
from rn_simulation.pinhole import DEFAULT_SIZE_PX
from rn_simulation.setpoint import JointSetpoint
from roboneuron import InvalidInputError, JointCommand, Pose, StateError, quaternion_from_matrix

F64 = NDArray[np.float64]

STEP_S = 1.0 / 240.0
"""Physics step [s]."""
COMMANDED = MOVED
"""Joints of one arm that a command may name."""
_FINGER, _EVERY = len(ARM_JOINTS), len(MOVED)
"""Place of an arm's finger, and number of its values, in arrays of what is commanded."""
_FINGER_ACCELERATION_M_S2 = 1.0
_FINGER_FORCE_N = 40.0
"""Grasping force of the simulated gripper: well above what a wooden cube needs, below what squeezes
it through.
"""
_JUDGE_EVERY = 4


class ArmSimulation:
    """Simulated FR3s at a table with coloured cubes, one unless the cell says otherwise; used from
    one thread.

    Use it as a context manager, or call `open` and `close`. The scene depends on `seed` and
    `colours` only, and the same calls give the same motion in the same engine.
    """

    def __init__(
        self,
        seed: int = 0,
        *,
        colours: Sequence[str] = DEFAULT_COLOURS,
        engine: EngineChoice = "auto",
        gui: bool = False,
        cell: Cell = FR3,
    ) -> None:
        """Choose scene and engine.

        Raises:
            ConfigurationError: unknown colours, too many cubes, or the engine is not installed.
        """
        self.seed = seed
        self.engine = choose_engine(engine)
        self.scene = random_cubes(seed, colours)
        self._gui = gui
        self.cell = cell
        self._cameras = {camera.name: camera for camera in cell_cameras(cell)}
        self._world: ArmWorld | None = None
        self._lower = self._each_arm(*LOWER_RAD, 0.0)
        self._upper = self._each_arm(*UPPER_RAD, FINGER_OPEN_M)
        self._reset_clock()

    def _each_arm(self, *values: float) -> F64:
        """The same values for each arm, one after the other."""
        return np.tile(np.array(values), len(self.cell.mounts))

    def _reset_clock(self) -> None:
        self.steps = 0
        self._lifts = LiftClock(self.scene, [mount.name for mount in self.cell.mounts])
        self._setpoint = JointSetpoint(
            self._each_arm(*HOME_RAD, FINGER_OPEN_M),
            self._each_arm(*VELOCITY_RAD_S, FINGER_VELOCITY_M_S),
            self._each_arm(*ACCELERATION_RAD_S2, _FINGER_ACCELERATION_M_S2),
        )

    def __enter__(self) -> ArmSimulation:
        self.open()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def open(self) -> None:
        """Build the world with the robot at home and the gripper open.

        Raises:
            StateError: it is open already.
            ConfigurationError: a window is asked for and there is no display.
        """
        if self._world is not None:
            raise StateError("The simulation is open already.")
        self._reset_clock()
        self._world = build_world(self.engine, self.scene, gui=self._gui, cell=self.cell)
        self._world.set_joints(self._each_arm(*HOME_RAD, FINGER_OPEN_M, FINGER_OPEN_M).tolist())
        force = self._each_arm(*EFFORT_NM, _FINGER_FORCE_N, _FINGER_FORCE_N)
        self._world.prepare_physics(STEP_S, force.tolist())

    def close(self) -> None:
        """Destroy the world; may be called twice and before `open`."""
        if self._world is not None:
            self._world.close()
            self._world = None

    @property
    def world(self) -> ArmWorld:
        """The world while it is open. Raises StateError otherwise."""
        if self._world is None:
            raise StateError(
                "The simulation is not open.", hint="Call open() or use it as a context manager."
            )
        return self._world

    @property
    def time_s(self) -> float:
        """Simulated time since `open` [s]."""
        return self.steps * STEP_S

    def step(self, count: int = 1) -> None:
        """Advance by `count` physics steps of `STEP_S`."""
        world = self.world
        for _ in range(count):
            self._setpoint.advance(STEP_S)
            position, velocity = self._setpoint.position, self._setpoint.velocity
            world.step(_with_mimics(position), _with_mimics(velocity))
            self.steps += 1
            if self.steps % _JUDGE_EVERY == 0:
                self._lifts.observe(self.time_s, world.cube_poses(), self._tcps())

    def set_target(
        self, names: Sequence[str], position: ArrayLike, duration_s: float
    ) -> JointCommand:
        """Send joints to `position` [rad, m] within `duration_s`; unnamed joints keep their target.

        Positions are clamped to the limits, and the motion takes longer where velocity or
        acceleration need it.

        Returns:
            The command as it is carried out: clamped positions, possible duration.

        Raises:
            InvalidInputError: an unknown or repeated joint, a non-finite value, a wrong size, a
                duration <= 0.
        """
        wanted = JointCommand(
            names=tuple(names),
            position=np.asarray(position, dtype=np.float64),
            duration_s=duration_s,
        )
        commanded = self.cell.commanded
        checked(wanted, commanded)
        indices = [commanded.index(name) for name in names]
        for index, value in zip(indices, wanted.position.tolist(), strict=True):
            if index % _EVERY == _FINGER:
                self._release_fingers(index // _EVERY, value)
        target = self._setpoint.target.copy()
        target[indices] = np.clip(wanted.position, self._lower[indices], self._upper[indices])
        possible_s = max(duration_s, self._setpoint.shortest_s(target, indices))
        self._setpoint.aim(target, indices, duration_s)
        return JointCommand(names=tuple(names), position=target[indices], duration_s=possible_s)

    def _release_fingers(self, arm: int, target_m: float) -> None:
        """After a grasp the setpoint lies inside the object: opening starts from where the finger
        really is.

        A command that closes keeps the setpoint, and with it the force.
        """
        measured_m = float(self.joint_positions()[arm * (_EVERY + 1) + _FINGER])
        finger = arm * _EVERY + _FINGER
        if target_m > self._setpoint.position[finger]:
            self._setpoint.position[finger] = max(
                self._setpoint.position[finger], min(measured_m, target_m)
            )

    def hold(self) -> None:
        """Brake the arms to a standstill and stay; grippers keep their targets, so that nothing is
        dropped.
        """
        commanded = range(len(self.cell.commanded))
        self._setpoint.halt([i for i in commanded if i % _EVERY != _FINGER])

    def joint_positions(self) -> F64:
        """Measured positions, float64 (9 for each arm,), in the order of the cell's
        `joints` [rad, m].
        """
        return self.joint_states()[0]

    def joint_states(self) -> tuple[F64, F64]:
        """Measured positions and velocities, each float64 (9 for each arm,), in the order of the
        cell's `joints`.
        """
        return self.world.joint_states()

    def tcp_pose(self, arm: int = 0) -> Pose:
        """TCP of the arm of that number in the base frame; `stamp_ns` is the simulated time
        [ns].
        """
        matrix = self.world.T_base_tcp(arm)
        return Pose(
            position_m=matrix[:3, 3],
            quaternion_xyzw=quaternion_from_matrix(matrix[:3, :3]),
            stamp_ns=round(self.time_s * 1e9),
        )

    def gripper_open(self) -> float:
        """Measured opening of the first arm's gripper, 0 closed .. 1 open."""
        return opening(self.joint_positions())

    def cubes(self) -> dict[str, CubeState]:
        """Where each cube is, by name: ground truth, for judging and tests only, never for a
        policy.
        """
        return self._lifts.states(self.world.cube_poses())

    def _tcps(self) -> list[F64]:
        """TCP positions of the arms, each float64 (3,)."""
        return [self.world.T_base_tcp(arm)[:3, 3] for arm in range(len(self.cell.mounts))]

    def render(
        self, camera: str, width: int = DEFAULT_SIZE_PX[0], height: int = DEFAULT_SIZE_PX[1]
    ) -> NDArray[np.uint8]:
        """What `camera` sees now: uint8 (height, width, 3) RGB.

        Raises:
            InvalidInputError: no camera of that name.
        """
        if camera not in self._cameras:
            raise InvalidInputError(
                f"Camera {camera!r} is not known, expected one of {', '.join(self._cameras)}."
            )
        return self.world.render(self._cameras[camera].calibration(width, height), width, height)


def _with_mimics(values: F64) -> list[float]:
    """Values of what is commanded, each finger's repeated for the one that mirrors it."""
    rows = values.reshape(-1, _EVERY)
    return [float(value) for value in np.hstack([rows, rows[:, -1:]]).ravel()]


def opening(position: F64) -> float:
    """Opening of the first gripper, 0 closed .. 1 open, for joint positions in the order of the
    cell's `joints`.
    """
    return float(np.clip(position[len(ARM_JOINTS)] / FINGER_OPEN_M, 0.0, 1.0))


__all__ = ["COMMANDED", "JOINTS", "STEP_S", "ArmSimulation"]

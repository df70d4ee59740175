"""The physics of the FR3 cell, stepped by hand: tests and benchmarks run it faster than real
time.
"""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rn_robot_fr3.cameras import DEFAULT_SIZE_PX, cameras
from rn_robot_fr3.command import checked
from rn_robot_fr3.ground_truth import CubeState, LiftClock
from rn_robot_fr3.limits import (
    ACCELERATION_RAD_S2,
    ARM_JOINTS,
    EFFORT_NM,
    FINGER_JOINT,
    FINGER_OPEN_M,
    FINGER_VELOCITY_M_S,
    LOWER_RAD,
    UPPER_RAD,
    VELOCITY_RAD_S,
)
from rn_robot_fr3.profile import HOME_RAD
from rn_robot_fr3.scene import DEFAULT_COLOURS, random_cubes
from rn_robot_fr3.setpoint import JointSetpoint
from rn_robot_fr3.world import JOINTS, ArmWorld, build_world
from rn_simulation.engine import EngineChoice, choose_engine
from roboneuron import InvalidInputError, JointCommand, Pose, StateError, quaternion_from_matrix

F64 = NDArray[np.float64]

STEP_S = 1.0 / 240.0
"""Physics step [s]."""
COMMANDED = (*ARM_JOINTS, FINGER_JOINT)
"""Joints that a command may name."""
_ARM = slice(0, 7)
_FINGER_ACCELERATION_M_S2 = 1.0
_FINGER_FORCE_N = 40.0
"""Grasping force of the simulated gripper: well above what a wooden cube needs, below what squeezes
it through.
"""
_JUDGE_EVERY = 4


class ArmSimulation:
    """A simulated FR3 before a table with coloured cubes; used from one thread.

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
    ) -> None:
        """Choose scene and engine.

        Raises:
            ConfigurationError: unknown colours, too many cubes, or the engine is not installed.
        """
        self.seed = seed
        self.engine = choose_engine(engine)
        self.scene = random_cubes(seed, colours)
        self._gui = gui
        self._cameras = {camera.name: camera for camera in cameras()}
        self._world: ArmWorld | None = None
        self._lower = np.array([*LOWER_RAD, 0.0])
        self._upper = np.array([*UPPER_RAD, FINGER_OPEN_M])
        self._reset_clock()

    def _reset_clock(self) -> None:
        self.steps = 0
        self._lifts = LiftClock(self.scene)
        self._setpoint = JointSetpoint(
            np.array([*HOME_RAD, FINGER_OPEN_M]),
            np.array([*VELOCITY_RAD_S, FINGER_VELOCITY_M_S]),
            np.array([*ACCELERATION_RAD_S2, _FINGER_ACCELERATION_M_S2]),
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
        self._world = build_world(self.engine, self.scene, gui=self._gui)
        self._world.set_joints([*HOME_RAD, FINGER_OPEN_M, FINGER_OPEN_M])
        self._world.prepare_physics(STEP_S, [*EFFORT_NM, _FINGER_FORCE_N, _FINGER_FORCE_N])

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
            world.step([*position, position[-1]], [*velocity, velocity[-1]])
            self.steps += 1
            if self.steps % _JUDGE_EVERY == 0:
                self._lifts.observe(self.time_s, world.cube_poses())

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
        checked(wanted)
        indices = [COMMANDED.index(name) for name in names]
        if COMMANDED.index(FINGER_JOINT) in indices:
            self._release_fingers(float(wanted.position[list(names).index(FINGER_JOINT)]))
        target = self._setpoint.target.copy()
        target[indices] = np.clip(wanted.position, self._lower[indices], self._upper[indices])
        possible_s = max(duration_s, self._setpoint.shortest_s(target, indices))
        self._setpoint.aim(target, indices, duration_s)
        return JointCommand(names=tuple(names), position=target[indices], duration_s=possible_s)

    def _release_fingers(self, target_m: float) -> None:
        """After a grasp the setpoint lies inside the object: opening starts from where the finger
        really is.

        A command that closes keeps the setpoint, and with it the force.
        """
        measured_m = float(self.joint_positions()[len(ARM_JOINTS)])
        if target_m > self._setpoint.position[-1]:
            self._setpoint.position[-1] = max(
                self._setpoint.position[-1], min(measured_m, target_m)
            )

    def hold(self) -> None:
        """Brake the arm to a standstill and stay; the gripper keeps its target, so that nothing is
        dropped.
        """
        self._setpoint.halt(_ARM)

    def joint_positions(self) -> F64:
        """Measured positions, float64 (9,), in the order of `world.JOINTS` [rad, m]."""
        return self.joint_states()[0]

    def joint_states(self) -> tuple[F64, F64]:
        """Measured positions and velocities, each float64 (9,), in the order of `world.JOINTS`."""
        return self.world.joint_states()

    def tcp_pose(self) -> Pose:
        """Pose of the TCP in the base frame; `stamp_ns` is the simulated time [ns]."""
        matrix = self.world.T_base_tcp()
        return Pose(
            position_m=matrix[:3, 3],
            quaternion_xyzw=quaternion_from_matrix(matrix[:3, :3]),
            stamp_ns=round(self.time_s * 1e9),
        )

    def gripper_open(self) -> float:
        """Measured opening, 0 closed .. 1 open."""
        return opening(self.joint_positions())

    def cubes(self) -> dict[str, CubeState]:
        """Where each cube is, by name: ground truth, for judging and tests only, never for a
        policy.
        """
        return self._lifts.states(self.world.cube_poses())

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


def opening(position: F64) -> float:
    """Gripper opening, 0 closed .. 1 open, for joint positions (9,) in the order of
    `world.JOINTS`.
    """
    return float(np.clip(position[len(ARM_JOINTS)] / FINGER_OPEN_M, 0.0, 1.0))


__all__ = ["COMMANDED", "JOINTS", "STEP_S", "ArmSimulation"]

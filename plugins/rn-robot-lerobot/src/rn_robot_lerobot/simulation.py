"""The physics of the SO-101's cell, stepped by hand: tests run it faster than real time."""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rn_robot_lerobot.arm import (
    ACCELERATION_RAD_S2,
    GRIPPER_JOINT,
    HOME_RAD,
    JAW_ACCELERATION_RAD_S2,
    JAW_CLOSED_RAD,
    JAW_OPEN_RAD,
    JAW_VELOCITY_RAD_S,
    JOINTS,
    LOWER_RAD,
    UPPER_RAD,
    VELOCITY_RAD_S,
)
from rn_robot_lerobot.cameras import cameras
from rn_robot_lerobot.scene import DEFAULT_COLOURS, LIFTED_M, random_cubes
from rn_robot_lerobot.world import STEP_S, So101World
from rn_simulation.command import checked
from rn_simulation.ground_truth import CubeState, LiftClock
from rn_simulation.pinhole import DEFAULT_SIZE_PX
from rn_simulation.setpoint import JointSetpoint
from roboneuron import InvalidInputError, JointCommand, StateError

F64 = NDArray[np.float64]

LOWER = np.array((*LOWER_RAD, JAW_CLOSED_RAD))
UPPER = np.array((*UPPER_RAD, JAW_OPEN_RAD))
START = np.array((*HOME_RAD, JAW_OPEN_RAD))
"""Where the simulation begins: at home with an open gripper [rad]."""
_JAW = JOINTS.index(GRIPPER_JOINT)
_JUDGE_EVERY = 4


def new_setpoint(position: F64) -> JointSetpoint:
    """Setpoints of the six joints at rest at `position` [rad], within the arm's limits."""
    return JointSetpoint(
        position,
        np.array((*VELOCITY_RAD_S, JAW_VELOCITY_RAD_S)),
        np.array((*ACCELERATION_RAD_S2, JAW_ACCELERATION_RAD_S2)),
    )


def opening(position: F64) -> float:
    """Opening of the gripper, 0 closed .. 1 open, for joints in the order of `JOINTS`."""
    share = (position[_JAW] - JAW_CLOSED_RAD) / (JAW_OPEN_RAD - JAW_CLOSED_RAD)
    return float(np.clip(share, 0.0, 1.0))


class So101Simulation:
    """A simulated SO-101 at a table with coloured cubes; used from one thread.

    Use it as a context manager, or call `open` and `close`. The scene depends on `seed` and
    `colours` only, and the same calls give the same motion.
    """

    def __init__(self, seed: int = 0, *, colours: Sequence[str] = DEFAULT_COLOURS) -> None:
        """Choose the scene. Raises ConfigurationError for unknown colours or too many cubes."""
        self.seed = seed
        self.scene = random_cubes(seed, colours)
        self._cameras = {camera.name: camera for camera in cameras()}
        self._world: So101World | None = None
        self._reset_clock()

    def _reset_clock(self) -> None:
        self.steps = 0
        self._lifts = LiftClock(self.scene, lifted_m=LIFTED_M)
        self._setpoint = new_setpoint(START)

    def __enter__(self) -> So101Simulation:
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
        """Build the world with the robot at home and the gripper open. Raises StateError when it is
        open already.
        """
        if self._world is not None:
            raise StateError("The simulation is open already.")
        self._reset_clock()
        self._world = So101World(self.scene)
        self._world.set_joints(START.tolist())

    def close(self) -> None:
        """Destroy the world; may be called twice and before `open`."""
        self._world = None

    @property
    def world(self) -> So101World:
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
        """Advance by `count` steps of `STEP_S`."""
        world = self.world
        for _ in range(count):
            self._setpoint.advance(STEP_S)
            world.step(self._setpoint.position, self._setpoint.velocity)
            self.steps += 1
            if self.steps % _JUDGE_EVERY == 0:
                tcps = [world.T_base_tcp()[:3, 3]]
                self._lifts.observe(self.time_s, world.cube_poses(), tcps)

    def set_target(
        self, names: Sequence[str], position: ArrayLike, duration_s: float
    ) -> JointCommand:
        """Send joints to `position` [rad] within `duration_s`; unnamed joints keep their target.

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
        checked(wanted, JOINTS)
        indices = [JOINTS.index(name) for name in names]
        target = self._setpoint.target.copy()
        target[indices] = np.clip(wanted.position, LOWER[indices], UPPER[indices])
        if target[_JAW] > self._setpoint.position[_JAW]:
            self._release_jaw(target[_JAW])
        possible_s = max(duration_s, self._setpoint.shortest_s(target, indices))
        self._setpoint.aim(target, indices, duration_s)
        return JointCommand(names=tuple(names), position=target[indices], duration_s=possible_s)

    def _release_jaw(self, target_rad: float) -> None:
        """After a grasp the setpoint lies inside the object: opening starts from where the jaw
        really is.
        """
        measured_rad = float(self.joint_states()[0][_JAW])
        self._setpoint.position[_JAW] = max(
            self._setpoint.position[_JAW], min(measured_rad, target_rad)
        )

    def hold(self) -> None:
        """Brake the arm to a standstill and stay; the gripper keeps its target, so that nothing is
        dropped.
        """
        self._setpoint.halt([i for i in range(len(JOINTS)) if i != _JAW])

    def joint_states(self) -> tuple[F64, F64]:
        """Measured positions [rad] and velocities [rad/s], each float64 (6,), in the order of
        `JOINTS`.
        """
        return self.world.joint_states()

    def cubes(self) -> dict[str, CubeState]:
        """Where each cube is, by name: ground truth, for judging and tests only, never for a
        policy.
        """
        return self._lifts.states(self.world.cube_poses())

    def render(
        self, camera: str, width: int = DEFAULT_SIZE_PX[0], height: int = DEFAULT_SIZE_PX[1]
    ) -> NDArray[np.uint8]:
        """What `camera` sees now: uint8 (height, width, 3) RGB. Raises InvalidInputError for an
        unknown one.
        """
        if camera not in self._cameras:
            raise InvalidInputError(
                f"Camera {camera!r} is not known, expected one of {', '.join(self._cameras)}."
            )
        return self.world.render(self._cameras[camera].calibration(width, height), width, height)

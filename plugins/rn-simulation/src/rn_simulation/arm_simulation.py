"""Physics of a cell of arms, stepped explicitly, so that tests and benchmarks run faster than real
time.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rn_simulation.arm_cell import STEP_S, ArmCell
from rn_simulation.arm_world import ArmWorld
from rn_simulation.command import checked
from rn_simulation.cubes import Cube, RawPose
from rn_simulation.engine import Engine
from rn_simulation.ground_truth import CubeState, LiftClock
from rn_simulation.pinhole import DEFAULT_SIZE_PX, PinholeCamera
from rn_simulation.setpoint import JointSetpoint
from rn_simulation.slip import Slip
from roboneuron import (
    CameraCalibration,
    InvalidInputError,
    JointCommand,
    Pose,
    StateError,
    quaternion_from_matrix,
)

F64 = NDArray[np.float64]

_JUDGE_EVERY = 4


class CellSimulation(ABC):
    """Simulated arms at a table with coloured cubes; used from one thread.

    Use it as a context manager, or call `open` and `close`. The scene depends on `seed` and the
    colours only, and the same calls give the same motion in the same engine.

    Attributes:
        seed, scene, engine: seed and cubes of the scene, and physics engine.
        steps: number of steps since `open`.
    """

    def __init__(
        self,
        cell: ArmCell,
        *,
        seed: int,
        scene: Sequence[Cube],
        engine: Engine,
        cameras: Sequence[PinholeCamera],
    ) -> None:
        """Store the arguments."""
        self.seed, self.scene, self.engine = seed, tuple(scene), engine
        self._arms = cell
        self._followed = np.array(cell.followed)
        self._cameras = {camera.name: camera for camera in cameras}
        self._world: ArmWorld | None = None
        self._slip: Slip | None = None
        self._reset_clock()

    @abstractmethod
    def build_world(self) -> ArmWorld:
        """Create a world with `scene`. Raises ConfigurationError if it cannot be built."""

    def let_slip(self, after_s: float | None) -> None:
        """Open the grippers once, `after_s` seconds after a cube was lifted; None for never."""
        cell = self._arms
        fingers = [i for i, number in enumerate(cell.followed) if number in cell.grippers]
        followed = self._followed[fingers]
        closed, opened = cell.lower[followed], cell.upper[followed]
        self._slip = None if after_s is None else Slip(after_s, fingers, closed, opened)

    def _reset_clock(self) -> None:
        cell = self._arms
        self.steps = 0
        self._lifts = LiftClock(self.scene, cell.arms, cell.lifted_m)
        self._setpoint = JointSetpoint(cell.start, cell.velocity, cell.acceleration)

    def __enter__(self) -> Self:
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
        """Build the world with the robot at home and grippers open.

        Raises:
            StateError: it is already open.
            ConfigurationError: as `build_world`.
        """
        if self._world is not None:
            raise StateError("The simulation is open already.")
        self._reset_clock()
        self._world = self.build_world()
        self._world.set_joints(self._arms.start[self._followed].tolist())
        self._world.prepare_physics(STEP_S, self._arms.force.tolist())

    def close(self) -> None:
        """Destroy the world; may be called twice and before `open`."""
        if self._world is not None:
            self._world.close()
            self._world = None

    def place(self, joints: F64, cubes: Mapping[str, RawPose]) -> None:
        """Set the positions of joints, in the order of the cell's `joints`, and of cubes, at rest.

        Raises:
            StateError: it is not open.
        """
        cell = self._arms
        first = [cell.followed.index(number) for number in range(len(cell.commanded))]
        self._setpoint = JointSetpoint(joints[first], cell.velocity, cell.acceleration)
        self.world.set_joints(joints.tolist())
        self.world.set_cubes(cubes)

    @property
    def arm_cell(self) -> ArmCell:
        """The simulated arms."""
        return self._arms

    @property
    def world(self) -> ArmWorld:
        """The world. Raises StateError unless open."""
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
        world, followed = self.world, self._followed
        for _ in range(count):
            self._setpoint.advance(STEP_S)
            aimed = self._setpoint.position[followed]
            if self._slip is not None:
                aimed = self._slip.aimed(self.time_s, aimed)
            world.step(aimed, self._setpoint.velocity[followed])
            self.steps += 1
            if self.steps % _JUDGE_EVERY == 0:
                self._lifts.observe(self.time_s, world.cube_poses(), self._tcps())
                if self._slip is not None:
                    self._slip.notice(self.time_s, self._lifts.longest_s, world.joint_states()[0])

    def set_target(
        self, names: Sequence[str], position: ArrayLike, duration_s: float
    ) -> JointCommand:
        """Send joints to `position` [rad, m] within `duration_s`; unnamed joints keep their target.

        Positions are clamped to the limits, and the motion takes longer if velocity or acceleration
        limits require it.

        Returns:
            The executed command: clamped positions, feasible duration.

        Raises:
            InvalidInputError: an unknown or repeated joint, a non-finite value, a wrong size, a
                duration <= 0.
        """
        wanted = JointCommand(
            names=tuple(names),
            position=np.asarray(position, dtype=np.float64),
            duration_s=duration_s,
        )
        cell = self._arms
        checked(wanted, cell.commanded)
        indices = [cell.commanded.index(name) for name in names]
        target = self._setpoint.target.copy()
        target[indices] = np.clip(wanted.position, cell.lower[indices], cell.upper[indices])
        for index in indices:
            if index in cell.grippers:
                self._release(index, float(target[index]))
        possible_s = max(duration_s, self._setpoint.shortest_s(target, indices))
        self._setpoint.aim(target, indices, duration_s)
        return JointCommand(names=tuple(names), position=target[indices], duration_s=possible_s)

    def _release(self, gripper: int, target: float) -> None:
        """Start the opening from the measured gripper position, because after a grasp the setpoint
        lies inside the object.

        A closing command keeps the setpoint, and with it the force.
        """
        setpoint = self._setpoint.position
        if target > setpoint[gripper]:
            measured = float(self.joint_positions()[self._arms.followed.index(gripper)])
            setpoint[gripper] = max(setpoint[gripper], min(measured, target))

    def hold(self) -> None:
        """Brake the arms to a standstill; grippers keep their targets, so that nothing is
        dropped.
        """
        cell = self._arms
        self._setpoint.halt([i for i in range(len(cell.commanded)) if i not in cell.grippers])

    def joint_positions(self) -> F64:
        """Measured positions, float64 (n,), in the order of the cell's `joints` [rad, m]."""
        return self.joint_states()[0]

    def joint_states(self) -> tuple[F64, F64]:
        """Measured positions and velocities, each float64 (n,), in the order of the cell's `joints`
        [rad, m, per s].
        """
        return self.world.joint_states()

    def tcp_pose(self, arm: int = 0) -> Pose:
        """TCP pose of the arm with this index in the base frame; `stamp_ns` is the simulated time
        [ns].
        """
        matrix = self.world.T_base_tcp(arm)
        return Pose(
            position_m=matrix[:3, 3],
            quaternion_xyzw=quaternion_from_matrix(matrix[:3, :3]),
            stamp_ns=round(self.time_s * 1e9),
        )

    def gripper_open(self) -> float | None:
        """Measured opening of the first gripper, 0 closed .. 1 open; None without one."""
        return self._arms.opening(self.joint_positions())

    def cubes(self) -> dict[str, CubeState]:
        """State of each cube by name: ground truth, for judging and tests only, never for a
        policy.
        """
        return self._lifts.states(self.world.cube_poses())

    def _tcps(self) -> list[F64]:
        """TCP positions of the arms, each float64 (3,)."""
        return [self.world.T_base_tcp(arm)[:3, 3] for arm in range(len(self._arms.arms))]

    def render(
        self, camera: str, width: int = DEFAULT_SIZE_PX[0], height: int = DEFAULT_SIZE_PX[1]
    ) -> NDArray[np.uint8]:
        """Render the current image of `camera`: uint8 (height, width, 3) RGB.

        Raises:
            InvalidInputError: there is no camera of that name.
        """
        return self.world.render(self._calibration(camera, width, height), width, height)

    def render_depth(
        self, camera: str, width: int, height: int
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Render the current image of `camera` and its depth, as `ArmWorld.render_depth`. Raises
        as `render`.
        """
        return self.world.render_depth(self._calibration(camera, width, height), width, height)

    def _calibration(self, camera: str, width: int, height: int) -> CameraCalibration:
        if camera not in self._cameras:
            raise InvalidInputError(
                f"Camera {camera!r} is not known, expected one of {', '.join(self._cameras)}."
            )
        return self._cameras[camera].calibration(width, height)

"""A second world of a simulated cell, in which simulated calls run faster than real time."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from std_msgs.msg import Float64MultiArray

from rn_simulation.arm_cell import STEP_S
from rn_simulation.arm_simulation import CellSimulation
from rn_simulation.cubes import Cube, RawPose
from rn_simulation.scene_state import TOPIC, from_message
from roboneuron import InvalidInputError, JointCommand, JointSample

MOVED_M = 0.004
"""Minimum displacement of a moved cube; resting ones stay within 1 mm."""


class CellTwin:
    """Follows the protocol `rn_standard.simulate.twin.Twin`; used from one thread.

    It has no clock and no topics: time only passes in `advance`, and nothing is published.

    Attributes:
        scene_topic, scene_type: topic and message type of a simulated cell's objects.
    """

    scene_topic = TOPIC
    scene_type = Float64MultiArray

    def __init__(self, simulation: CellSimulation) -> None:
        """Args: the cell; not open, and not used by others."""
        self._simulation = simulation
        self._cell = simulation.arm_cell
        self._before: dict[str, RawPose] = {}
        self._left_s = 0.0

    def open(self, joints: JointSample, scene: object = None) -> None:
        """Build the world with the measured joint positions, at rest.

        Args:
            joints: every joint of the cell, by name. Those of a gripper may be missing, as behind
                a driver that drives none: they are where the cell starts.
            scene: newest message of `scene_topic`; without one there are no objects.

        Raises:
            InvalidInputError: a joint is missing, or the message is no scene of this cell.
        """
        cell = self._cell
        measured = {
            name: float(cell.start[number])
            for name, number in zip(cell.joints, cell.followed, strict=True)
            if number in cell.grippers
        }
        measured |= dict(zip(joints.names, joints.position.tolist(), strict=True))
        missing = [name for name in cell.joints if name not in measured]
        if missing:
            raise InvalidInputError(f"Joint {missing[0]!r} is not measured.")
        poses: dict[str, RawPose] = {}
        cubes: list[Cube] = []
        if isinstance(scene, Float64MultiArray):
            state = from_message(scene, {self._cell.robot: len(self._cell.joints)})
            for (name, edge_m), pose in zip(state.cubes, state.cube_poses.tolist(), strict=True):
                cubes.append(Cube(name=name, edge_m=edge_m, x_m=0.0, y_m=0.0, yaw_rad=0.0))
                poses[name] = (pose[:3], pose[3:])
        self._simulation.scene = tuple(cubes)
        self._simulation.open()
        self._simulation.place(np.array([measured[name] for name in self._cell.joints]), poses)
        self._before, self._left_s = poses, 0.0

    def send(self, command: JointCommand) -> None:
        """Move towards a command, as the cell's driver does. Raises InvalidInputError."""
        self._simulation.set_target(command.names, command.position, command.duration_s)

    def hold(self) -> None:
        """Brake the arm to a standstill, as the driver does."""
        self._simulation.hold()

    def advance(self, duration_s: float) -> None:
        """Advance simulated time [s]; a remainder below a physics step is kept."""
        self._left_s += duration_s
        steps = math.floor(self._left_s / STEP_S + 1e-9)
        self._left_s -= steps * STEP_S
        self._simulation.step(steps)

    def joints(self) -> JointSample:
        """Current measurement, with velocities."""
        position, velocity = self._simulation.joint_states()
        return JointSample(
            names=self._cell.joints,
            position=position,
            velocity=velocity,
            stamp_ns=round(self._simulation.time_s * 1e9),
        )

    def moved(self) -> tuple[str, ...]:
        """Names of objects that have moved."""
        now = self._simulation.world.cube_poses()
        return tuple(
            f"{name} cube"
            for name, (position, _) in self._before.items()
            if math.dist(position, now[name][0]) > MOVED_M
        )

    def picture(self, camera: str, width: int, height: int) -> NDArray[np.uint8]:
        """Render a camera's image, uint8 (height, width, 3) RGB. Raises InvalidInputError if it
        does not exist.
        """
        return self._simulation.render(camera, width, height)

    def close(self) -> None:
        """Release the world; may be called twice."""
        self._simulation.close()

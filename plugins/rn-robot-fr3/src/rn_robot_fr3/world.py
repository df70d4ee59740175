"""The PyBullet world: robot, table and cubes. The physics and the render twin build the same one."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pybullet
import pybullet_data
from numpy.typing import NDArray

from rn_robot_fr3.description import TCP_LINK, urdf_with_meshes
from rn_robot_fr3.display import check_display
from rn_robot_fr3.limits import ARM_JOINTS, FINGER_JOINT, MIMIC_FINGER_JOINT
from rn_robot_fr3.renderer import render
from rn_robot_fr3.scene import RGBA_BY_COLOUR, Cube
from roboneuron.contract import CameraCalibration
from roboneuron.contract.rotation import matrix_from_quaternion
from roboneuron.errors import ConfigurationError

F64 = NDArray[np.float64]

JOINTS = (*ARM_JOINTS, FINGER_JOINT, MIMIC_FINGER_JOINT)
"""Every moving joint, in the order of all joint arrays of the simulation."""

WOOD_KG_M3 = 700.0
_TABLE_SIZE_M = (1.30, 1.20, 0.05)
_TABLE_CENTRE_M = (0.35, 0.0)
_TABLE_RGBA = (0.80, 0.76, 0.70, 1.0)

_POSITION_GAINS = [0.3] * 9
_VELOCITY_GAINS = [1.0] * 9


def _gui_client() -> int:
    check_display()
    client = int(pybullet.connect(pybullet.GUI))
    if client < 0:
        raise ConfigurationError("PyBullet could not open a window on the display.", hint="Set gui = false.")
    pybullet.configureDebugVisualizer(pybullet.COV_ENABLE_GUI, 0, physicsClientId=client)
    pybullet.resetDebugVisualizerCamera(1.3, 60, -32, [0.4, 0.0, 0.1], physicsClientId=client)
    return client


class World:
    """One PyBullet client with the robot at the origin, the table top at z = 0 and cubes on it; from one thread only.

    Attributes:
        client: PyBullet's id of the physics client.
        robot: body id of the robot.
        joint_indices: PyBullet joint indices in the order of `JOINTS`.
        cube_bodies: body id by cube name.
    """

    def __init__(self, cubes: Sequence[Cube], *, gui: bool = False) -> None:
        """Connect and build. Raises ConfigurationError when a window is asked for and there is no display."""
        self.client = _gui_client() if gui else int(pybullet.connect(pybullet.DIRECT))
        self._connected = True
        self._add_table()
        self.robot = self._add_robot()
        infos = [
            pybullet.getJointInfo(self.robot, index, physicsClientId=self.client)
            for index in range(pybullet.getNumJoints(self.robot, physicsClientId=self.client))
        ]
        index_by_joint = {info[1].decode(): info[0] for info in infos}
        self.joint_indices = [index_by_joint[name] for name in JOINTS]
        self._tcp_index = next(info[0] for info in infos if info[12].decode() == TCP_LINK)
        self.cube_bodies = {cube.name: self._add_cube(cube) for cube in cubes}

    def _box(
        self, size_m: Sequence[float], centre_m: Sequence[float], rgba: Sequence[float], mass_kg: float = 0
    ) -> int:
        half = [side / 2 for side in size_m]
        shape = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, physicsClientId=self.client)
        visual = pybullet.createVisualShape(
            pybullet.GEOM_BOX, halfExtents=half, rgbaColor=rgba, physicsClientId=self.client
        )
        return int(pybullet.createMultiBody(mass_kg, shape, visual, centre_m, physicsClientId=self.client))

    def _add_table(self) -> None:
        (x, y), thickness = _TABLE_CENTRE_M, _TABLE_SIZE_M[2]
        table = self._box(_TABLE_SIZE_M, (x, y, -thickness / 2), _TABLE_RGBA)
        pybullet.changeDynamics(table, -1, lateralFriction=0.8, physicsClientId=self.client)

    def _add_robot(self) -> int:
        """PyBullet reads descriptions from files only: write the one with meshes to a temporary folder."""
        meshes = Path(pybullet_data.getDataPath()) / "franka_panda" / "meshes" / "collision"
        with tempfile.TemporaryDirectory(prefix="rn-fr3-") as folder:
            path = Path(folder) / "fr3.urdf"
            path.write_text(urdf_with_meshes(str(meshes)), encoding="utf-8")
            flags = pybullet.URDF_USE_INERTIA_FROM_FILE
            body = pybullet.loadURDF(str(path), useFixedBase=True, flags=flags, physicsClientId=self.client)
        return int(body)

    def _add_cube(self, cube: Cube) -> int:
        mass_kg = WOOD_KG_M3 * cube.edge_m**3
        body = self._box((cube.edge_m,) * 3, (cube.x_m, cube.y_m, cube.edge_m / 2), RGBA_BY_COLOUR[cube.name], mass_kg)
        rotation = pybullet.getQuaternionFromEuler((0.0, 0.0, cube.yaw_rad))
        self.set_body_pose(body, (cube.x_m, cube.y_m, cube.edge_m / 2), rotation)
        return body

    def set_body_pose(self, body: int, position_m: Sequence[float], quaternion_xyzw: Sequence[float]) -> None:
        """Put a body somewhere, at rest."""
        pybullet.resetBasePositionAndOrientation(body, position_m, quaternion_xyzw, physicsClientId=self.client)

    def body_pose(self, body: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Position [m] and quaternion (x y z w) of a body's centre in the base frame."""
        position, rotation = pybullet.getBasePositionAndOrientation(body, physicsClientId=self.client)
        return tuple(position), tuple(rotation)

    def set_joints(self, position: Sequence[float]) -> None:
        """Put the joints, in the order of `JOINTS`, at `position` [rad, m], at rest."""
        for index, value in zip(self.joint_indices, position, strict=True):
            pybullet.resetJointState(self.robot, index, float(value), physicsClientId=self.client)

    def prepare_physics(self, step_s: float) -> None:
        """Set gravity, time step and friction, and couple the fingers; the render twin does without."""
        client = self.client
        pybullet.setGravity(0.0, 0.0, -9.81, physicsClientId=client)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=step_s,
            numSolverIterations=60,
            solverResidualThreshold=1e-5,
            deterministicOverlappingPairs=1,
            physicsClientId=client,
        )
        left, right = self.joint_indices[-2:]
        for index in (left, right):
            pybullet.changeDynamics(
                self.robot, index, lateralFriction=1.2, spinningFriction=0.02, physicsClientId=client
            )
        gear = pybullet.createConstraint(
            self.robot, left, self.robot, right, pybullet.JOINT_GEAR, [1, 0, 0], [0, 0, 0], [0, 0, 0],
            physicsClientId=client,
        )  # fmt: skip
        pybullet.changeConstraint(gear, gearRatio=-1, erp=0.2, maxForce=100, physicsClientId=client)
        for body in self.cube_bodies.values():
            pybullet.changeDynamics(
                body, -1, lateralFriction=1.0, spinningFriction=0.005, rollingFriction=0.0005, physicsClientId=client
            )

    def drive(self, position: Sequence[float], velocity: Sequence[float], force: Sequence[float]) -> None:
        """Set the motors' goals for the next steps, in the order of `JOINTS` [rad, m, per s, Nm, N]."""
        pybullet.setJointMotorControlArray(
            self.robot,
            self.joint_indices,
            pybullet.POSITION_CONTROL,
            targetPositions=position,
            targetVelocities=velocity,
            forces=force,
            positionGains=_POSITION_GAINS,
            velocityGains=_VELOCITY_GAINS,
            physicsClientId=self.client,
        )

    def joint_states(self) -> tuple[F64, F64]:
        """Measured positions and velocities, each float64 (9,), in the order of `JOINTS`."""
        states = pybullet.getJointStates(self.robot, self.joint_indices, physicsClientId=self.client)
        return np.array([state[0] for state in states]), np.array([state[1] for state in states])

    def T_base_tcp(self) -> F64:
        """Pose (4, 4) of the TCP in the base frame [m]."""
        state = pybullet.getLinkState(
            self.robot, self._tcp_index, computeForwardKinematics=1, physicsClientId=self.client
        )
        pose = np.eye(4)
        pose[:3, :3] = matrix_from_quaternion(np.array(state[5]))
        pose[:3, 3] = state[4]
        return pose

    def render(self, calibration: CameraCalibration, width: int, height: int) -> NDArray[np.uint8]:
        """Draw what a camera on the base or at the TCP sees: uint8 (height, width, 3) RGB."""
        mount = self.T_base_tcp() if calibration.mount == "tcp" else np.eye(4)
        return render(self.client, calibration, mount, width, height)

    def close(self) -> None:
        """Disconnect; may be called twice."""
        if self._connected:
            self._connected = False
            pybullet.disconnect(self.client)

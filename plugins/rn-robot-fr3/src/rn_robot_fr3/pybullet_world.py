"""The world in PyBullet."""

from __future__ import annotations

import ctypes
import ctypes.util
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pybullet
import pybullet_data
from numpy.typing import NDArray

from rn_robot_fr3.cell import FR3, Workcell
from rn_robot_fr3.description import TCP_LINK, urdf_with_meshes
from rn_robot_fr3.renderer import render
from rn_robot_fr3.scene import FINGER_FRICTION
from rn_simulation.arm_cell import carrying_arm
from rn_simulation.cubes import (
    CUBE_FRICTION,
    RGBA_BY_COLOUR,
    TABLE_FRICTION,
    TABLE_RGBA,
    WOOD_KG_M3,
    Cube,
    RawPose,
)
from rn_simulation.engine import Engine
from roboneuron import CameraCalibration, ConfigurationError, matrix_from_quaternion

_HINT = "Set gui = false, or DISPLAY to a running X server."


def check_display() -> None:
    """Return if the X server named in DISPLAY accepts a connection.

    Raises:
        ConfigurationError: DISPLAY is unset, its server does not answer, or libX11 is not
            installed.
    """
    name = os.environ.get("DISPLAY", "")
    if not name:
        raise ConfigurationError(
            "The simulation was asked for a window, but there is no display.", hint=_HINT
        )
    library = ctypes.util.find_library("X11")
    if library is None:
        raise ConfigurationError(
            "The simulation was asked for a window, but libX11 is missing.",
            hint="Install libx11-6, or set gui = false.",
        )
    x11 = ctypes.CDLL(library)
    x11.XOpenDisplay.restype = ctypes.c_void_p
    x11.XCloseDisplay.argtypes = [ctypes.c_void_p]
    connection = x11.XOpenDisplay(None)
    if not connection:
        raise ConfigurationError(f"The display {name!r} does not answer.", hint=_HINT)
    x11.XCloseDisplay(connection)


F64 = NDArray[np.float64]

_POSITION_GAIN, _VELOCITY_GAIN = 0.3, 1.0


def _gui_client() -> int:
    check_display()
    client = int(pybullet.connect(pybullet.GUI))
    if client < 0:
        raise ConfigurationError(
            "PyBullet could not open a window on the display.", hint="Set gui = false."
        )
    pybullet.configureDebugVisualizer(pybullet.COV_ENABLE_GUI, 0, physicsClientId=client)
    pybullet.resetDebugVisualizerCamera(1.3, 60, -32, [0.4, 0.0, 0.1], physicsClientId=client)
    return client


class PybulletArmWorld:
    """One PyBullet client; follows the protocol `ArmWorld`.

    Attributes:
        client: PyBullet's id of the physics client.
        robot: body id of the robot.
        joint_indices: PyBullet joint indices in the order of the cell's `joints`.
        cube_bodies: body id by cube name.
    """

    engine: Engine = "pybullet"

    def __init__(self, cubes: Sequence[Cube], *, gui: bool = False, cell: Workcell = FR3) -> None:
        """Connect and build the world. Raises ConfigurationError if a window is requested without a
        display.
        """
        self.client = _gui_client() if gui else int(pybullet.connect(pybullet.DIRECT))
        self._connected = True
        self._cell = cell
        self._force: list[float] = []
        self._add_table()
        self.robot = self._add_robot()
        infos = [
            pybullet.getJointInfo(self.robot, index, physicsClientId=self.client)
            for index in range(pybullet.getNumJoints(self.robot, physicsClientId=self.client))
        ]
        index_by_joint = {info[1].decode(): info[0] for info in infos}
        self.joint_indices = [index_by_joint[name] for name in cell.joints]
        index_by_link = {info[12].decode(): info[0] for info in infos}
        self._tcp_indices = [index_by_link[f"{mount.prefix}{TCP_LINK}"] for mount in cell.mounts]
        self.cube_bodies = {cube.name: self._add_cube(cube) for cube in cubes}

    def _box(
        self,
        size_m: Sequence[float],
        centre_m: Sequence[float],
        rgba: Sequence[float],
        mass_kg: float = 0,
    ) -> int:
        half = [side / 2 for side in size_m]
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_BOX, halfExtents=half, physicsClientId=self.client
        )
        visual = pybullet.createVisualShape(
            pybullet.GEOM_BOX, halfExtents=half, rgbaColor=rgba, physicsClientId=self.client
        )
        return int(
            pybullet.createMultiBody(mass_kg, shape, visual, centre_m, physicsClientId=self.client)
        )

    def _add_table(self) -> None:
        table = self._box(self._cell.table_size_m, self._cell.table_centre_m, TABLE_RGBA)
        pybullet.changeDynamics(
            table, -1, lateralFriction=TABLE_FRICTION, physicsClientId=self.client
        )

    def _add_robot(self) -> int:
        """Load the robot with meshes from a temporary file, because PyBullet reads files only."""
        meshes = Path(pybullet_data.getDataPath()) / "franka_panda" / "meshes" / "collision"
        with tempfile.TemporaryDirectory(prefix="rn-fr3-") as folder:
            path = Path(folder) / "fr3.urdf"
            path.write_text(urdf_with_meshes(str(meshes), self._cell), encoding="utf-8")
            flags = pybullet.URDF_USE_INERTIA_FROM_FILE
            body = pybullet.loadURDF(
                str(path), useFixedBase=True, flags=flags, physicsClientId=self.client
            )
        return int(body)

    def _add_cube(self, cube: Cube) -> int:
        mass_kg = WOOD_KG_M3 * cube.edge_m**3
        body = self._box(
            (cube.edge_m,) * 3,
            (cube.x_m, cube.y_m, cube.edge_m / 2),
            RGBA_BY_COLOUR[cube.name],
            mass_kg,
        )
        rotation = pybullet.getQuaternionFromEuler((0.0, 0.0, cube.yaw_rad))
        position = (cube.x_m, cube.y_m, cube.edge_m / 2)
        pybullet.resetBasePositionAndOrientation(
            body, position, rotation, physicsClientId=self.client
        )
        return body

    def set_cubes(self, poses: Mapping[str, RawPose]) -> None:
        """See `ArmWorld`."""
        for name, (position, rotation) in poses.items():
            body = self.cube_bodies[name]
            pybullet.resetBasePositionAndOrientation(
                body, position, rotation, physicsClientId=self.client
            )

    def cube_poses(self) -> dict[str, RawPose]:
        """See `ArmWorld`."""
        return {
            name: pybullet.getBasePositionAndOrientation(body, physicsClientId=self.client)
            for name, body in self.cube_bodies.items()
        }

    def set_joints(self, position: Sequence[float]) -> None:
        """See `ArmWorld`."""
        for index, value in zip(self.joint_indices, position, strict=True):
            pybullet.resetJointState(self.robot, index, float(value), physicsClientId=self.client)

    def prepare_physics(self, step_s: float, force: Sequence[float]) -> None:
        """See `ArmWorld`."""
        client = self.client
        self._force = list(force)
        pybullet.setGravity(0.0, 0.0, -9.81, physicsClientId=client)
        # Every iteration is made: ended by a residual of 1e-5, friction falls short, and cubes that
        # nobody touches creep by up to 0.5 mm in a minute.
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=step_s,
            numSolverIterations=60,
            solverResidualThreshold=0.0,
            deterministicOverlappingPairs=1,
            physicsClientId=client,
        )
        count = len(self.joint_indices) // len(self._cell.mounts)
        for start in range(0, len(self.joint_indices), count):
            self._prepare_fingers(*self.joint_indices[start + count - 2 : start + count])
        sliding, spinning, rolling = CUBE_FRICTION
        for body in self.cube_bodies.values():
            pybullet.changeDynamics(
                body,
                -1,
                lateralFriction=sliding,
                spinningFriction=spinning,
                rollingFriction=rolling,
                physicsClientId=client,
            )

    def _prepare_fingers(self, left: int, right: int) -> None:
        """Set the friction of one gripper's fingers and couple them."""
        client = self.client
        sliding, spinning, _ = FINGER_FRICTION
        for index in (left, right):
            pybullet.changeDynamics(
                self.robot,
                index,
                lateralFriction=sliding,
                spinningFriction=spinning,
                # without it a held cube creeps: 3 mm and 3 degrees in 20 s, faster and faster
                frictionAnchor=1,
                physicsClientId=client,
            )
        gear = pybullet.createConstraint(
            self.robot,
            left,
            self.robot,
            right,
            pybullet.JOINT_GEAR,
            [1, 0, 0],
            [0, 0, 0],
            [0, 0, 0],
            physicsClientId=client,
        )
        pybullet.changeConstraint(gear, gearRatio=-1, erp=0.2, maxForce=100, physicsClientId=client)

    def step(self, position: F64, velocity: F64) -> None:
        """See `ArmWorld`."""
        pybullet.setJointMotorControlArray(
            self.robot,
            self.joint_indices,
            pybullet.POSITION_CONTROL,
            targetPositions=position.tolist(),
            targetVelocities=velocity.tolist(),
            forces=self._force,
            positionGains=[_POSITION_GAIN] * len(self.joint_indices),
            velocityGains=[_VELOCITY_GAIN] * len(self.joint_indices),
            physicsClientId=self.client,
        )
        pybullet.stepSimulation(physicsClientId=self.client)

    def joint_states(self) -> tuple[F64, F64]:
        """See `ArmWorld`."""
        states = pybullet.getJointStates(
            self.robot, self.joint_indices, physicsClientId=self.client
        )
        return np.array([state[0] for state in states]), np.array([state[1] for state in states])

    def T_base_tcp(self, arm: int = 0) -> F64:
        """See `ArmWorld`."""
        state = pybullet.getLinkState(
            self.robot,
            self._tcp_indices[arm],
            computeForwardKinematics=1,
            physicsClientId=self.client,
        )
        pose = np.eye(4)
        pose[:3, :3] = matrix_from_quaternion(np.array(state[5]))
        pose[:3, 3] = state[4]
        return pose

    def render(self, calibration: CameraCalibration, width: int, height: int) -> NDArray[np.uint8]:
        """See `ArmWorld`."""
        return self._render(calibration, width, height)[0]

    def render_depth(
        self, calibration: CameraCalibration, width: int, height: int
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """See `ArmWorld`."""
        image, depth_m = self._render(calibration, width, height)
        return image, depth_m()

    def _render(
        self, calibration: CameraCalibration, width: int, height: int
    ) -> tuple[NDArray[np.uint8], Callable[[], NDArray[np.float32]]]:
        arm = carrying_arm(calibration.mount, [mount.name for mount in self._cell.mounts])
        mount = np.eye(4) if arm is None else self.T_base_tcp(arm)
        return render(self.client, calibration, mount, width, height)

    def close(self) -> None:
        """Disconnect; may be called twice."""
        if self._connected:
            self._connected = False
            pybullet.disconnect(self.client)

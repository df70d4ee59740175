"""The world in MuJoCo."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from rn_robot_fr3.cell import FR3, Cell
from rn_robot_fr3.description import TCP_LINK, cell_urdf
from rn_robot_fr3.scene import (
    CUBE_FRICTION,
    FINGER_FRICTION,
    TABLE_FRICTION,
    TABLE_RGBA,
    WOOD_KG_M3,
)
from rn_simulation.cubes import RGBA_BY_COLOUR, Cube, RawPose
from rn_simulation.engine import Engine
from rn_simulation.mujoco_scene import VISUAL_GROUP, read_urdf
from rn_simulation.raycast import render
from roboneuron import CameraCalibration, ConfigurationError

F64 = NDArray[np.float64]

_SUBSTEPS = 2
"""Physics steps per step: MuJoCo's contacts are springs, which want 2 ms."""
_ROBOT, _SURROUNDINGS = 1, 2
"""Collision bits: the robot touches its surroundings and not itself, as in PyBullet."""
_STIFFNESS = np.array([20000.0] * 4 + [5000.0] * 3 + [10000.0] * 2)
_DAMPING = np.array([600.0] * 4 + [120.0] * 3 + [200.0] * 2)
_ARMATURE = (0.1,) * 7 + (0.3,) * 2
"""Inertia of motors and gears as the joints feel it [kg m^2, kg]: an estimate."""
_CONTACT_SPRING = (0.005, 1.0)
"""Time constant [s] and damping ratio: stiff enough that the grasped cube measures within 1 mm."""
_CONTACT_IMPEDANCE = (0.98, 0.999, 0.001, 0.5, 2.0)


class MujocoArmWorld:
    """One MuJoCo model and its state; follows the protocol `World`."""

    engine: Engine = "mujoco"

    def __init__(self, cubes: Sequence[Cube], *, gui: bool = False, cell: Cell = FR3) -> None:
        """Build. Raises ConfigurationError when a window is asked for."""
        if gui:
            raise ConfigurationError(
                "The simulation was asked for a window, which it has with PyBullet only.",
                hint="Set gui = false, or use PyBullet on Python 3.11: pip compiles it on newer "
                "versions.",
            )
        self._cell = cell
        spec = read_urdf(cell_urdf(cell))
        _prepare_robot(spec, cell)
        _add_table(spec, cell)
        for cube in cubes:
            _add_cube(spec, cube)
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.impratio = 10.0  # a held cube creeps out of the fingers otherwise
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        joints = [self._model.joint(name) for name in cell.joints]
        self._positions = np.array([joint.qposadr[0] for joint in joints])
        self._velocities = np.array([joint.dofadr[0] for joint in joints])
        self._cubes = {cube.name: self._model.joint(cube.name) for cube in cubes}
        self._tcp = [self._model.body(f"{mount.prefix}{TCP_LINK}").id for mount in cell.mounts]
        self._lead_s = np.tile(_DAMPING / _STIFFNESS, len(cell.mounts))
        self._refresh()

    def _refresh(self) -> None:
        """Let body poses follow the joints; a step leaves them where they were before it."""
        mujoco.mj_kinematics(self._model, self._data)

    def set_joints(self, position: Sequence[float]) -> None:
        """See `World`."""
        self._data.qpos[self._positions] = position
        self._data.qvel[self._velocities] = 0.0
        self._refresh()

    def set_cubes(self, poses: Mapping[str, RawPose]) -> None:
        """See `World`."""
        for name, (position, (x, y, z, w)) in poses.items():
            self._cube_position(name)[:] = [*position, w, x, y, z]
            start = self._cubes[name].dofadr[0]
            self._data.qvel[start : start + 6] = 0.0
        self._refresh()

    def _cube_position(self, name: str) -> F64:
        start = self._cubes[name].qposadr[0]
        position: F64 = self._data.qpos[start : start + 7]
        return position

    def prepare_physics(self, step_s: float, force: Sequence[float]) -> None:
        """See `World`."""
        self._model.opt.timestep = step_s / _SUBSTEPS
        joints = [self._model.joint(name).id for name in self._cell.joints]
        self._model.jnt_actfrcrange[joints] = np.outer(force, (-1.0, 1.0))

    def step(self, position: Sequence[float], velocity: Sequence[float]) -> None:
        """See `World`."""
        # A servo's force is stiffness * (control - position) - damping * velocity.
        self._data.ctrl[:] = position + self._lead_s * velocity
        mujoco.mj_step(self._model, self._data, _SUBSTEPS)
        self._refresh()

    def joint_states(self) -> tuple[F64, F64]:
        """See `World`."""
        return self._data.qpos[self._positions], self._data.qvel[self._velocities]

    def cube_poses(self) -> dict[str, RawPose]:
        """See `World`."""
        poses: dict[str, RawPose] = {}
        for name in self._cubes:
            x_m, y_m, z_m, w, x, y, z = self._cube_position(name).tolist()
            poses[name] = ((x_m, y_m, z_m), (x, y, z, w))
        return poses

    def T_base_tcp(self, arm: int = 0) -> F64:
        """See `World`."""
        pose = np.eye(4)
        pose[:3, :3] = self._data.xmat[self._tcp[arm]].reshape(3, 3)
        pose[:3, 3] = self._data.xpos[self._tcp[arm]]
        return pose

    def render(self, calibration: CameraCalibration, width: int, height: int) -> NDArray[np.uint8]:
        """See `World`."""
        arm = self._cell.arm_that_carries(calibration.mount)
        mount = np.eye(4) if arm is None else self.T_base_tcp(arm)
        return render(self._model, self._data, calibration, mount, width, height)

    def close(self) -> None:
        """See `World`; MuJoCo's objects go with the last reference to them."""


def _prepare_robot(spec: mujoco.MjSpec, cell: Cell) -> None:
    """Motors at the joints, and shapes that touch only what is not the robot."""
    for body in spec.bodies:
        body.gravcomp = 1.0
    for geom in spec.geoms:
        if geom.group != VISUAL_GROUP:
            _make_solid(geom, FINGER_FRICTION, _ROBOT)
    motors = [*zip(_STIFFNESS, _DAMPING, _ARMATURE, strict=True)] * len(cell.mounts)
    for name, (stiffness, damping, armature) in zip(cell.joints, motors, strict=True):
        joint = spec.joint(name)
        joint.armature = armature
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_TRUE
        joint.actfrcrange = (-1.0, 1.0)  # prepare_physics sets it
        joint.actgravcomp = True  # the motors carry the arm, so that counts towards their limits
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.gaintype, motor.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
        motor.gainprm[0] = stiffness
        motor.biasprm[1], motor.biasprm[2] = -stiffness, -damping


def _add_table(spec: mujoco.MjSpec, cell: Cell) -> None:
    table = spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=np.array(cell.table_size_m) / 2,
        pos=cell.table_centre_m,
        rgba=TABLE_RGBA,
    )
    table.group = VISUAL_GROUP
    _make_solid(table, (TABLE_FRICTION, 0.005, 0.0001), _SURROUNDINGS)


def _add_cube(spec: mujoco.MjSpec, cube: Cube) -> None:
    turn = (np.cos(cube.yaw_rad / 2), 0.0, 0.0, np.sin(cube.yaw_rad / 2))
    body = spec.worldbody.add_body(
        name=cube.name, pos=(cube.x_m, cube.y_m, cube.edge_m / 2), quat=turn
    )
    body.add_freejoint(name=cube.name)
    box = body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX, size=[cube.edge_m / 2] * 3, rgba=RGBA_BY_COLOUR[cube.name]
    )
    box.density = WOOD_KG_M3
    box.group = VISUAL_GROUP
    _make_solid(box, CUBE_FRICTION, _SURROUNDINGS)


def _make_solid(geom: mujoco.MjsGeom, friction: Sequence[float], bit: int) -> None:
    geom.contype, geom.conaffinity = bit, 0 if bit == _ROBOT else _ROBOT | _SURROUNDINGS
    geom.condim = 4
    geom.friction, geom.solref, geom.solimp = friction, _CONTACT_SPRING, _CONTACT_IMPEDANCE

"""The SO-101, its table and the cubes in MuJoCo. The physics and the render twin, in another
process, each build one.

The robot stands at the origin, the table top is at z = 0, the cubes lie on it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from rn_robot_lerobot.arm import EFFORT_NM, JAW_EFFORT_NM, JOINTS, TCP_LINK, urdf
from rn_simulation.cubes import RGBA_BY_COLOUR, Cube, RawPose
from rn_simulation.mujoco_scene import VISUAL_GROUP, read_urdf
from rn_simulation.raycast import render
from roboneuron import CameraCalibration

F64 = NDArray[np.float64]

STEP_S = 1.0 / 240.0
"""Time of one step [s]."""
_SUBSTEPS = 4
"""Physics steps per step: contacts are springs, and a cube of 10 g on them wants 1 ms."""
_ROBOT, _SURROUNDINGS = 1, 2
"""Collision bits: the robot touches its surroundings and not itself."""
_STIFFNESS_NM_RAD, _DAMPING_NM_S_RAD, _ARMATURE_KG_M2 = 60.0, 2.5, 0.01
"""Of the motors: the joint follows within 2 mrad at rest. Estimates."""
_JAW_FRICTION = (1.5, 0.02, 0.0)
_TABLE_FRICTION = (0.8, 0.005, 0.0001)
_CUBE_FRICTION = (1.0, 0.005, 0.0005)
_CUBE_KG_M3 = 700.0
_TABLE_RGBA = (0.80, 0.76, 0.70, 1.0)
_TABLE_SIZE_M, _TABLE_CENTRE_M = (0.70, 0.80, 0.05), (0.15, 0.0, -0.025)
_CONTACT_SPRING = (0.004, 1.0)
"""Time constant [s] and damping ratio."""
_CONTACT_IMPEDANCE = (0.98, 0.999, 0.001, 0.5, 2.0)


class So101World:
    """One MuJoCo model and its state; from one thread at a time."""

    def __init__(self, cubes: Sequence[Cube]) -> None:
        """Build, with every joint at 0 and the cubes where they lie."""
        spec = read_urdf(urdf())
        _prepare_robot(spec)
        _add_table(spec)
        for cube in cubes:
            _add_cube(spec, cube)
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.impratio = 10.0  # a held cube creeps out of the jaws otherwise
        spec.option.timestep = STEP_S / _SUBSTEPS
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        joints = [self._model.joint(name) for name in JOINTS]
        self._positions = np.array([joint.qposadr[0] for joint in joints])
        self._velocities = np.array([joint.dofadr[0] for joint in joints])
        self._cubes = {cube.name: self._model.joint(cube.name) for cube in cubes}
        self._tcp = self._model.body(TCP_LINK).id
        self._refresh()

    def _refresh(self) -> None:
        """Let body poses follow the joints; a step leaves them where they were before it."""
        mujoco.mj_kinematics(self._model, self._data)

    def set_joints(self, position: Sequence[float]) -> None:
        """Put the joints, in the order of `JOINTS`, at `position` [rad], at rest."""
        self._data.qpos[self._positions] = position
        self._data.qvel[self._velocities] = 0.0
        self._refresh()

    def set_cubes(self, poses: Mapping[str, RawPose]) -> None:
        """Put the named cubes somewhere, at rest."""
        for name, (position, (x, y, z, w)) in poses.items():
            self._cube_position(name)[:] = [*position, w, x, y, z]
            start = self._cubes[name].dofadr[0]
            self._data.qvel[start : start + 6] = 0.0
        self._refresh()

    def _cube_position(self, name: str) -> F64:
        start = self._cubes[name].qposadr[0]
        position: F64 = self._data.qpos[start : start + 7]
        return position

    def step(self, position: F64, velocity: F64) -> None:
        """Advance by `STEP_S`, the motors aiming at these, in the order of `JOINTS`
        [rad, rad/s].
        """
        # A servo's force is stiffness * (control - position) - damping * velocity.
        lead_s = _DAMPING_NM_S_RAD / _STIFFNESS_NM_RAD
        self._data.ctrl[:] = position + lead_s * velocity
        mujoco.mj_step(self._model, self._data, _SUBSTEPS)
        self._refresh()

    def joint_states(self) -> tuple[F64, F64]:
        """Measured positions and velocities, each float64 (6,), in the order of `JOINTS`."""
        return self._data.qpos[self._positions], self._data.qvel[self._velocities]

    def cube_poses(self) -> dict[str, RawPose]:
        """Where the cubes' centres are, by name."""
        poses: dict[str, RawPose] = {}
        for name in self._cubes:
            x_m, y_m, z_m, w, x, y, z = self._cube_position(name).tolist()
            poses[name] = ((x_m, y_m, z_m), (x, y, z, w))
        return poses

    def T_base_tcp(self) -> F64:
        """Pose (4, 4) of the TCP in the base frame [m]."""
        pose = np.eye(4)
        pose[:3, :3] = self._data.xmat[self._tcp].reshape(3, 3)
        pose[:3, 3] = self._data.xpos[self._tcp]
        return pose

    def render(self, calibration: CameraCalibration, width: int, height: int) -> NDArray[np.uint8]:
        """Draw what a camera on the base or at the TCP sees: uint8 (height, width, 3) RGB."""
        mount = np.eye(4) if calibration.mount == "base" else self.T_base_tcp()
        return render(self._model, self._data, calibration, mount, width, height)


def _prepare_robot(spec: mujoco.MjSpec) -> None:
    """Motors at the joints, and shapes that touch only what is not the robot."""
    for body in spec.bodies:
        body.gravcomp = 1.0
    for geom in spec.geoms:
        if geom.group != VISUAL_GROUP:
            _make_solid(geom, _JAW_FRICTION, _ROBOT)
    for name, effort_nm in zip(JOINTS, (*EFFORT_NM, JAW_EFFORT_NM), strict=True):
        joint = spec.joint(name)
        joint.armature = _ARMATURE_KG_M2
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_TRUE
        joint.actfrcrange = (-effort_nm, effort_nm)
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.gaintype, motor.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
        motor.gainprm[0] = _STIFFNESS_NM_RAD
        motor.biasprm[1], motor.biasprm[2] = -_STIFFNESS_NM_RAD, -_DAMPING_NM_S_RAD


def _add_table(spec: mujoco.MjSpec) -> None:
    table = spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=np.array(_TABLE_SIZE_M) / 2,
        pos=_TABLE_CENTRE_M,
        rgba=_TABLE_RGBA,
    )
    table.group = VISUAL_GROUP
    _make_solid(table, _TABLE_FRICTION, _SURROUNDINGS)


def _add_cube(spec: mujoco.MjSpec, cube: Cube) -> None:
    turn = (np.cos(cube.yaw_rad / 2), 0.0, 0.0, np.sin(cube.yaw_rad / 2))
    body = spec.worldbody.add_body(
        name=cube.name, pos=(cube.x_m, cube.y_m, cube.edge_m / 2), quat=turn
    )
    body.add_freejoint(name=cube.name)
    box = body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX, size=[cube.edge_m / 2] * 3, rgba=RGBA_BY_COLOUR[cube.name]
    )
    box.density = _CUBE_KG_M3
    box.group = VISUAL_GROUP
    _make_solid(box, _CUBE_FRICTION, _SURROUNDINGS)


def _make_solid(geom: mujoco.MjsGeom, friction: Sequence[float], bit: int) -> None:
    geom.contype, geom.conaffinity = bit, 0 if bit == _ROBOT else _ROBOT | _SURROUNDINGS
    geom.condim = 4
    geom.friction, geom.solref, geom.solimp = friction, _CONTACT_SPRING, _CONTACT_IMPEDANCE

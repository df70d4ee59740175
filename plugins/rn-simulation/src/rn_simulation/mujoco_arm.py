"""Arms, table and cubes in MuJoCo."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from rn_simulation.arm_cell import ArmCell, carrying_arm
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
from rn_simulation.light import AMBIENT, DIFFUSE, LIGHT_DIRECTION, backdrop
from rn_simulation.mujoco_scene import VISUAL_GROUP, cast_rays, read_urdf
from roboneuron import CameraCalibration

FAR_M = 8.0
F32 = NDArray[np.float32]


def render(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    calibration: CameraCalibration,
    T_base_mount: F64,
    width: int,
    height: int,
) -> tuple[NDArray[np.uint8], Callable[[], F32]]:
    """Render a camera's image, uint8 (H, W, 3) RGB, without shadows, and a function for its depth,
    see `ArmWorld.render_depth`; rays go through the middle of each pixel.

    Args:
        model, data: the world; body poses are up to date.
        calibration: intrinsics for `width` x `height` and the camera's pose in its mount frame.
        T_base_mount: float64 (4, 4), pose of the mount frame in the base frame.
    """
    pose = T_base_mount @ calibration.T_mount_camera
    in_camera = _rays(tuple(calibration.intrinsics.ravel().tolist()), width, height)
    rays = in_camera @ pose[:3, :3].T
    origin = np.ascontiguousarray(pose[:3, 3])
    geoms, distances, normals = cast_rays(model, data, origin, rays, FAR_M)
    hit = np.flatnonzero(geoms >= 0)
    light = np.array(LIGHT_DIRECTION) / np.linalg.norm(LIGHT_DIRECTION)
    brightness = AMBIENT + DIFFUSE * np.maximum(normals[hit] @ light, 0.0)
    image = np.broadcast_to(backdrop(height), (height, width, 3)).reshape(-1, 3).copy()
    image[hit] = (255.0 * model.geom_rgba[:, :3])[geoms[hit]] * brightness.astype(np.float32)[
        :, None
    ]

    def depth_m() -> F32:
        along = np.where(geoms >= 0, distances * in_camera[:, 2], np.nan)
        return along.astype(np.float32).reshape(height, width)

    return image.reshape(height, width, 3), depth_m


@functools.lru_cache(maxsize=4)
def _rays(intrinsics: tuple[float, ...], width: int, height: int) -> F64:
    """Directions (H * W, 3) of unit length in the camera's optical frame, row by row."""
    fx, _, cx, _, fy, cy, *_ = intrinsics
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    x = (u.ravel() - cx) / fx
    y = (v.ravel() - cy) / fy
    rays = np.column_stack([x, y, np.ones_like(x)])
    directions: F64 = rays / np.linalg.norm(rays, axis=1)[:, None]
    return directions


F64 = NDArray[np.float64]
Friction = tuple[float, float, float]
"""Sliding, spinning and rolling (the last two in m)."""

_ROBOT, _SURROUNDINGS = 1, 2
"""Collision bits: the robot collides with its surroundings, not with itself."""
_CONTACT_IMPEDANCE = (0.98, 0.999, 0.001, 0.5, 2.0)
_TABLE_FRICTION = (TABLE_FRICTION, 0.005, 0.0001)


@dataclass(frozen=True, kw_only=True, slots=True)
class Servo:
    """A joint's motor: force = stiffness * (goal - position) - damping * velocity.

    Attributes:
        stiffness, damping: [Nm/rad, Nm s/rad] or [N/m, N s/m].
        armature: inertia of motor and gears at the joint [kg m^2, kg].
    """

    stiffness: float
    damping: float
    armature: float


@dataclass(frozen=True, kw_only=True, slots=True)
class MujocoCell:
    """MuJoCo's parameters of a cell, in addition to its joints.

    Attributes:
        urdf: XML text of the robot.
        tcp_links: TCP link of each arm.
        servos: motors in the order of the cell's `joints`.
        friction: friction of the robot's collision shapes.
        table_size_m, table_centre_m: size and centre of the table's plate.
        contact_spring: time constant [s] and damping ratio of contacts.
        substeps: physics steps per step; contacts are springs, which need short ones.
        motors_carry_arm: the arm's weight counts towards the limits of its motors.
    """

    urdf: str
    tcp_links: tuple[str, ...]
    servos: tuple[Servo, ...]
    friction: Friction
    table_size_m: tuple[float, float, float]
    table_centre_m: tuple[float, float, float]
    contact_spring: tuple[float, float]
    substeps: int
    motors_carry_arm: bool


class MujocoArmWorld:
    """One MuJoCo model and its state; follows the protocol `ArmWorld`."""

    engine: Engine = "mujoco"

    def __init__(self, cell: ArmCell, facts: MujocoCell, cubes: Sequence[Cube]) -> None:
        """Build the world, with every joint at 0 and the cubes at their start poses."""
        self._cell, self._substeps = cell, facts.substeps
        spec = read_urdf(facts.urdf)
        _prepare_robot(spec, cell, facts)
        _add_table(spec, facts)
        for cube in cubes:
            _add_cube(spec, cube, facts)
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.impratio = 10.0  # otherwise a held cube creeps out of the gripper
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        joints = [self._model.joint(name) for name in cell.joints]
        self._positions = np.array([joint.qposadr[0] for joint in joints])
        self._velocities = np.array([joint.dofadr[0] for joint in joints])
        self._cubes = {cube.name: self._model.joint(cube.name) for cube in cubes}
        self._tcp = [self._model.body(link).id for link in facts.tcp_links]
        # A servo's force is stiffness * (control - position) - damping * velocity.
        self._lead_s = np.array([servo.damping / servo.stiffness for servo in facts.servos])
        self._refresh()

    def _refresh(self) -> None:
        """Update body poses to the joints; after a step they still refer to its start."""
        mujoco.mj_kinematics(self._model, self._data)

    def set_joints(self, position: Sequence[float]) -> None:
        """See `ArmWorld`."""
        self._data.qpos[self._positions] = position
        self._data.qvel[self._velocities] = 0.0
        self._refresh()

    def set_cubes(self, poses: Mapping[str, RawPose]) -> None:
        """See `ArmWorld`."""
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
        """See `ArmWorld`."""
        self._model.opt.timestep = step_s / self._substeps
        joints = [self._model.joint(name).id for name in self._cell.joints]
        self._model.jnt_actfrcrange[joints] = np.outer(force, (-1.0, 1.0))

    def step(self, position: F64, velocity: F64) -> None:
        """See `ArmWorld`."""
        self._data.ctrl[:] = position + self._lead_s * velocity
        mujoco.mj_step(self._model, self._data, self._substeps)
        self._refresh()

    def joint_states(self) -> tuple[F64, F64]:
        """See `ArmWorld`."""
        return self._data.qpos[self._positions], self._data.qvel[self._velocities]

    def cube_poses(self) -> dict[str, RawPose]:
        """See `ArmWorld`."""
        poses: dict[str, RawPose] = {}
        for name in self._cubes:
            x_m, y_m, z_m, w, x, y, z = self._cube_position(name).tolist()
            poses[name] = ((x_m, y_m, z_m), (x, y, z, w))
        return poses

    def T_base_tcp(self, arm: int = 0) -> F64:
        """See `ArmWorld`."""
        pose = np.eye(4)
        pose[:3, :3] = self._data.xmat[self._tcp[arm]].reshape(3, 3)
        pose[:3, 3] = self._data.xpos[self._tcp[arm]]
        return pose

    def render(self, calibration: CameraCalibration, width: int, height: int) -> NDArray[np.uint8]:
        """See `ArmWorld`."""
        return self._render(calibration, width, height)[0]

    def render_depth(
        self, calibration: CameraCalibration, width: int, height: int
    ) -> tuple[NDArray[np.uint8], F32]:
        """See `ArmWorld`."""
        image, depth_m = self._render(calibration, width, height)
        return image, depth_m()

    def _render(
        self, calibration: CameraCalibration, width: int, height: int
    ) -> tuple[NDArray[np.uint8], Callable[[], F32]]:
        arm = carrying_arm(calibration.mount, self._cell.arms)
        mount = np.eye(4) if arm is None else self.T_base_tcp(arm)
        return render(self._model, self._data, calibration, mount, width, height)

    def close(self) -> None:
        """See `ArmWorld`; MuJoCo frees its objects with the last reference."""


def _prepare_robot(spec: mujoco.MjSpec, cell: ArmCell, facts: MujocoCell) -> None:
    """Add motors to the joints, and collisions between the robot and other objects only."""
    for body in spec.bodies:
        body.gravcomp = 1.0
    for geom in spec.geoms:
        if geom.group != VISUAL_GROUP:
            _make_solid(geom, facts, facts.friction, _ROBOT)
    for name, servo in zip(cell.joints, facts.servos, strict=True):
        joint = spec.joint(name)
        joint.armature = servo.armature
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_TRUE
        joint.actfrcrange = (-1.0, 1.0)  # set by prepare_physics
        joint.actgravcomp = facts.motors_carry_arm
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.gaintype, motor.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
        motor.gainprm[0] = servo.stiffness
        motor.biasprm[1], motor.biasprm[2] = -servo.stiffness, -servo.damping


def _add_table(spec: mujoco.MjSpec, facts: MujocoCell) -> None:
    table = spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=np.array(facts.table_size_m) / 2,
        pos=facts.table_centre_m,
        rgba=TABLE_RGBA,
    )
    table.group = VISUAL_GROUP
    _make_solid(table, facts, _TABLE_FRICTION, _SURROUNDINGS)


def _add_cube(spec: mujoco.MjSpec, cube: Cube, facts: MujocoCell) -> None:
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
    _make_solid(box, facts, CUBE_FRICTION, _SURROUNDINGS)


def _make_solid(geom: mujoco.MjsGeom, facts: MujocoCell, friction: Friction, bit: int) -> None:
    geom.contype, geom.conaffinity = bit, 0 if bit == _ROBOT else _ROBOT | _SURROUNDINGS
    geom.condim = 4
    geom.friction, geom.solref = friction, facts.contact_spring
    geom.solimp = _CONTACT_IMPEDANCE

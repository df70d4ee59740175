"""The world in MuJoCo."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from rn_robot_bases.description import urdf
from rn_robot_bases.drivetrain import JointTargets, JointValues
from rn_robot_bases.platform import Platform
from rn_robot_bases.world import HINGE_TORQUE_NM, START_HEIGHT_M
from rn_simulation.mujoco_scene import read_urdf
from rn_simulation.planar_motion import PlanarPose

_SUBSTEPS = 4
"""Physics steps per step, because contacts are springs, and a skidding wheel hops on soft ones."""
_STIFFNESS_PER_NM, _DAMPING_PER_NM, _ARMATURE_PER_NM = 10.0, 0.2, 0.001
"""A motor reaches its full torque at an error of 0.1 rad or 5 rad/s; critically damped for its own
inertia.
"""
_CONTACT_SPRING, _CONTACT_IMPEDANCE = (0.0025, 1.0), (0.999, 0.9999, 0.001, 0.5, 2.0)
"""Stiff enough that a wheel sinks in by less than 0.1 % of its radius; more would affect
odometry.
"""


class MujocoBaseWorld:
    """One MuJoCo model and its state; follows the protocol `World`."""

    def __init__(self, platform: Platform, step_s: float) -> None:
        """Build the world."""
        spec = read_urdf(urdf(platform))
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0.0, 0.0, 1.0))
        base = spec.body(platform.base_link)
        base.add_freejoint(name=platform.base_link)
        base.pos[2] = START_HEIGHT_M
        for geom in spec.geoms:
            geom.friction[0], geom.solref, geom.solimp = (
                platform.friction,
                _CONTACT_SPRING,
                _CONTACT_IMPEDANCE,
            )
        if platform.is_body_frictionless:
            for geom in base.geoms:
                geom.condim, geom.priority = 1, 1
        for name in platform.driven_wheels:
            _add_motor(spec, name, platform.wheel_torque_nm)
        for name in platform.hinges:
            _add_motor(spec, name, HINGE_TORQUE_NM)
        spec.option.timestep = step_s / _SUBSTEPS
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
        spec.option.impratio = 10.0
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        self._step_s = step_s
        self._base = self._model.joint(platform.base_link).qposadr[0]
        self._adr = {name: self._model.joint(name).qposadr[0] for name in platform.joints}
        self._motors = {
            name: self._model.actuator(name).id
            for name in (*platform.driven_wheels, *platform.hinges)
        }
        self._turned = dict.fromkeys(platform.driven_wheels, 0.0)

    def step(self, targets: JointTargets) -> None:
        """See `World`; a wheel follows the integral of its velocity, so it is locked at velocity
        0.
        """
        lead_s = _DAMPING_PER_NM / _STIFFNESS_PER_NM
        for name, velocity in targets.velocity.items():
            self._turned[name] += velocity * self._step_s
            self._data.ctrl[self._motors[name]] = self._turned[name] + lead_s * velocity
        for name, position in targets.position.items():
            self._data.ctrl[self._motors[name]] = position
        mujoco.mj_step(self._model, self._data, _SUBSTEPS)

    def joint_positions(self) -> JointValues:
        """See `World`."""
        return {name: float(self._data.qpos[adr]) for name, adr in self._adr.items()}

    def base_pose(self) -> PlanarPose:
        """See `World`."""
        x, y, _, qw, qx, qy, qz = self._data.qpos[self._base : self._base + 7].tolist()
        yaw = math.atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))
        return PlanarPose(x_m=x, y_m=y, yaw_rad=yaw)

    def close(self) -> None:
        """See `World`; MuJoCo frees its objects with the last reference."""


def _add_motor(spec: mujoco.MjSpec, joint: str, torque_nm: float) -> None:
    """A servo: torque = stiffness * (control - angle) - damping * velocity, within its limit."""
    spec.joint(joint).armature = _ARMATURE_PER_NM * torque_nm
    motor = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    motor.gaintype, motor.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
    motor.gainprm[0] = _STIFFNESS_PER_NM * torque_nm
    motor.biasprm[1], motor.biasprm[2] = (
        -_STIFFNESS_PER_NM * torque_nm,
        -_DAMPING_PER_NM * torque_nm,
    )
    motor.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
    motor.forcerange = np.array([-torque_nm, torque_nm])

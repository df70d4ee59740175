"""The world in PyBullet."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

import pybullet

from rn_robot_bases.description import urdf
from rn_robot_bases.drivetrain import JointTargets, JointValues
from rn_robot_bases.platform import Platform
from rn_robot_bases.world import HINGE_TORQUE_NM, START_HEIGHT_M
from rn_simulation.planar_motion import PlanarPose


def load_body(client: int, platform: Platform) -> int:
    """Load the platform at the origin, from a file as PyBullet requires; return the body id."""
    with tempfile.TemporaryDirectory(prefix="rn-bases-") as folder:
        path = Path(folder) / f"{platform.name}.urdf"
        path.write_text(urdf(platform), encoding="utf-8")
        return int(pybullet.loadURDF(str(path), (0.0, 0.0, START_HEIGHT_M), physicsClientId=client))


class PybulletBaseWorld:
    """One PyBullet client; follows the protocol `World`."""

    def __init__(self, platform: Platform, step_s: float) -> None:
        """Connect and build the world."""
        self._platform = platform
        self._client = int(pybullet.connect(pybullet.DIRECT))
        self._connected = True
        self._parked: JointValues | None = None
        self._prepare_physics(step_s)
        self._add_floor()
        self._body = load_body(self._client, platform)
        client = self._client
        infos = [
            pybullet.getJointInfo(self._body, i, physicsClientId=client)
            for i in range(self._joint_count())
        ]
        index_by_joint = {info[1].decode(): int(info[0]) for info in infos}
        self._indices = {name: index_by_joint[name] for name in platform.joints}
        self._set_friction()
        dynamics = pybullet.getDynamicsInfo(self._body, -1, physicsClientId=client)
        self._base_from_inertial = pybullet.invertTransform(dynamics[3], dynamics[4])

    def _joint_count(self) -> int:
        return int(pybullet.getNumJoints(self._body, physicsClientId=self._client))

    def _prepare_physics(self, step_s: float) -> None:
        """Set up the physics; with the engine's friction cone a skid jitters by half its turning
        rate and a parked car creeps by 1 mm/s.
        """
        pybullet.setGravity(0.0, 0.0, -9.81, physicsClientId=self._client)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=step_s,
            enableConeFriction=0,
            deterministicOverlappingPairs=1,
            physicsClientId=self._client,
        )

    def _add_floor(self) -> None:
        shape = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=self._client)
        floor = pybullet.createMultiBody(0, shape, physicsClientId=self._client)
        pybullet.changeDynamics(floor, -1, lateralFriction=1.0, physicsClientId=self._client)

    def _set_friction(self) -> None:
        client = self._client
        if self._platform.is_body_frictionless:
            pybullet.changeDynamics(self._body, -1, lateralFriction=0.0, physicsClientId=client)
        friction = self._platform.friction  # PyBullet multiplies it by the floor's
        for name in (*self._platform.driven_wheels, *self._platform.free_wheels):
            pybullet.changeDynamics(
                self._body, self._indices[name], lateralFriction=friction, physicsClientId=client
            )
        for name in self._platform.free_wheels:
            pybullet.setJointMotorControl2(
                self._body,
                self._indices[name],
                pybullet.VELOCITY_CONTROL,
                force=0,
                physicsClientId=client,
            )

    def step(self, targets: JointTargets) -> None:
        """See `World`."""
        wheels = targets.velocity
        if any(wheels.values()):
            self._parked = None
            self._control(
                pybullet.VELOCITY_CONTROL,
                "targetVelocities",
                wheels,
                self._platform.wheel_torque_nm,
            )
        else:
            # A motor at velocity 0 would let the base creep by 0.2 mm/s under its own weight.
            self._parked = self._parked or {
                n: p for n, p in self.joint_positions().items() if n in wheels
            }
            self._control(
                pybullet.POSITION_CONTROL,
                "targetPositions",
                self._parked,
                self._platform.wheel_torque_nm,
            )
        if targets.position:
            self._control(
                pybullet.POSITION_CONTROL, "targetPositions", targets.position, HINGE_TORQUE_NM
            )
        pybullet.stepSimulation(physicsClientId=self._client)

    def _control(self, mode: int, goal: str, values: JointValues, torque_nm: float) -> None:
        joints = [self._indices[name] for name in values]
        goals = {goal: list(values.values()), "forces": [torque_nm] * len(joints)}
        pybullet.setJointMotorControlArray(
            self._body, joints, mode, physicsClientId=self._client, **goals
        )

    def joint_positions(self) -> JointValues:
        """See `World`."""
        states = pybullet.getJointStates(
            self._body, list(self._indices.values()), physicsClientId=self._client
        )
        return {name: float(state[0]) for name, state in zip(self._indices, states, strict=True)}

    def base_pose(self) -> PlanarPose:
        """See `World`."""
        inertial = pybullet.getBasePositionAndOrientation(self._body, physicsClientId=self._client)
        (x, y, _), (qx, qy, qz, qw) = pybullet.multiplyTransforms(
            *inertial, *self._base_from_inertial
        )
        yaw = math.atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))
        return PlanarPose(x_m=float(x), y_m=float(y), yaw_rad=yaw)

    def close(self) -> None:
        """See `World`."""
        if self._connected:
            self._connected = False
            pybullet.disconnect(self._client)

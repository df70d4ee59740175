"""A robot in memory: a gantry of three slides with a wrist of three hinges, and its driver."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from roboneuron import (
    CameraProfile,
    CameraSpec,
    DriverSpec,
    Endpoint,
    GripperProfile,
    InvalidInputError,
    JointCommand,
    JointLimits,
    JointSample,
    RobotProfile,
    RobotSpec,
    RobotState,
    StateError,
    Topics,
    Workspace,
)

SLIDES = ("slide_x", "slide_y", "slide_z")
"""Prismatic joints, base to tip, along the axes of the base frame."""
HINGES = ("yaw", "pitch", "roll")
"""Revolute joints after the slides, about z, y and x."""
FINGER = "finger"
"""The gripper's joint: 0 m closed, 0.04 m open."""
FINGER_BOUNDS = (0.0, 0.04, 0.1)
"""Lower and upper position of the finger [m], and its velocity limit [m/s]."""

_AXES = {
    "slide_x": "1 0 0",
    "slide_y": "0 1 0",
    "slide_z": "0 0 1",
    "yaw": "0 0 1",
    "pitch": "0 1 0",
    "roll": "1 0 0",
}
_LOWER = np.array([-1.0, -1.0, -1.0, -3.0, -1.4, -3.0])
_HOME = np.array([0.1, -0.2, 0.3, 0.2, 0.1, -0.1])


class FakeDriverOptions(BaseModel):
    """Options of the fake driver."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    start_open: bool = Field(default=True, description="the gripper is open at first")


def _urdf() -> str:
    parts = ['<robot name="gantry"><link name="base"/>']
    parent = "base"
    for index, (joint, axis) in enumerate(_AXES.items()):
        child = "tcp" if joint == HINGES[-1] else f"{joint}_link"
        kind = "prismatic" if joint in SLIDES else "revolute"
        bound = -_LOWER[index]
        inertia = '<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/>'
        parts.append(f'<link name="{child}"><inertial><mass value="1"/>{inertia}</inertial></link>')
        parts.append(
            f'<joint name="{joint}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="0 0 0" rpy="0 0 0"/><axis xyz="{axis}"/>'
            f'<limit lower="{-bound}" upper="{bound}" velocity="1" effort="100"/></joint>'
        )
        parent = child
    parts.append(
        f'<link name="finger_link"/><joint name="{FINGER}" type="prismatic"><parent link="tcp"/>'
        '<child link="finger_link"/><axis xyz="0 1 0"/>'
        '<limit lower="0" upper="0.04" velocity="0.1" effort="20"/></joint></robot>'
    )
    return "".join(parts)


def gantry_profile() -> RobotProfile:
    """The fake robot's profile: six joints that directly give the TCP pose, a gripper, two
    cameras.
    """
    return RobotProfile(
        name="gantry",
        urdf=_urdf(),
        base_link="base",
        tcp_link="tcp",
        arm_joints=(*SLIDES, *HINGES),
        limits=JointLimits(
            lower=_LOWER.copy(),
            upper=-_LOWER,
            velocity=np.ones(6),
            acceleration=np.full(6, 5.0),
            effort=np.full(6, 100.0),
        ),
        home_rad=_HOME.copy(),
        gripper=GripperProfile(joint=FINGER, closed_position=0.0, open_position=0.04),
        cameras=(
            CameraProfile(
                name="front", role="primary", frame_id="front_optical", width=64, height=48
            ),
            CameraProfile(name="hand", role="wrist", frame_id="hand_optical", width=64, height=48),
        ),
        workspace=Workspace(lower_m=np.full(3, -0.9), upper_m=np.full(3, 0.9)),
        endpoints=(
            Endpoint(
                name="joint_states",
                kind="read",
                topic="joint_states",
                type="sensor_msgs/msg/JointState",
                summary="Measured joints.",
            ),
        ),
    )


class FakeDriver:
    """Follows the protocol `RobotDriver`; joints move linearly in time to their targets."""

    def __init__(
        self, config: FakeDriverOptions | None, profile: RobotProfile, topics: Topics
    ) -> None:
        self._options = config or FakeDriverOptions()
        self._profile = profile
        self._topics = topics
        self._start: dict[str, float] | None = None
        self._goal: dict[str, float] = {}
        self._begun_s = self._duration_s = 0.0

    def open(self) -> None:
        """Start at home."""
        home = self._profile.home_rad
        gripper = self._profile.gripper
        assert home is not None
        here = dict(zip(self._profile.arm_joints, home.tolist(), strict=True))
        if gripper is not None:
            here[gripper.joint] = gripper.to_position(float(self._options.start_open))
        self._move(here, here, 0.0)

    def _move(self, start: dict[str, float], goal: dict[str, float], duration_s: float) -> None:
        self._start, self._goal, self._begun_s, self._duration_s = (
            start,
            goal,
            time.monotonic(),
            duration_s,
        )

    def _positions(self) -> dict[str, float]:
        if self._start is None:
            raise StateError("The fake robot is not open; call open() first.")
        passed_s = time.monotonic() - self._begun_s
        share = 1.0 if passed_s >= self._duration_s else passed_s / self._duration_s
        return {
            name: start + share * (self._goal[name] - start) for name, start in self._start.items()
        }

    def _velocity(self, name: str) -> float:
        assert self._start is not None
        is_moving = time.monotonic() - self._begun_s < self._duration_s
        return (self._goal[name] - self._start[name]) / self._duration_s if is_moving else 0.0

    def read(self) -> RobotState:
        """Current joint positions. Raises StateError unless open."""
        positions = self._positions()
        gripper = self._profile.gripper
        return RobotState(
            joints=JointSample(
                names=tuple(positions),
                position=np.array(list(positions.values())),
                velocity=np.array([self._velocity(name) for name in positions]),
                stamp_ns=self._topics.now_ns(),
            ),
            gripper_open=None if gripper is None else gripper.to_opening(positions[gripper.joint]),
        )

    def send(self, command: JointCommand) -> JointCommand:
        """Start a motion, slower than commanded if the velocity limits require it.

        Raises:
            InvalidInputError: an unknown joint, a joint twice, a position that is not finite or
                outside the limits, no duration.
        """
        here = self._positions()
        limits = self._profile.limits
        assert limits is not None
        if command.position.shape != (len(command.names),):
            raise InvalidInputError(
                f"A command names {len(command.names)} joints, got {command.position.shape}."
            )
        if len(set(command.names)) < len(command.names):
            raise InvalidInputError(f"A command names a joint twice: {', '.join(command.names)}.")
        if not (math.isfinite(command.duration_s) and command.duration_s > 0):
            raise InvalidInputError(
                f"A command lasts {command.duration_s} s, expected more than 0."
            )
        rows = zip(
            limits.lower.tolist(), limits.upper.tolist(), limits.velocity.tolist(), strict=True
        )
        bounds = dict(zip(self._profile.arm_joints, rows, strict=True))
        duration_s = command.duration_s
        for name, position in zip(command.names, command.position.tolist(), strict=True):
            if name not in here:
                raise InvalidInputError(
                    f"The robot has no joint {name!r}, expected some of {', '.join(here)}."
                )
            low, high, velocity = bounds.get(name, FINGER_BOUNDS)
            if not low <= position <= high:
                raise InvalidInputError(
                    f"Joint {name!r} is sent to {position}, expected {low:g} .. {high:g}."
                )
            duration_s = max(duration_s, abs(position - here[name]) / velocity)
        goal = {**here, **dict(zip(command.names, command.position.tolist(), strict=True))}
        self._move(here, goal, duration_s)
        return replace(command, duration_s=duration_s)

    def hold(self) -> None:
        """Stop at the current joint positions."""
        here = self._positions()
        self._move(here, here, 0.0)

    def close(self) -> None:
        """Clear the state."""
        self._start = None


FAKE_ROBOT = RobotSpec(
    name="gantry",
    summary="A gantry with a wrist and a gripper that exists in memory.",
    target="rn_testing.fakes.robot:gantry_profile",
    drivers=(
        DriverSpec(
            name="simulated",
            summary="Moves in memory, by the clock.",
            target="rn_testing.fakes.robot:FakeDriver",
            config="rn_testing.fakes.robot:FakeDriverOptions",
            simulated=True,
        ),
    ),
    cameras=(CameraSpec(name="front", role="primary"), CameraSpec(name="hand", role="wrist")),
)
"""Descriptor of the fake robot."""

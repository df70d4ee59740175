"""A robot with two arms of six joints and a gripper each, like ALOHA, with three cameras, and one
with a single such arm; they move in memory.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from roboneuron.plugins.hookspecs import hookimpl
from roboneuron.plugins.specs import CameraSpec, DriverSpec, PerceptionSpec, RobotSpec

if TYPE_CHECKING:
    from roboneuron.contract import (
        CameraProfile,
        Frame,
        JointCommand,
        RobotProfile,
        RobotState,
        Topics,
    )

PLUGIN = "two_arms_plugin"
ARM = ("waist", "shoulder", "elbow", "forearm_roll", "wrist_angle", "wrist_rotate")
SIDES = {"left": 0.5, "right": -0.5}
"""The arms, and their positions along y [m]."""
JOINTS = tuple(f"{side}_{joint}" for side in SIDES for joint in ARM)
FINGERS = tuple(f"{side}_finger" for side in SIDES)
ONE_ARM = {"": 0.0}
HOME_RAD = (0.0, -0.9, 1.4, 0.3, 0.6, -0.2)
OPEN_M = 0.057
VELOCITY_RAD_S, ACCELERATION_RAD_S2 = 3.0, 15.0
REACH_RAD = 2.8
CAMERAS = {"high": "primary", "left_wrist": "wrist", "right_wrist": "right_wrist"}
RATE_HZ = 50.0
_AXES = {
    "waist": ("0 0 0.1", "0 0 1"),
    "shoulder": ("0 0 0.05", "0 1 0"),
    "elbow": ("0.06 0 0.3", "0 1 0"),
    "forearm_roll": ("0.2 0 0", "1 0 0"),
    "wrist_angle": ("0.1 0 0", "0 1 0"),
    "wrist_rotate": ("0.07 0 0", "1 0 0"),
}


def _named(side: str, name: str) -> str:
    return f"{side}_{name}" if side else name


def urdf(sides: Mapping[str, float]) -> str:
    """A description: chains from a common base."""
    parts = ['<robot name="arms"><link name="table"/>']
    for own, y_m in sides.items():
        side = own or "only"
        parts.append(
            f'<link name="{side}_base"/><joint name="{side}_mount" type="fixed">'
            f'<parent link="table"/><child link="{side}_base"/><origin xyz="0 {y_m} 0"/></joint>'
        )
        parent = f"{side}_base"
        for joint, (place, axis) in _AXES.items():
            child = f"{side}_{joint}_link"
            parts.append(
                f'<link name="{child}"/><joint name="{_named(own, joint)}" type="revolute">'
                f'<parent link="{parent}"/><child link="{child}"/><origin xyz="{place}"/>'
                f'<axis xyz="{axis}"/><limit lower="-{REACH_RAD}" upper="{REACH_RAD}" '
                f'velocity="{VELOCITY_RAD_S}" effort="30"/></joint>'
            )
            parent = child
        parts.append(
            f'<link name="{side}_tcp"/><joint name="{side}_tcp_mount" type="fixed">'
            f'<parent link="{parent}"/><child link="{side}_tcp"/>'
            '<origin xyz="0.14 0 0" rpy="0 1.5707963 0"/></joint>'
            f'<link name="{side}_finger_link"/>'
            f'<joint name="{_named(own, "finger")}" type="prismatic">'
            f'<parent link="{parent}"/><child link="{side}_finger_link"/><axis xyz="0 1 0"/>'
            f'<limit lower="0" upper="{OPEN_M}" velocity="0.2" effort="5"/></joint>'
        )
    return "".join([*parts, "</robot>"])


def profile() -> RobotProfile:
    """Profile of both arms."""
    return _profile("two-arms", SIDES)


def one_arm() -> RobotProfile:
    """Profile of the robot with one arm."""
    return replace(_profile("one-arm", ONE_ARM), arms=())


def _profile(name: str, sides: Mapping[str, float]) -> RobotProfile:
    import numpy as np

    from roboneuron.contract import (
        ArmProfile,
        CameraProfile,
        GripperProfile,
        JointLimits,
        RobotProfile,
    )

    arms = tuple(
        ArmProfile(
            name=side,
            joints=tuple(_named(side, joint) for joint in ARM),
            base_link=f"{side or 'only'}_base",
            tcp_link=f"{side or 'only'}_tcp",
            gripper=GripperProfile(
                joint=_named(side, "finger"), closed_position=0.0, open_position=OPEN_M
            ),
        )
        for side in sides
    )
    joints = tuple(joint for arm in arms for joint in arm.joints)
    one = np.ones(len(joints))
    return RobotProfile(
        name=name,
        urdf=urdf(sides),
        base_link="table",
        tcp_link=arms[0].tcp_link,
        arm_joints=joints,
        gripper=arms[0].gripper,
        limits=JointLimits(
            lower=-REACH_RAD * one,
            upper=REACH_RAD * one,
            velocity=VELOCITY_RAD_S * one,
            acceleration=ACCELERATION_RAD_S2 * one,
            effort=30.0 * one,
        ),
        home_rad=np.array(HOME_RAD * len(sides)),
        cameras=tuple(
            CameraProfile(name=name, role=role, frame_id=f"{name}_optical", width=64, height=48)
            for name, role in CAMERAS.items()
        ),
        arms=arms,
    )


class InMemory:
    """Follows the protocol `RobotDriver`: moves linearly within the duration of each command."""

    def __init__(self, config: None, profile: RobotProfile, topics: Topics) -> None:
        import numpy as np

        self._topics, self._profile = topics, profile
        fingers = tuple(gripper.joint for gripper in profile.grippers)
        self._names = (*profile.arm_joints, *fingers)
        self._lock = threading.Lock()
        home = np.append(profile.home_rad, np.full(len(fingers), OPEN_M / 2.0))
        self._start, self._end = home, home
        self._begin_s, self._lasts_s = 0.0, 1.0

    def open(self) -> None:
        """Start at home."""

    def read(self) -> RobotState:
        """Current joint positions."""
        from roboneuron.contract import JointSample, RobotState

        with self._lock:
            position = self._position(time.monotonic())
        stamp_ns = self._topics.now_ns()
        finger = len(self._profile.arm_joints)
        joints = JointSample(names=self._names, position=position, stamp_ns=stamp_ns)
        return RobotState(joints=joints, gripper_open=float(position[finger]) / OPEN_M)

    def send(self, command: JointCommand) -> JointCommand:
        """Move there within the duration of the command."""
        with self._lock:
            self._begin_s = time.monotonic()
            self._start = self._position(self._begin_s)
            self._end = self._start.copy()
            for name, value in zip(command.names, command.position.tolist(), strict=True):
                self._end[self._names.index(name)] = value
            self._lasts_s = command.duration_s
        return command

    def hold(self) -> None:
        """Hold the current positions."""
        with self._lock:
            self._start = self._end = self._position(time.monotonic())

    def close(self) -> None:
        """Do nothing."""

    def _position(self, now_s: float):  # type: ignore[no-untyped-def]
        share = min(1.0, max(0.0, (now_s - self._begin_s) / self._lasts_s))
        return self._start + (self._end - self._start) * share


class GreyCameras:
    """Follows the protocol `PerceptionSource`: the same grey image of each camera in rotation."""

    def __init__(self, config: None, topics: Topics, cameras: tuple[CameraProfile, ...]) -> None:
        self._topics, self._cameras = topics, cameras
        self._count = 0

    def open(self) -> None:
        """Make the first image due now."""
        self._start_s = time.monotonic()

    def read(self, timeout_s: float) -> Frame:
        """The next camera's image."""
        from roboneuron.contract import Frame

        camera = self._cameras[self._count % len(self._cameras)]
        self._count += 1
        due_s = self._start_s + self._count / RATE_HZ / len(self._cameras)
        time.sleep(max(0.0, due_s - time.monotonic()))
        return Frame(
            camera=camera.name,
            image=grey(camera.height, camera.width),
            stamp_ns=self._topics.now_ns(),
            frame_id=camera.frame_id,
        )

    def close(self) -> None:
        """Do nothing."""


def grey(height: int, width: int):  # type: ignore[no-untyped-def]
    """The image."""
    import numpy as np

    return np.full((height, width, 3), 90, dtype=np.uint8)


@hookimpl
def roboneuron_robots() -> Sequence[RobotSpec]:
    """Both robots."""
    driver = DriverSpec(
        name="simulated", summary="In memory.", target=f"{PLUGIN}:InMemory", simulated=True
    )
    return [
        RobotSpec(
            name=name,
            summary="Arms of six joints, in memory.",
            target=f"{PLUGIN}:{target}",
            drivers=(driver,),
            cameras=tuple(CameraSpec(name=name, role=role) for name, role in CAMERAS.items()),
            action_widths=(7,),
        )
        for name, target in (("two-arms", "profile"), ("one-arm", "one_arm"))
    ]


@hookimpl
def roboneuron_perceptions() -> Sequence[PerceptionSpec]:
    """Its cameras."""
    return [PerceptionSpec(name="grey", summary="Grey images.", target=f"{PLUGIN}:GreyCameras")]

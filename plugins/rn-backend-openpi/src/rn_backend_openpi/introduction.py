"""A robot's introduction to the server of its model: the properties on which a control space may
depend.
"""

from __future__ import annotations

from xml.sax.saxutils import quoteattr

from rn_backend_openpi.messages import Document
from roboneuron import (
    MAX_SIDE_PX,
    ArmProfile,
    CameraProfile,
    GripperProfile,
    RobotProfile,
    foreign,
    robot_space,
)

_MOST_JOINTS = 256
_MOST_ARMS = 8
_MOST_CAMERAS = 32


def from_profile(profile: RobotProfile) -> Document:
    """Introduction of a robot: names of joints, arms and cameras, and the prismatic joints."""
    slides: list[str] = []
    if profile.arm_joints:
        channels = robot_space("joint_position", profile).channels
        slides = [channel.name for channel in channels if channel.unit == "m"]
    return {
        "name": profile.name,
        "base_link": profile.base_link,
        "tcp_link": profile.tcp_link,
        "arm_joints": list(profile.arm_joints),
        "slides": slides,
        "gripper": _from_gripper(profile.gripper),
        "arms": [
            [arm.name, list(arm.joints), arm.base_link, arm.tcp_link, _from_gripper(arm.gripper)]
            for arm in profile.arms
        ],
        "cameras": [
            [camera.name, camera.role, camera.width, camera.height] for camera in profile.cameras
        ],
    }


def _from_gripper(gripper: GripperProfile | None) -> list[object] | None:
    if gripper is None:
        return None
    return [gripper.joint, gripper.closed_position, gripper.open_position]


def to_profile(document: object) -> RobotProfile:
    """The profile of an introduction, with only the parts on which a control space may depend.

    Raises:
        ForeignDataError: a field is missing, or has another type or range than expected.
        RoboNeuronError: as `RobotProfile`.
    """
    slides = _names(foreign.field(document, "slides"), "joints that slide")
    # a profile names its prismatic joints in its URDF
    joints = "".join(f'<joint name={quoteattr(name)} type="prismatic"/>' for name in slides)
    arms = foreign.items(foreign.field(document, "arms"), "arms", most=_MOST_ARMS)
    cameras = foreign.items(foreign.field(document, "cameras"), "cameras", most=_MOST_CAMERAS)
    return RobotProfile(
        name=foreign.text(foreign.field(document, "name"), "the name of a robot"),
        urdf=f'<robot name="told">{joints}</robot>',
        base_link=foreign.text(foreign.field(document, "base_link"), "a link"),
        tcp_link=foreign.text(foreign.field(document, "tcp_link"), "a link"),
        arm_joints=_names(foreign.field(document, "arm_joints"), "joints"),
        gripper=_to_gripper(foreign.field(document, "gripper")),
        arms=tuple(_to_arm(arm) for arm in arms),
        cameras=tuple(_to_camera(camera) for camera in cameras),
    )


def _names(value: object, what: str) -> tuple[str, ...]:
    return tuple(foreign.text(name, what) for name in foreign.items(value, what, most=_MOST_JOINTS))


def _to_arm(value: object) -> ArmProfile:
    name, joints, base_link, tcp_link, gripper = foreign.items(value, "an arm", most=5, least=5)
    return ArmProfile(
        name=foreign.text(name, "an arm", 64),
        joints=_names(joints, "joints"),
        base_link=foreign.text(base_link, "a link"),
        tcp_link=foreign.text(tcp_link, "a link"),
        gripper=_to_gripper(gripper),
    )


def _to_gripper(value: object) -> GripperProfile | None:
    if value is None:
        return None
    joint, closed, opened = foreign.items(value, "a gripper", most=3, least=3)
    return GripperProfile(
        joint=foreign.text(joint, "a joint"),
        closed_position=foreign.number(closed, "a position"),
        open_position=foreign.number(opened, "a position"),
    )


def _to_camera(value: object) -> CameraProfile:
    name, role, width, height = foreign.items(value, "a camera", most=4, least=4)
    return CameraProfile(
        name=foreign.text(name, "a camera"),
        role=foreign.text(role, "a role", 64),
        frame_id="",
        width=foreign.integer(width, "a width", 1, MAX_SIDE_PX),
        height=foreign.integer(height, "a height", 1, MAX_SIDE_PX),
    )

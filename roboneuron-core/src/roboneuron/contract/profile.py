"""Facts of a robot that are independent of its driver: joints, limits, TCP, gripper, cameras,
exposed endpoints.

Arrays are kept as read-only copies.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from math import isfinite
from typing import Protocol

import numpy as np

from roboneuron.contract.arrays import F64, ReadOnly, freeze
from roboneuron.contract.joints import JointKinds
from roboneuron.contract.meshes import collision_meshes, has_collision_shapes, mesh_file
from roboneuron.contract.observation import CameraCalibration
from roboneuron.errors import InvalidInputError

ARRIVED_RAD, ARRIVED_M = 0.01, 0.001
"""Distance from its target within which a revolute and a prismatic joint count as arrived."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class JointLimits(ReadOnly):
    """Official limits of the arm's joints; arrays are float64 (n,) in the order of
    `RobotProfile.arm_joints`.

    Attributes:
        lower, upper: position [rad or m]; of a continuous joint -inf and inf where it turns without
            end.
        velocity: [rad/s or m/s].
        acceleration: [rad/s^2 or m/s^2].
        effort: [Nm or N].
        braking_offset, braking_deceleration: [rad/s], [rad/s^2] (or m) of robots that slow down
            near a position limit: the velocity towards it is at most -offset + sqrt(2 *
            deceleration * distance to the limit), and never negative. None if the velocity limit
            does not depend on position.
    """

    lower: F64
    upper: F64
    velocity: F64
    acceleration: F64
    effort: F64
    braking_offset: F64 | None = None
    braking_deceleration: F64 | None = None


class PositionsByName(Protocol):
    """Positions by joint name: a mapping, a `JointSample` or a `JointCommand`."""

    def get(self, name: str, /) -> float | None:
        """Position of a joint [rad or m]; None if it is not among these."""


@dataclass(frozen=True, kw_only=True, slots=True)
class GripperProfile:
    """A gripper driven by one joint whose position is proportional to the opening.

    Attributes:
        joint: name of the commanded joint.
        closed_position, open_position: joint position [m or rad] at opening 0 and 1.
    """

    joint: str
    closed_position: float
    open_position: float

    def to_position(self, gripper_open: float) -> float:
        """Opening 0..1 -> joint position [m or rad]."""
        return self.closed_position + gripper_open * (self.open_position - self.closed_position)

    def to_opening(self, position: float) -> float:
        """Joint position [m or rad] -> opening, clipped to 0..1; NaN stays NaN."""
        span = self.open_position - self.closed_position
        # in this order: `max(0.0, nan)` would be 0, a closed gripper
        return min(max((position - self.closed_position) / span, 0.0), 1.0)

    def opening_in(self, joints: PositionsByName | None) -> float | None:
        """Opening 0..1 among positions by joint name; None without its joint or a finite value."""
        position = None if joints is None else joints.get(self.joint)
        # `to_opening` would make 0 or 1 of infinity
        return None if position is None or not isfinite(position) else self.to_opening(position)


@dataclass(frozen=True, kw_only=True, slots=True)
class ArmProfile:
    """One arm.

    Attributes:
        name: "left", "right"; "" for the only arm of a robot.
        joints: names of its joints, base to tip.
        base_link: link in the URDF on which it is mounted.
        tcp_link: link in the URDF that its actions move; z points out of the gripper.
        gripper: None without one.
    """

    name: str
    joints: tuple[str, ...]
    base_link: str
    tcp_link: str
    gripper: GripperProfile | None = None

    def opening_in(self, joints: PositionsByName | None) -> float | None:
        """As `GripperProfile.opening_in`; None without a gripper."""
        return None if self.gripper is None else self.gripper.opening_in(joints)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class CameraProfile:
    """A camera on or near the robot.

    Attributes:
        name: as in the topic `camera/<name>/image`.
        role: its name for backends: "primary", "wrist".
        frame_id: name of the optical frame.
        width, height: nominal size [px].
        calibration: None when it was never calibrated.
    """

    name: str
    role: str
    frame_id: str
    width: int
    height: int
    calibration: CameraCalibration | None = None

    def calibration_at(self, width: int, height: int) -> CameraCalibration | None:
        """Calibration of an image of `width` x `height` [px]; None when the aspect ratio is not the
        nominal one.
        """
        if self.calibration is None or width * self.height != height * self.width:
            return None
        scale = np.diag([width / self.width, height / self.height, 1.0])
        return replace(self.calibration, intrinsics=scale @ self.calibration.intrinsics)


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Workspace(ReadOnly):
    """Axis-aligned box in the base frame that the TCP must stay in; float64 (3,) [m]."""

    lower_m: F64
    upper_m: F64


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Obstacle(ReadOnly):
    """A box in the base frame that no link may touch; float64 (3,) [m]."""

    name: str
    lower_m: F64
    upper_m: F64


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class CollisionProfile:
    """Bodies that the arm must not touch; its own shapes are the collision elements of the URDF.

    Attributes:
        min_distance_m: least distance between links that do not share a joint, and between links
            and obstacles.
        obstacles: fixed bodies around the arm.
        tool_links: links that work close to obstacles, such as fingers: they may approach
            obstacles, but not touch them.
    """

    min_distance_m: float = 0.01
    obstacles: tuple[Obstacle, ...] = ()
    tool_links: tuple[str, ...] = ()


class DistanceLimits(Protocol):
    """What a configuration says of distances; see `[limits]`."""

    @property
    def collision(self) -> bool: ...

    @property
    def min_distance_m(self) -> float | None: ...

    @property
    def obstacles(self) -> Sequence[object] | None: ...


_TOPIC = re.compile(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", re.ASCII)
_LONGEST_TOPIC = 200
TOPIC_RULE = (
    'A name is words of letters, digits and underscores with "/" between them, such as '
    "/arm/joint_states; no word "
    f"begins with a digit, and it has at most {_LONGEST_TOPIC} characters."
)
"""Source: https://design.ros2.org/articles/topic_and_service_names.html."""


def check_topic(name: str) -> None:
    """Raise InvalidInputError unless this is a valid topic name, absolute or in a namespace."""
    if len(name) > _LONGEST_TOPIC or not _TOPIC.fullmatch(name):
        raise InvalidInputError(
            f"{name[:80]!a} is not a topic name.", hint=TOPIC_RULE, path="topic"
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class Endpoint:
    """A ROS interface of the robot that the agent may use directly.

    Attributes:
        name: short snake_case noun; tools are called `publish_<name>`, `read_<name>`, `call_<name>`
            ...
        kind: "publish", "read", "service" or "action": the permitted use.
        topic: relative to the robot's namespace, or absolute.
        type: "package/msg/Name", "package/srv/Name" or "package/action/Name".
        summary: one line for the agent.
        bounds: dotted field path -> (lowest, highest) value, in the field's own unit.
        rate_hz: most messages per second; 0 means no bound.
        stop_message: field path -> value that ends a motion ("" for no stop message, "zero" for all
            zeros).
        joint_limited: check positions and velocities against the profile's joint limits.
        min_turning_radius_m: of a base with car-like steering, as a bound on its twists. 0: it
            turns on the spot.
        frame: required frame of places in sent messages (`PoseStamped` ...); empty: any.
        zones: boxes in that frame that must not contain a place.
        repeat_hz: rate at which a lasting value is repeated, because the robot stops when messages
            cease; repetitions do not count against `rate_hz`. 0: it is sent once.
    """

    name: str
    kind: str
    topic: str
    type: str
    summary: str
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    rate_hz: float = 0.0
    stop_message: str = ""
    joint_limited: bool = False
    min_turning_radius_m: float = 0.0
    repeat_hz: float = 0.0
    frame: str = ""
    zones: tuple[Obstacle, ...] = ()


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class RobotProfile:
    """Facts of one robot model.

    Attributes:
        name: as in the descriptor.
        urdf: the robot description as XML text; empty for robots without kinematics (mobile bases).
        base_link, tcp_link: link names in the URDF; actions move `tcp_link` in the frame of
            `base_link`. The TCP's z axis points out of the gripper, which the state of learned
            policies relies on.
        arm_joints: names of the joints that the controller moves, base to tip; arm after arm.
        limits: None for robots without arm joints.
        home_rad: float64 (n,), a posture that is safe to start from; None likewise.
        gripper: None without one.
        cameras: cameras of the robot.
        workspace: None if only the joint limits bound the TCP.
        collision: None when links and obstacles are not checked by default.
        endpoints: endpoints that the agent may use on the direct path.
        arms: the arms of a robot with several. Then `tcp_link` and `gripper` are those of the
            first, `base_link` is a link that carries them all, and poses, workspace, zones and
            obstacles of each arm are in its frame. () for a robot with one arm: see `each_arm`.
        mesh_folder: folder of the description, at which the paths of its meshes start and in which
            (and above) packages are looked for. Empty: absolute paths and the packages of the
            sourced ROS installation only.
        gestures: named motions through postures, one after the other: positions by joint [rad or
            m], other joints stay.
        own_topics: topics in its namespace that its drivers and simulations publish, besides those
            of the contract and the read `endpoints`; agents may not publish them.
    """

    name: str
    urdf: str = ""
    base_link: str = ""
    tcp_link: str = ""
    arm_joints: tuple[str, ...] = ()
    limits: JointLimits | None = None
    home_rad: F64 | None = None
    gripper: GripperProfile | None = None
    cameras: tuple[CameraProfile, ...] = ()
    workspace: Workspace | None = None
    collision: CollisionProfile | None = None
    endpoints: tuple[Endpoint, ...] = ()
    own_topics: tuple[str, ...] = ()
    mesh_folder: str = ""
    arms: tuple[ArmProfile, ...] = ()
    gestures: Mapping[str, tuple[Mapping[str, float], ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        freeze(self, "home_rad")
        joints = tuple(joint for arm in self.arms for joint in arm.joints)
        if self.arms and joints != self.arm_joints:
            raise InvalidInputError(
                f"Robot {self.name!r}: arm_joints are {self.arm_joints}, its arms have {joints}."
            )

    @property
    def kinds(self) -> JointKinds:
        """Kinds of the joints of its description."""
        return JointKinds.of(self.urdf)

    @property
    def each_arm(self) -> tuple[ArmProfile, ...]:
        """The arms; without `arms`, the one that the profile's own fields describe."""
        return self.arms or (
            ArmProfile(
                name="",
                joints=self.arm_joints,
                base_link=self.base_link,
                tcp_link=self.tcp_link,
                gripper=self.gripper,
            ),
        )

    @property
    def grippers(self) -> tuple[GripperProfile, ...]:
        """The gripper of each arm that has one."""
        return tuple(arm.gripper for arm in self.each_arm if arm.gripper is not None)

    def of_arm(self, arm: ArmProfile) -> RobotProfile:
        """The robot as if `arm` were its only one, with its TCP in the same base frame; itself
        without `arms`.
        """
        if not self.arms:
            return self
        rows = [self.arm_joints.index(joint) for joint in arm.joints]
        limits = self.limits
        if limits is not None:
            arrays = {part.name: getattr(limits, part.name) for part in fields(limits)}
            limits = replace(limits, **{n: a[rows] for n, a in arrays.items() if a is not None})
        return replace(
            self,
            arms=(),
            arm_joints=arm.joints,
            tcp_link=arm.tcp_link,
            gripper=arm.gripper,
            limits=limits,
            home_rad=None if self.home_rad is None else self.home_rad[rows],
        )

    def why_unchecked(
        self, limits: DistanceLimits, *, are_told: bool = True, places: str = ""
    ) -> str:
        """One sentence on why the distances between its links, or places on the way of joint
        commands, are not checked, and one on what to do; empty if they are, or without an arm.

        Args:
            limits: section [limits] of the configuration.
            are_told: the controller tells distances, as far as is known.
            places: why nothing computes that way in front of the driver, and what to do.
        """
        if not self.arm_joints:
            return ""
        if places:
            return (
                f"Places and distances on the way of joint commands to {self.name!r} are not "
                f"checked: {places}"
            )
        names = collision_meshes(self.urdf)
        missing = [name for name in names if mesh_file(name, self.mesh_folder) is None]
        is_asked = (self.collision, limits.min_distance_m, limits.obstacles) != (None, None, None)
        asked = "" if is_asked else ", and set min_distance_m = 0.01 in [limits]"
        if not has_collision_shapes(self.urdf):
            shapes = "boxes, cylinders, spheres or meshes as collision shapes"
            why = "its description has no collision shapes"
            how = f"Add {shapes} to its links{asked}."
        elif not limits.collision:
            why, how = "limits.collision is false", f"Set it to true{asked}."
        elif missing:
            why = f"the mesh {missing[0]!r} has no file"
            how = f"Set mesh_folder of its profile to the folder of the description{asked}."
        elif asked:
            why = "neither its profile nor [limits] asks for it"
            how = "Set min_distance_m = 0.01 in [limits]."
        elif not are_told:
            why, how = "the controller tells none", 'Set controller = "urdf" in [control].'
        else:
            return ""
        return (
            f"Distances between the links of {self.name!r}, and to obstacles, are not checked: "
            f"{why}. {how}"
        )

    def tolerance(self, joint: str) -> float:
        """Distance within which a joint counts as arrived: 0.01 rad or 1 mm, and at most 1/40 of a
        gripper's travel.
        """
        arrived = ARRIVED_M if joint in self.kinds.prismatic else ARRIVED_RAD
        for gripper in self.grippers:
            if joint == gripper.joint:
                return min(arrived, abs(gripper.open_position - gripper.closed_position) / 40.0)
        return arrived

    def camera(self, name: str) -> CameraProfile | None:
        """The camera of that name, or None."""
        return next((c for c in self.cameras if c.name == name), None)

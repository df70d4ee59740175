"""Protocols of moveit_msgs messages, like those of `message_types`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from roboneuron.direct_path.message_types import MessageHeader, PoseMessage, Quaternion, Vector


class Primitive(Protocol):
    """shape_msgs/SolidPrimitive."""

    type: int
    dimensions: Sequence[float]


class BoundingVolume(Protocol):
    """moveit_msgs/BoundingVolume."""

    primitives: Sequence[Primitive]
    primitive_poses: Sequence[PoseMessage]
    meshes: Sequence[object]


class LinkConstraint(Protocol):
    """Common part of PositionConstraint and OrientationConstraint."""

    header: MessageHeader
    link_name: str


class PositionConstraint(LinkConstraint, Protocol):
    """moveit_msgs/PositionConstraint."""

    target_point_offset: Vector
    constraint_region: BoundingVolume


class OrientationConstraint(LinkConstraint, Protocol):
    """moveit_msgs/OrientationConstraint."""

    orientation: Quaternion


class JointConstraint(Protocol):
    """moveit_msgs/JointConstraint."""

    joint_name: str
    position: float
    tolerance_above: float
    tolerance_below: float


class Constraints(Protocol):
    """moveit_msgs/Constraints."""

    joint_constraints: Sequence[JointConstraint]
    position_constraints: Sequence[PositionConstraint]
    orientation_constraints: Sequence[OrientationConstraint]


class PlannedRobotState(Protocol):
    """moveit_msgs/RobotState."""

    is_diff: bool
    attached_collision_objects: Sequence[object]


class PlanRequest(Protocol):
    """moveit_msgs/MotionPlanRequest."""

    start_state: PlannedRobotState
    goal_constraints: Sequence[Constraints]
    path_constraints: Constraints


class CollisionMatrix(Protocol):
    """moveit_msgs/AllowedCollisionMatrix."""

    entry_names: Sequence[str]
    default_entry_names: Sequence[str]


class Octomap(Protocol):
    """octomap_msgs/Octomap."""

    data: Sequence[int]


class OctomapWithPose(Protocol):
    """octomap_msgs/OctomapWithPose."""

    octomap: Octomap


class CollisionObject(Protocol):
    """moveit_msgs/CollisionObject."""

    id: str
    operation: bytes


class PlannedWorld(Protocol):
    """moveit_msgs/PlanningSceneWorld."""

    collision_objects: Sequence[CollisionObject]
    octomap: OctomapWithPose


class PlanningScene(Protocol):
    """moveit_msgs/PlanningScene."""

    is_diff: bool
    robot_state: PlannedRobotState
    allowed_collision_matrix: CollisionMatrix
    link_padding: Sequence[object]
    link_scale: Sequence[object]
    fixed_frame_transforms: Sequence[object]
    world: PlannedWorld


class PlanningOptions(Protocol):
    """moveit_msgs/PlanningOptions."""

    plan_only: bool
    look_around: bool
    planning_scene_diff: PlanningScene

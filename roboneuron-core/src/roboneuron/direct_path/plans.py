"""Goals of a motion planner (MoveIt): their target postures and their options.

A goal contains no path. So its target postures are checked beforehand, and the path by measurements
during the motion. Source of the messages: moveit_msgs 2.6 (Jazzy); of MoveIt's behaviour: its
documentation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from operator import attrgetter

import numpy as np

from roboneuron.contract import Endpoint, JointSample
from roboneuron.contract.arrays import F64
from roboneuron.direct_path.fields import load_type, nested, walk_fields
from roboneuron.direct_path.message_types import MessageName, RosMessage
from roboneuron.direct_path.places import FindTransform, check_rotation, shift, turn
from roboneuron.direct_path.planner_messages import (
    BoundingVolume,
    Constraints,
    JointConstraint,
    LinkConstraint,
    OrientationConstraint,
    PlanningOptions,
    PlanRequest,
    PositionConstraint,
    Primitive,
)
from roboneuron.direct_path.request import AllowedEndpoint
from roboneuron.direct_path.transforms import rotation_of
from roboneuron.errors import ConfigurationError, NotReadyError, RefusedError
from roboneuron.gate.motion import joint_space
from roboneuron.gate.motion.path_limits import Leg, LimitError, check_zones
from roboneuron.gate.motion.path_watch import WayWatch
from roboneuron.gate.motion.rules import MotionRules
from roboneuron.server.verdict import Clamp

REQUEST: MessageName[PlanRequest] = MessageName("moveit_msgs/msg/MotionPlanRequest")
OPTIONS: MessageName[PlanningOptions] = MessageName("moveit_msgs/msg/PlanningOptions")
BODIES: MessageName[RosMessage] = MessageName("trajectory_msgs/msg/MultiDOFJointTrajectory")
MOST_TOLERANCE = 0.1
"""Largest tolerance of a joint [rad or m]; with a larger one the target posture is undetermined."""


_SPHERE, _BOX, _CYLINDER, _CONE = 2, 1, 3, 4
"""shape_msgs/SolidPrimitive."""


_CONSTRAINTS: tuple[MessageName[PositionConstraint | OrientationConstraint], ...] = (
    MessageName("moveit_msgs/msg/PositionConstraint"),
    MessageName("moveit_msgs/msg/OrientationConstraint"),
)


def has_plans(ros_type: type[RosMessage]) -> bool:
    """True if messages of a class can contain requests to a planner, or motions of bodies."""
    types = {name.replace("/", "/msg/") for _, name in walk_fields(ros_type)}
    return not types.isdisjoint((REQUEST, OPTIONS, BODIES))


def plans_in(message: RosMessage) -> list[tuple[str, PlanRequest]]:
    """Requests to a planner in a message, goal or service request, each with the path of its
    fields.
    """
    return list(nested(message, (REQUEST,)))


def is_plan_only(message: RosMessage) -> bool:
    """True if a goal is only to be planned: nothing moves."""
    return any(options.plan_only for _, options in nested(message, (OPTIONS,)))


def check_plan_only(message: RosMessage) -> None:
    """Raise RefusedError for a goal to be executed, if its endpoint moves nothing."""
    for path, options in nested(message, (OPTIONS,)):
        if not options.plan_only:
            raise RefusedError(
                f"{path}plan_only is false, but the endpoint is said to move nothing.",
                hint="Set it, or leave moves = false out of the configuration.",
            )


def check_plan_frame(endpoint: Endpoint, base_link: str) -> None:
    """Raise ConfigurationError if an endpoint with planned goals has its zones in another frame
    than the limits of the arm.
    """
    if not endpoint.frame or endpoint.frame == base_link or endpoint.kind != "action":
        return
    if has_plans(load_type(endpoint.type).Goal):
        raise ConfigurationError(
            f"Endpoint {endpoint.name!r} has frame = {endpoint.frame!r}, the limits of the arm are "
            f"in {base_link!r}.",
            hint=f'Give the zones in it, and frame = "{base_link}".',
        )


def watch_of(
    allowed: AllowedEndpoint,
    messages: Sequence[RosMessage],
    joints: Callable[[], JointSample | None],
) -> WayWatch | None:
    """Create the watch over a planner's motion; None if no arm is moved.

    Args:
        allowed: the endpoint, with the limits of its arm.
        messages: the allowed messages.
        joints: returns the newest measured joints.
    """
    is_moving = any(plans_in(message) and not is_plan_only(message) for message in messages)
    if allowed.path is None or allowed.profile is None or not is_moving:
        return None
    return WayWatch(allowed.path(), allowed.endpoint.zones, joints, allowed.profile.kinds)


class PlanJudge:
    """Checks requests to a planner for one arm.

    Args:
        allowed: the endpoint, with the limits of its arm.
        joints: measured state of the arm.
    """

    def __init__(self, allowed: AllowedEndpoint, joints: JointSample | None) -> None:
        profile = allowed.profile
        if profile is None:
            raise RefusedError(
                f"{allowed.robot!r} has no profile, so that goals of a planner cannot be checked."
            )
        self._allowed, self._joints, self._profile = allowed, joints, profile
        self._rules = allowed.rules or MotionRules(reactions={})
        self._limits = joint_space.JointLimit.by_joint(profile, allowed.rules)
        self._tips = {arm.tcp_link for arm in profile.each_arm}

    def check(self, request: PlanRequest, where: str = "") -> None:
        """Raise RefusedError (LimitError for limits) for the first part that is not allowed or
        cannot be evaluated.

        Args:
            request: MotionPlanRequest.
            where: path of its fields.
        """
        for name, most, key in (
            ("velocity", self._rules.velocity_fraction, "velocity_fraction"),
            ("acceleration", self._rules.acceleration_fraction, "acceleration_fraction"),
        ):
            self._check_scaling(request, where, name, most, key)
        for name in ("trajectory_constraints.constraints", "reference_trajectories"):
            if attrgetter(name)(request):
                raise RefusedError(f"{where}{name} cannot be checked.", hint="Leave it empty.")
        self._check_names(request.path_constraints, f"{where}path_constraints.")
        if not request.goal_constraints:
            raise RefusedError(f"{where}goal_constraints is empty: there is no goal.")
        for index, goal in enumerate(request.goal_constraints):
            self._check_goal(goal, f"{where}goal_constraints[{index}].")

    def _check_scaling(
        self, request: PlanRequest, where: str, name: str, most: float, key: str
    ) -> None:
        path = f"max_{name}_scaling_factor"
        value = getattr(request, path)
        if not 0.0 < value <= most * (1.0 + joint_space.JointLimit.SLACK):
            raise LimitError(
                name,
                f"{where}{path} is {value:g}, allowed is more than 0 and at most {most:g} "
                f"({key} of [limits]).",
                hint="Without it MoveIt would take 1." if value == 0.0 else "",
            )

    def _check_goal(self, goal: Constraints, where: str) -> None:
        """Check one of the alternative goals of the planner."""
        self._check_names(goal, where)
        names = [constraint.joint_name for constraint in goal.joint_constraints]
        if len(set(names)) != len(names):
            raise RefusedError(f"{where}joint_constraints names a joint twice.")
        for index, constraint in enumerate(goal.joint_constraints):
            self._check_joint(constraint, f"{where}joint_constraints[{index}]")
        for index, place in enumerate(goal.position_constraints):
            self._check_position(place, f"{where}position_constraints[{index}]")
        if not (names or goal.position_constraints):
            raise RefusedError(
                f"{where.rstrip('.')} leaves open where the arm is to stand.",
                hint="Give position_constraints of the TCP, or joint_constraints of every joint.",
            )
        for arm in self._profile.each_arm:
            left = [joint for joint in arm.joints if joint not in names]
            if len(left) == len(arm.joints):
                continue  # joints of another arm, or of a gripper
            if not left:
                self._check_posture(goal.joint_constraints, where)
            elif not goal.position_constraints:
                raise RefusedError(
                    f"{where}joint_constraints leaves open where {', '.join(left)} is to be.",
                    hint="Name every joint of the arm.",
                )

    def _check_posture(self, constraints: Sequence[JointConstraint], where: str) -> None:
        if self._allowed.path is None:
            return
        leg = Leg(
            names=tuple(constraint.joint_name for constraint in constraints),
            position=np.array([constraint.position for constraint in constraints]),
            duration_s=None,
            where=f"{where.rstrip('.')}: ",
        )
        there = self._allowed.path().check_stand(leg, self._measured())
        for posture in there.arms:
            place = posture.pose.position_m
            check_zones(place, place, self._allowed.endpoint.zones, leg.where)

    def _check_joint(self, constraint: JointConstraint, where: str) -> None:
        limit = self._limits[constraint.joint_name]
        for side in ("above", "below"):
            tolerance = getattr(constraint, f"tolerance_{side}")
            if not 0.0 <= tolerance <= MOST_TOLERANCE:
                raise RefusedError(
                    f"{where}.tolerance_{side} is {tolerance:g}, allowed is 0 .. "
                    f"{MOST_TOLERANCE:g}."
                )
        for value in (
            constraint.position - constraint.tolerance_below,
            constraint.position + constraint.tolerance_above,
        ):
            if not limit.allows("position", value):
                raise LimitError(
                    "position",
                    f"{where}: {constraint.joint_name} may come to {value:.4g}, allowed is "
                    f"{limit.lower:.4g} .. {limit.upper:.4g}.",
                )

    def _check_position(self, constraint: PositionConstraint, where: str) -> None:
        if self._allowed.rules is None:
            raise RefusedError(f"{where}: the robot has no TCP, so no place can be checked.")
        rules, offset = self._rules, constraint.target_point_offset
        spread_m = math.hypot(offset.x, offset.y, offset.z)
        boxes = list(boxes_of(constraint.constraint_region, where))
        if not boxes:
            raise RefusedError(f"{where}.constraint_region is empty: there is no place.")
        for low, high in boxes:
            lower_m, upper_m = low - spread_m, high + spread_m
            box = f"{np.round(lower_m, 4).tolist()} .. {np.round(upper_m, 4).tolist()} m"
            if (lower_m < rules.lower_m).any() or (upper_m > rules.upper_m).any():
                raise LimitError("workspace", f"{where}: {box} is not all within the workspace.")
            if lower_m[2] < rules.min_height_m:
                raise LimitError(
                    "height",
                    f"{where}: {box} is not all above the height of {rules.min_height_m:g} m.",
                )
            zones = (*rules.zones, *self._allowed.endpoint.zones)
            check_zones(lower_m, upper_m, zones, f"{where}: ")

    def _check_names(self, constraints: Constraints, where: str) -> None:
        """Check that limits are known for the joints, links and frames."""
        for index, joint in enumerate(constraints.joint_constraints):
            if joint.joint_name not in self._limits:
                raise RefusedError(
                    f"{where}joint_constraints[{index}]: joint {joint.joint_name[:60]!r} is "
                    f"unknown, the robot has {', '.join(self._limits)}."
                )
        for name in ("position_constraints", "orientation_constraints"):
            for index, part in enumerate(getattr(constraints, name)):
                self._check_link(part, f"{where}{name}[{index}]")
        for index, goal in enumerate(constraints.orientation_constraints):
            check_rotation(f"{where}orientation_constraints[{index}].orientation", goal.orientation)

    def _check_link(self, part: LinkConstraint, where: str) -> None:
        if part.link_name not in self._tips:
            raise RefusedError(
                f"{where}.link_name is {part.link_name[:60]!r}; limits are known of "
                f"{', '.join(sorted(self._tips))}."
            )
        if part.header.frame_id != self._profile.base_link:
            raise LimitError(
                "frame",
                f"{where}.header.frame_id is {part.header.frame_id[:60]!r}, expected "
                f"{self._profile.base_link!r}, in which the limits of the arm are.",
            )

    def _measured(self) -> JointSample:
        if self._joints is None:
            raise RefusedError(
                "The joints were not measured yet, so the goal cannot be checked.",
                hint="Start the robot first.",
            )
        return self._joints


def boxes_of(region: BoundingVolume, where: str) -> Iterator[tuple[F64, F64]]:
    """Yield the corners of axis-aligned boxes that contain the shapes of a BoundingVolume."""
    if region.meshes:
        raise RefusedError(
            f"{where}.constraint_region.meshes cannot be checked.", hint="Give primitives."
        )
    if len(region.primitives) != len(region.primitive_poses):
        raise RefusedError(
            f"{where}.constraint_region has {len(region.primitives)} primitives and "
            f"{len(region.primitive_poses)} primitive_poses."
        )
    for index, (shape, pose) in enumerate(
        zip(region.primitives, region.primitive_poses, strict=True)
    ):
        path = f"{where}.constraint_region.primitive_poses[{index}]"
        check_rotation(f"{path}.orientation", pose.orientation)
        half_m = np.abs(rotation_of(pose.orientation)) @ _half_m(
            shape, f"{where}.constraint_region"
        )
        centre_m = np.array([pose.position.x, pose.position.y, pose.position.z])
        yield centre_m - half_m, centre_m + half_m


def _half_m(shape: Primitive, where: str) -> F64:
    """Half of the edges of a box that contains a shape, along its own axes."""
    counts: Mapping[int, int] = {_BOX: 3, _SPHERE: 1, _CYLINDER: 2, _CONE: 2}
    sizes = [float(size) for size in shape.dimensions]
    if len(sizes) != counts.get(shape.type, -1) or min(sizes) < 0.0:
        raise RefusedError(
            f"{where}: dimensions {sizes} are not those of a primitive of type {shape.type}."
        )
    if shape.type == _BOX:
        return np.array(sizes) / 2.0
    if shape.type == _SPHERE:
        return np.full(3, sizes[0])
    height, radius = sizes
    return np.array([radius, radius, height / 2.0])


def constraints_to_frame(message: RosMessage, base_link: str, find: FindTransform) -> list[Clamp]:
    """Convert the constraints of position and orientation in a message to the frame of the arm's
    base with the present transforms, so that the checked message is the sent one.

    Returns:
        The changed coordinates [m].

    Raises:
        LimitError: of the limit "frame": a transform is unknown, old, or invalid.
    """
    changes: list[Clamp] = []
    for path, part in nested(message, _CONSTRAINTS):
        source = part.header.frame_id
        if not source or source == base_link:
            continue
        try:
            found = find(base_link, source)
        except NotReadyError as error:
            raise LimitError("frame", f"{path}header.frame_id: {error.message}") from error
        if hasattr(part, "orientation"):
            turn(part.orientation, found, f"{path}orientation")
        else:
            for index, pose in enumerate(part.constraint_region.primitive_poses):
                where = f"{path}constraint_region.primitive_poses[{index}]"
                turn(pose.orientation, found, f"{where}.orientation")
                changes += shift(pose.position, found, f"{where}.position")
        part.header.frame_id = base_link
    return changes

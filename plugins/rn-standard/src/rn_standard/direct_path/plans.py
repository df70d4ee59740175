"""Goals of a motion planner (MoveIt): where they lead to, and what they ask of it.

A goal names no way, so it is judged by where the arm may stand, and the way by what is measured
while the arm is on it. Source of the messages: moveit_msgs 2.6 (Jazzy); of what MoveIt does with
them: its documentation.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from rn_standard.direct_path.fields import load_type, nested, walk_fields
from rn_standard.direct_path.path_limits import Leg, LimitError, PathLimiter
from rn_standard.direct_path.places import check_rotation
from rn_standard.direct_path.request import AllowedEndpoint
from roboneuron import F64, ConfigurationError, Endpoint, JointSample, Obstacle, RefusedError
from roboneuron.feature import MotionRules, joint_space

REQUEST, OPTIONS = "moveit_msgs/msg/MotionPlanRequest", "moveit_msgs/msg/PlanningOptions"
_BODIES = "trajectory_msgs/msg/MultiDOFJointTrajectory"
MOST_TOLERANCE = 0.1
"""Of a joint [rad or m]: a goal with more leaves open where the arm is to stand."""
_ADD = b"\x00"
"""CollisionObject.ADD."""
_PERIOD_S = 0.05
"""How often the way is looked at."""
_SILENCE_S = 1.0
"""Without a measurement for so long a way that somebody else has planned ends."""
_TREMBLE = 1e-3
"""Change of a joint [rad or m] that is no motion; an arm that rests in a zone has not come into it.
"""
_SPHERE, _BOX, _CYLINDER, _CONE = 2, 1, 3, 4
"""shape_msgs/SolidPrimitive."""


def has_plans(ros_type: Any) -> bool:
    """Whether messages of a class can hold what a planner is asked for, or motions of bodies."""
    types = {name.replace("/", "/msg/") for _, name in walk_fields(ros_type)}
    return not types.isdisjoint((REQUEST, OPTIONS, _BODIES))


def plans_in(message: Any) -> list[tuple[str, Any]]:
    """The requests to a planner that a message, goal or service request holds, each with the path
    to its fields.
    """
    return list(nested(message, (REQUEST,)))


def is_plan_only(message: Any) -> bool:
    """Whether a goal is only to be planned: nothing moves."""
    return any(options.plan_only for _, options in nested(message, (OPTIONS,)))


def check_plan_frame(endpoint: Endpoint, base_link: str) -> None:
    """Raise ConfigurationError when an endpoint whose goals are planned has its zones in another
    frame than the limits of the arm.
    """
    if not endpoint.frame or endpoint.frame == base_link or endpoint.kind != "action":
        return
    if has_plans(load_type(endpoint.type).Goal):
        raise ConfigurationError(
            f"Endpoint {endpoint.name!r} has frame = {endpoint.frame!r}, the limits of the arm are "
            f"in {base_link!r}.",
            hint=f'Give the zones in it, and frame = "{base_link}".',
        )


def check_bodies(message: Any) -> None:
    """Raise RefusedError for a trajectory of poses of whole bodies: nothing here can judge it."""
    for path, found in nested(message, (_BODIES, REQUEST, OPTIONS)):
        if hasattr(found, "points") and (found.points or found.joint_names):
            raise RefusedError(
                f"{path.rstrip('.') or 'The trajectory'} moves joints of several degrees of "
                "freedom, which no limit is known for.",
                hint="Send joint_trajectory alone.",
            )


def check_options(message: Any) -> None:
    """Raise RefusedError for what would have a planner know less of the world than it does.

    Obstacles may be added. Whatever else a planning scene says could take away one, allow a
    collision, or let go of what the hand holds.
    """
    missing = []
    for path, request in nested(message, (REQUEST,)):
        _check_nothing_attached(request.start_state, f"{path}start_state")
        if not request.start_state.is_diff:
            missing.append(f"{path}start_state")
    for path, options in nested(message, (OPTIONS,)):
        scene, where = options.planning_scene_diff, f"{path}planning_scene_diff"
        if options.look_around:
            raise RefusedError(
                f"{path}look_around moves sensors by a way that cannot be checked.",
                hint="Leave it false.",
            )
        _check_scene(scene, where)
        _check_nothing_attached(scene.robot_state, f"{where}.robot_state")
        missing += [
            name
            for name, part in ((where, scene), (f"{where}.robot_state", scene.robot_state))
            if not part.is_diff
        ]
    if missing:
        raise RefusedError(
            f"{' and '.join(missing)} would replace what the planner knows of the robot and of "
            "what it holds.",
            hint="Set is_diff = true in each.",
        )


def _check_scene(scene: Any, where: str) -> None:
    matrix = scene.allowed_collision_matrix
    changes = {
        "allowed_collision_matrix": matrix.entry_names or matrix.default_entry_names,
        "link_padding": scene.link_padding,
        "link_scale": scene.link_scale,
        "fixed_frame_transforms": scene.fixed_frame_transforms,
        "world.octomap": scene.world.octomap.octomap.data,
    }
    for name, value in changes.items():
        if len(value):
            raise RefusedError(
                f"{where}.{name} can hide collisions from the planner, which is not allowed.",
                hint="Only obstacles may be added, by world.collision_objects.",
            )
    for index, thing in enumerate(scene.world.collision_objects):
        if thing.operation != _ADD:
            raise RefusedError(
                f"{where}.world.collision_objects[{index}] removes or changes {thing.id[:60]!r}, "
                "expected operation ADD.",
            )


def _check_nothing_attached(state: Any, where: str) -> None:
    if state.attached_collision_objects:
        raise RefusedError(
            f"{where}.attached_collision_objects changes what the robot is known to hold, which is "
            "not allowed.",
            hint="Leave it empty.",
        )


class PlanJudge:
    """Judges requests to a planner for one arm.

    Args:
        allowed: the endpoint, with the limits of its arm.
        joints: where the arm is measured.
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

    def check(self, request: Any, where: str = "") -> None:
        """Raise RefusedError, of which LimitError is one, for the first thing that is not allowed,
        or cannot be told.

        Args:
            request: MotionPlanRequest.
            where: path to its fields.
        """
        for name, most, key in (
            ("velocity", self._rules.velocity_fraction, "velocity_fraction"),
            ("acceleration", self._rules.acceleration_fraction, "acceleration_fraction"),
        ):
            self._check_scaling(request, where, name, most, key)
        for name in ("trajectory_constraints.constraints", "reference_trajectories"):
            if _at(request, name):
                raise RefusedError(f"{where}{name} cannot be checked.", hint="Leave it empty.")
        self._check_names(request.path_constraints, f"{where}path_constraints.")
        if not request.goal_constraints:
            raise RefusedError(f"{where}goal_constraints is empty: there is no goal.")
        for index, goal in enumerate(request.goal_constraints):
            self._check_goal(goal, f"{where}goal_constraints[{index}].")

    def _check_scaling(self, request: Any, where: str, name: str, most: float, key: str) -> None:
        path = f"max_{name}_scaling_factor"
        value = getattr(request, path)
        if not 0.0 < value <= most * (1.0 + joint_space.JointLimit.SLACK):
            raise LimitError(
                name,
                f"{where}{path} is {value:g}, allowed is more than 0 and at most {most:g} "
                f"({key} of [limits]).",
                hint="Without it MoveIt would take 1." if value == 0.0 else "",
            )

    def _check_goal(self, goal: Any, where: str) -> None:
        """One of the places that the planner may choose among."""
        self._check_names(goal, where)
        names = [constraint.joint_name for constraint in goal.joint_constraints]
        if len(set(names)) != len(names):
            raise RefusedError(f"{where}joint_constraints names a joint twice.")
        for index, constraint in enumerate(goal.joint_constraints):
            self._check_joint(constraint, f"{where}joint_constraints[{index}]")
        for index, constraint in enumerate(goal.position_constraints):
            self._check_position(constraint, f"{where}position_constraints[{index}]")
        if goal.position_constraints:
            return
        if not names:
            raise RefusedError(
                f"{where.rstrip('.')} leaves open where the arm is to stand.",
                hint="Give position_constraints of the TCP, or joint_constraints of every joint.",
            )
        self._check_posture(goal.joint_constraints, names, where)

    def _check_posture(self, constraints: Sequence[Any], names: Sequence[str], where: str) -> None:
        moved = [arm for arm in self._profile.each_arm if not set(names).isdisjoint(arm.joints)]
        for arm in moved:
            open_joints = [joint for joint in arm.joints if joint not in names]
            if open_joints:
                raise RefusedError(
                    f"{where}joint_constraints leaves open where {', '.join(open_joints)} is to "
                    "be.",
                    hint="Name every joint of the arm.",
                )
        if not moved or self._allowed.path is None:
            return
        leg = Leg(
            names=tuple(names),
            position=np.array([constraint.position for constraint in constraints]),
            duration_s=None,
            where=f"{where.rstrip('.')}: ",
        )
        there = self._allowed.path().check_stand(leg, self._measured())
        for posture in there.arms:
            place = posture.pose.position_m
            _check_zones(place, place, self._allowed.endpoint.zones, leg.where)

    def _check_joint(self, constraint: Any, where: str) -> None:
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

    def _check_position(self, constraint: Any, where: str) -> None:
        if self._allowed.rules is None:
            raise RefusedError(f"{where}: the robot has no TCP, so no place can be checked.")
        rules, offset = self._rules, constraint.target_point_offset
        spread_m = math.hypot(offset.x, offset.y, offset.z)
        boxes = list(_boxes(constraint.constraint_region, where))
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
            _check_zones(lower_m, upper_m, zones, f"{where}: ")

    def _check_names(self, constraints: Any, where: str) -> None:
        """Joints, links and frames are those that limits are known of."""
        for index, joint in enumerate(constraints.joint_constraints):
            if joint.joint_name not in self._limits:
                raise RefusedError(
                    f"{where}joint_constraints[{index}]: joint {joint.joint_name[:60]!r} is "
                    f"unknown, the robot has {', '.join(self._limits)}."
                )
        for name in ("position_constraints", "orientation_constraints"):
            for index, part in enumerate(getattr(constraints, name)):
                self._check_link(part, f"{where}{name}[{index}]")
        for index, turn in enumerate(constraints.orientation_constraints):
            check_rotation(f"{where}orientation_constraints[{index}].orientation", turn.orientation)

    def _check_link(self, part: Any, where: str) -> None:
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


class WayWatch:
    """Watches an arm on a way that somebody else has planned, by its measured joints.

    Args:
        limiter: judges the way from one measurement to the next.
        zones: boxes beside its own that no TCP may come into.
        joints: the newest measured joints; None when there are no recent ones.
        now_s: monotonic time [s].
    """

    def __init__(
        self,
        limiter: PathLimiter,
        zones: Sequence[Obstacle],
        joints: Callable[[], JointSample | None],
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._limiter, self._zones, self._joints, self._now_s = limiter, zones, joints, now_s
        self._last: JointSample | None = None
        self._due_s = 0.0
        self._seen_s = now_s()

    def check(self) -> None:
        """Raise RefusedError once the arm is where it may not be, or is not measured any more."""
        now_s = self._now_s()
        if now_s < self._due_s:
            return
        self._due_s = now_s + _PERIOD_S
        joints = self._joints()
        if joints is None:
            if now_s - self._seen_s > _SILENCE_S:
                raise RefusedError("The joints are not measured any more.")
            return
        self._seen_s = now_s
        before = self._last
        if before is None:
            self._last = joints
        elif before.names != joints.names or _has_moved(before.position, joints.position):
            self._last = joints
            self._judge(before, joints)

    def _judge(self, before: JointSample, joints: JointSample) -> None:
        finite = np.isfinite(joints.position)
        names = tuple(name for name, is_known in zip(joints.names, finite, strict=True) if is_known)
        leg = Leg(names=names, position=joints.position[finite], duration_s=None)
        try:
            self._limiter.check([leg], before)
            if not self._zones:
                return
            tips = (self._limiter.posture(before).arms, self._limiter.posture(joints).arms)
            for start, end in zip(*tips, strict=True):
                left = [zone for zone in self._zones if _is_in(zone, start.pose.position_m)]
                place, others = end.pose.position_m, [z for z in self._zones if z not in left]
                _check_zones(place, place, others, "")
        except LimitError as error:
            raise RefusedError(f"The arm has left its limits. {error.message}") from error


def _has_moved(before: F64, now: F64) -> bool:
    """Whether joints have moved more than measurements tremble."""
    return bool((np.abs(now - before) > _TREMBLE).any())


def _is_in(zone: Obstacle, place_m: F64) -> bool:
    return bool((zone.lower_m <= place_m).all() and (place_m <= zone.upper_m).all())


def _check_zones(lower_m: F64, upper_m: F64, zones: Sequence[Obstacle], where: str) -> None:
    for zone in zones:
        if (lower_m <= zone.upper_m).all() and (upper_m >= zone.lower_m).all():
            raise LimitError("zone", f"{where}The TCP may come into the zone {zone.name!r}.")


def _at(message: Any, path: str) -> Any:
    for name in path.split("."):
        message = getattr(message, name)
    return message


def _boxes(region: Any, where: str) -> Iterator[tuple[F64, F64]]:
    """The corners of boxes along the axes that hold the shapes of a BoundingVolume."""
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
        half_m = np.abs(_rotation(pose.orientation)) @ _half_m(shape, f"{where}.constraint_region")
        centre_m = np.array([pose.position.x, pose.position.y, pose.position.z])
        yield centre_m - half_m, centre_m + half_m


def _half_m(shape: Any, where: str) -> F64:
    """Half of the edges of a box that holds a shape, along its own axes."""
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


def _rotation(q: Any) -> F64:
    """The rotation matrix, float64 (3, 3), of a quaternion of about the length 1."""
    x, y, z, w = np.array([q.x, q.y, q.z, q.w]) / math.hypot(q.x, q.y, q.z, q.w)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )

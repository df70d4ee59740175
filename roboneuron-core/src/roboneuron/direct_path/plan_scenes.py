"""Restrictions on requests and world updates for a motion planner (MoveIt): nothing may hide a part
of its world.
"""

from __future__ import annotations

from collections.abc import Sequence, Sized

from roboneuron.contract import JointSample
from roboneuron.direct_path.fields import nested
from roboneuron.direct_path.message_types import RosMessage
from roboneuron.direct_path.planner_messages import PlannedRobotState, PlanningScene
from roboneuron.direct_path.plans import BODIES, OPTIONS, REQUEST, PlanJudge, plans_in
from roboneuron.direct_path.request import AllowedEndpoint
from roboneuron.errors import RefusedError

_ADD = b"\x00"
"""CollisionObject.ADD."""


def check_plans(
    allowed: AllowedEndpoint, messages: Sequence[RosMessage], joints: JointSample | None
) -> bool:
    """Return True if a planner is asked for a path; raises RefusedError for a forbidden request.

    Args:
        allowed: the endpoint, with the limits of its arm.
        messages: messages to be sent.
        joints: measured state of the arm.
    """
    plans = [found for message in messages for found in plans_in(message)]
    for message in messages:
        check_bodies(message)
        check_options(message)
    if not plans:
        return False
    judge = PlanJudge(allowed, joints)
    for path, plan in plans:
        judge.check(plan, path)
    return True


def check_bodies(message: RosMessage) -> None:
    """Raise RefusedError for a trajectory of poses of whole bodies, which cannot be checked
    here.
    """
    for path, found in nested(message, (BODIES, REQUEST, OPTIONS)):
        if getattr(found, "points", ()) or getattr(found, "joint_names", ()):
            raise RefusedError(
                f"{path.rstrip('.') or 'The trajectory'} moves joints of several degrees of "
                "freedom, which no limit is known for.",
                hint="Send joint_trajectory alone.",
            )


def check_options(message: RosMessage) -> None:
    """Raise RefusedError for options that would reduce the planner's knowledge of the world.

    Obstacles may be added. Other content of a planning scene could remove an obstacle, allow a
    collision, or detach a held object.
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


def _check_scene(scene: PlanningScene, where: str) -> None:
    matrix = scene.allowed_collision_matrix
    changes: dict[str, Sized] = {
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


def _check_nothing_attached(state: PlannedRobotState, where: str) -> None:
    if state.attached_collision_objects:
        raise RefusedError(
            f"{where}.attached_collision_objects changes what the robot is known to hold, which is "
            "not allowed.",
            hint="Leave it empty.",
        )

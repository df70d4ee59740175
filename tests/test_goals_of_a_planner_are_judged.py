"""Goals that an agent may send to a motion planner: MoveIt goals against the limits of an FR3."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from planner_goals import (
    BASE,
    EXECUTE,
    HOME,
    LIMITS,
    MOVE,
    endpoint,
    goal_of,
    joint_goal,
    limiter_of_fr3,
    place_goal,
    trajectory,
)

from rn_robot_fr3.limits import ARM_JOINTS
from rn_robot_fr3.profile import HOME_RAD, profile
from roboneuron import (
    ConfigurationError,
    JointSample,
    NotReadyError,
    Obstacle,
    RefusedError,
)
from roboneuron.config import LimitsConfig
from roboneuron.direct_path.fields import filled, load_type
from roboneuron.direct_path.gate import Gate
from roboneuron.direct_path.joint_messages import joint_commands
from roboneuron.direct_path.places import FindTransform
from roboneuron.direct_path.plans import check_plan_frame, watch_of
from roboneuron.direct_path.request import AllowedEndpoint
from roboneuron.direct_path.transforms import Transform
from roboneuron.feature import GateRequest, motion_rules
from roboneuron.gate.motion.path_limits import PathLimiter

pytest_plugins = ["rn_testing.gate_fixtures"]
pytestmark = pytest.mark.usefixtures("learnt_types")
Case = tuple[Callable[[dict[str, Any]], object], str]


@pytest.fixture(scope="module")
def limiter() -> PathLimiter:
    return limiter_of_fr3()


@pytest.fixture
def ask(latch: Any, audit: Any, clock: Any, limiter: PathLimiter) -> Callable[..., None]:
    """Let a gate check a goal; raises RefusedError."""
    facts = profile()

    def make(
        values: dict[str, Any],
        type_name: str = MOVE,
        joints: JointSample | None = HOME,
        transforms: FindTransform | None = None,
        **changes: Any,
    ) -> Any:
        entry = AllowedEndpoint(
            robot="fr3", endpoint=endpoint(type_name, **changes), profile=facts,
            rules=motion_rules(LimitsConfig.model_validate(LIMITS), facts), path=lambda: limiter,
        )  # fmt: skip
        gate = Gate([entry], latch=latch, audit=audit, clock=clock.monotonic, transforms=transforms)
        goal = filled(load_type(type_name).Goal, values)
        request = GateRequest(
            who="agent", role="operator", tool="send_arm_goal", robot="fr3", endpoint="arm",
            messages=(goal,), arguments={}, joints=joints,
        )  # fmt: skip
        assert gate.check(request).may_send
        return goal.request if type_name == MOVE else None

    return make


def test_goals_of_joints_and_of_the_tcp_pass(ask: Callable[..., None]) -> None:
    ask(goal_of(joint_goal(fr3_joint7=0.5)))
    ask(goal_of(place_goal(0.4, 0.0, 0.3)))
    ask(goal_of(joint_goal(), place_goal(0.4, 0.0, 0.3)))
    obstacle = {"id": "box", "primitives": [{"type": 1, "dimensions": [0.1, 0.1, 0.1]}]}
    more = goal_of(joint_goal())
    more["planning_options"]["planning_scene_diff"]["world"] = {"collision_objects": [obstacle]}
    ask(more)


def test_where_the_planner_begins_is_no_command(ask: Callable[..., None]) -> None:
    started = goal_of(joint_goal())
    started["request"]["start_state"]["joint_state"] = {"name": ["fr3_joint1"], "position": [9.0]}
    goal = filled(load_type(MOVE).Goal, started)
    assert list(joint_commands(goal)) == []
    ask(started)


def request(**values: Any) -> Callable[[dict[str, Any]], object]:
    return lambda goal: goal["request"].update(values)


def scene(**values: Any) -> Callable[[dict[str, Any]], object]:
    return lambda goal: goal["planning_options"]["planning_scene_diff"].update(values)


def goals(*made: dict[str, Any]) -> Callable[[dict[str, Any]], object]:
    return request(goal_constraints=list(made))


def changed(constraints: dict[str, Any], kind: str, **values: Any) -> dict[str, Any]:
    made = copy.deepcopy(constraints)
    made[kind][0].update(values)
    return made


POSITION, TURN, JOINT = "position_constraints", "orientation_constraints", "joint_constraints"
PLACE = place_goal(0.4, 0.0, 0.3)
CASES: list[Case] = [
    (request(max_velocity_scaling_factor=0.0), r"max_velocity_scaling_factor is 0, .* at most 0.5"),
    (request(max_velocity_scaling_factor=0.6), "is 0.6, allowed is more than 0 and at most 0.5"),
    (request(max_acceleration_scaling_factor=0.41), "at most 0.4 .acceleration_fraction"),
    (request(max_acceleration_scaling_factor=-1.0), "max_acceleration_scaling_factor is -1"),
    (goals(), "there is no goal"),
    (goals(joint_goal(fr3_joint4=0.0)), r"fr3_joint4 may come to .*, allowed is -3.042 .. -0.1518"),
    (goals(joint_goal(fr3_joint4=-0.1520)), "fr3_joint4 may come to -0.151"),
    (goals(joint_goal(), joint_goal(fr3_joint4=0.0)), r"goal_constraints\[1\].joint_constraints"),
    (goals(joint_goal(elbow=0.0)), "joint 'elbow' is unknown"),
    (goals({JOINT: joint_goal()[JOINT][:5]}), "leaves open where fr3_joint6, fr3_joint7"),
    (goals({JOINT: joint_goal()[JOINT] * 2}), "names a joint twice"),
    (goals(changed(joint_goal(), JOINT, tolerance_above=0.2)), "tolerance_above is 0.2, allowed"),
    (goals(changed(joint_goal(), JOINT, tolerance_below=-0.1)), "tolerance_below is -0.1"),
    (goals(joint_goal(fr3_joint2=0.9)), "outside the workspace|would be .* apart"),
    (goals({TURN: PLACE[TURN]}), "leaves open where the arm is to stand"),
    (goals(place_goal(0.9, 0.0, 0.3)), "is not all within the workspace"),
    (goals(place_goal(0.4, 0.0, 0.3, radius_m=0.5)), "is not all within the workspace"),
    (goals(place_goal(0.5, 0.2, 0.2)), "may come into the zone 'cup'"),
    (goals(place_goal(0.5, 0.2, 0.32, radius_m=0.05)), "may come into the zone 'cup'"),
    (
        goals(changed(PLACE, POSITION, link_name="camera")),
        "link_name is 'camera'; limits are known",
    ),
    (goals(changed(PLACE, POSITION, header={"frame_id": "map"})), "is 'map', expected 'fr3_link0'"),
    (goals(changed(PLACE, TURN, header={"frame_id": ""})), "is '', expected 'fr3_link0'"),
    (goals(changed(PLACE, TURN, orientation={"w": 0.5})), "has the length 0.5, expected 1"),
    (goals(changed(PLACE, POSITION, constraint_region={})), "constraint_region is empty"),
    (
        goals(changed(PLACE, POSITION, constraint_region={"meshes": [{}], "mesh_poses": [{}]})),
        "meshes cannot be checked",
    ),
    (
        goals(changed(PLACE, POSITION, constraint_region={"primitives": [{"type": 2}]})),
        "has 1 primitives and 0 primitive_poses",
    ),
    (
        goals(
            changed(
                PLACE,
                POSITION,
                constraint_region={"primitives": [{"type": 9}], "primitive_poses": [{}]},
            )
        ),
        "not those of a primitive of type 9",
    ),
    (
        goals(changed(PLACE, POSITION, target_point_offset={"z": 0.3})),
        "is not all within the workspace",
    ),
    (
        request(path_constraints={TURN: [{**PLACE[TURN][0], "link_name": "elbow"}]}),
        "path_constraints.orientation_constraints.0..link_name is 'elbow'",
    ),
    (request(trajectory_constraints={"constraints": [{}]}), "trajectory_constraints.* cannot be"),
    (request(reference_trajectories=[{}]), "reference_trajectories cannot be checked"),
    (request(start_state={}), "request.start_state would replace what the planner knows"),
    (
        request(start_state={"is_diff": True, "attached_collision_objects": [{}]}),
        "changes what the robot is known to hold",
    ),
    (scene(is_diff=False), "planning_scene_diff would replace"),
    (scene(robot_state={}), "planning_scene_diff.robot_state would replace"),
    (scene(link_padding=[{"padding": -1.0}]), "link_padding can hide collisions"),
    (scene(link_scale=[{"scale": 0.1}]), "link_scale can hide collisions"),
    (
        scene(allowed_collision_matrix={"default_entry_names": ["table"]}),
        "allowed_collision_matrix can hide collisions",
    ),
    (scene(fixed_frame_transforms=[{}]), "fixed_frame_transforms can hide collisions"),
    (
        scene(world={"octomap": {"octomap": {"data": [0]}}}),
        "octomap can hide collisions",
    ),
    (
        scene(world={"collision_objects": [{"id": "table", "operation": 1}]}),
        "removes or changes 'table', expected operation ADD",
    ),
    (lambda goal: goal["planning_options"].update(look_around=True), "look_around moves sensors"),
]


@pytest.mark.parametrize(("change", "told"), CASES, ids=[told for _, told in CASES])
def test_what_breaks_a_limit_or_cannot_be_checked_is_refused(
    ask: Callable[..., None], change: Callable[[dict[str, Any]], object], told: str
) -> None:
    goal = goal_of(joint_goal(fr3_joint7=0.5))
    change(goal)
    with pytest.raises(RefusedError, match=told):
        ask(goal)


def test_a_posture_in_a_zone_is_refused_though_its_joints_are_within_limits(
    ask: Callable[..., None], limiter: PathLimiter
) -> None:
    goal = goal_of(joint_goal(fr3_joint1=0.4, fr3_joint2=0.3))
    tcp = limiter.posture(
        JointSample(names=ARM_JOINTS, position=np.array([0.4, 0.3, *HOME_RAD[2:]]))
    ).pose.position_m
    here = Obstacle(name="lamp", lower_m=tcp - 0.02, upper_m=tcp + 0.02)
    with pytest.raises(
        RefusedError, match=r"goal_constraints\[0\]: The TCP may come into the zone 'lamp'"
    ):
        ask(goal, frame=BASE, zones=(here,))
    ask(goal)


def in_camera(constraints: dict[str, Any]) -> dict[str, Any]:
    """The same numbers, in the frame of a camera."""
    made = copy.deepcopy(constraints)
    for kind in (POSITION, TURN):
        made[kind][0]["header"] = {"frame_id": "camera"}
    return made


def find_camera(target: str, source: str) -> Transform:
    """The camera is 0.4 m in front of the base and 0.3 m above it, rotated by half a turn about
    z.
    """
    if (target, source) != (BASE, "camera"):
        raise NotReadyError(f"The frame {source!r} is unknown.")
    return Transform(rotation=np.diag([-1.0, -1.0, 1.0]), translation_m=np.array([0.4, 0.0, 0.3]))


def test_constraints_in_another_frame_are_moved_into_that_of_the_limits(
    ask: Callable[..., Any],
) -> None:
    sent = ask(goal_of(in_camera(place_goal(0.1, 0.05, 0.02))), transforms=find_camera)
    (goal,) = sent.goal_constraints
    place, tip = goal.position_constraints[0], goal.orientation_constraints[0]
    centre = place.constraint_region.primitive_poses[0].position
    assert (centre.x, centre.y, centre.z) == pytest.approx((0.3, -0.05, 0.32))
    assert (place.header.frame_id, tip.header.frame_id) == (BASE, BASE)
    # half a turn about x, then half a turn about z: half a turn about y
    assert abs(tip.orientation.y) == pytest.approx(1.0)
    with pytest.raises(RefusedError, match="zone 'cup'"):
        ask(goal_of(in_camera(place_goal(-0.1, -0.2, -0.1))), transforms=find_camera)
    unknown = goal_of(changed(PLACE, POSITION, header={"frame_id": "lamp"}))
    with pytest.raises(RefusedError, match="'lamp' is unknown"):
        ask(unknown, transforms=find_camera)


def test_a_posture_is_judged_beside_a_place_as_well(ask: Callable[..., None]) -> None:
    far = joint_goal(fr3_joint2=0.9)
    with pytest.raises(RefusedError, match=r"workspace|apart"):
        ask(goal_of({**far, **place_goal(0.4, 0.0, 0.3)}))
    some = {JOINT: joint_goal()[JOINT][:2]}
    ask(goal_of({**some, **place_goal(0.4, 0.0, 0.3)}))


def test_what_moves_nothing_is_only_planned(ask: Callable[..., Any]) -> None:
    goal = goal_of(joint_goal())
    with pytest.raises(RefusedError, match="plan_only is false, but the endpoint is said to move"):
        ask(goal, joint_limited=False)
    goal["planning_options"]["plan_only"] = True
    ask(goal, joint_limited=False)


def test_without_measured_joints_a_posture_cannot_be_judged(ask: Callable[..., None]) -> None:
    with pytest.raises(RefusedError, match="not measured yet"):
        ask(goal_of(joint_goal()), joints=None)


def test_zones_in_another_frame_than_the_arm_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="frame = 'map', the limits of the arm are in"):
        check_plan_frame(endpoint(frame="map"), BASE)
    check_plan_frame(endpoint(frame=BASE), BASE)


def test_a_trajectory_that_is_to_be_executed_is_judged_row_by_row(ask: Callable[..., None]) -> None:
    ask(trajectory((0.1, 1.0), (0.2, 2.0)), EXECUTE)
    with pytest.raises(RefusedError, match=r"points\[1\]: fr3_joint7 would move at"):
        ask(trajectory((0.1, 1.0), (0.9, 1.1)), EXECUTE)
    moved = trajectory((0.1, 1.0))
    moved["trajectory"]["multi_dof_joint_trajectory"] = {"joint_names": ["base"]}
    with pytest.raises(RefusedError, match="several degrees of freedom"):
        ask(moved, EXECUTE)
    with pytest.raises(RefusedError, match="names no joints"):
        ask({}, EXECUTE)


def test_only_what_a_planner_carries_out_is_watched(limiter: PathLimiter) -> None:
    entry = AllowedEndpoint(
        robot="fr3", endpoint=endpoint(), profile=profile(), path=lambda: limiter
    )
    values = goal_of(joint_goal())

    def watched(allowed: AllowedEndpoint) -> bool:
        goal = filled(load_type(MOVE).Goal, values)
        return watch_of(allowed, [goal], lambda: HOME) is not None

    assert watched(entry)
    assert not watched(AllowedEndpoint(robot="fr3", endpoint=endpoint(), profile=profile()))
    values["planning_options"]["plan_only"] = True
    assert not watched(entry)
    executed = filled(load_type(EXECUTE).Goal, trajectory((0.1, 1.0)))
    assert watch_of(entry, [executed], lambda: HOME) is None, "it was judged point by point"

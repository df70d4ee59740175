"""Motion rules: each number of `[limits]` has its effect, and no limit is ever relaxed."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from roboneuron.config import LimitsConfig
from roboneuron.contract import (
    CollisionProfile,
    Controller,
    JointSample,
    Obstacle,
    Pose,
    Posture,
    RobotProfile,
    Workspace,
)
from roboneuron.errors import ConfigurationError
from roboneuron.gate.motion import LIMITS, check_tighter, inspector_of, motion_rules
from roboneuron.gate.motion.rules import collision_of

ROBOT = RobotProfile(name="arm")
BOXED = RobotProfile(
    name="arm",
    workspace=Workspace(lower_m=np.array([-1.0, -2.0, -3.0]), upper_m=np.array([1.0, 2.0, 3.0])),
)
VASE: dict[str, Any] = {"name": "vase", "lower_m": [0.0, 0.1, 0.2], "upper_m": [1.0, 1.1, 1.2]}
POT: dict[str, Any] = {"name": "pot", "lower_m": [5.0, 5.0, 5.0], "upper_m": [6.0, 6.0, 6.0]}


def config(**values: Any) -> LimitsConfig:
    return LimitsConfig.model_validate(values)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("velocity_fraction", 0.25),
        ("acceleration_fraction", 0.375),
        ("max_step_m", 0.03),
        ("max_step_rad", 0.3),
        ("max_speed_m_s", 0.2),
        ("max_turn_rad_s", 1.2),
        ("min_height_m", -0.4),
        ("min_singular_value", 0.07),
    ],
)
def test_a_number_of_the_configuration_becomes_the_rule_of_the_same_name(
    key: str, value: float
) -> None:
    assert getattr(motion_rules(config(**{key: value}), ROBOT), key) == value


@pytest.mark.parametrize("name", LIMITS)
@pytest.mark.parametrize("reaction", ["hold", "scale", "refuse"])
def test_each_limit_has_the_reaction_that_is_configured(name: str, reaction: str) -> None:
    rules = motion_rules(config(**{f"on_{name}": reaction}), ROBOT)
    assert rules.reactions == motion_rules(LimitsConfig(), ROBOT).reactions | {name: reaction}
    assert set(rules.reactions) == set(LIMITS)


def test_without_workspace_height_and_zones_nothing_is_limited() -> None:
    rules = motion_rules(LimitsConfig(), ROBOT)
    assert rules.lower_m.tolist() == [-np.inf] * 3
    assert rules.upper_m.tolist() == [np.inf] * 3
    assert rules.min_height_m == -np.inf
    assert rules.zones == ()


def test_the_workspace_is_the_robots_own_where_none_is_configured() -> None:
    lower = motion_rules(config(workspace_lower_m=[-0.5, -0.5, -0.5]), BOXED)
    assert (lower.lower_m.tolist(), lower.upper_m.tolist()) == ([-0.5, -0.5, -0.5], [1.0, 2.0, 3.0])
    upper = motion_rules(config(workspace_upper_m=[0.5, 0.5, 0.5]), BOXED)
    assert (upper.lower_m.tolist(), upper.upper_m.tolist()) == ([-1.0, -2.0, -3.0], [0.5, 0.5, 0.5])


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_workspace_may_be_as_wide_as_the_robots_and_no_wider(axis: int) -> None:
    lower, upper = [-1.0, -2.0, -3.0], [1.0, 2.0, 3.0]
    assert (
        motion_rules(
            config(workspace_lower_m=lower, workspace_upper_m=upper), BOXED
        ).upper_m.tolist()
        == upper
    )
    for key, corner, by in (
        ("workspace_lower_m", lower, -0.001),
        ("workspace_upper_m", upper, 0.001),
    ):
        wider = list(corner)
        wider[axis] += by
        with pytest.raises(ConfigurationError, match="wider than that of robot 'arm'"):
            motion_rules(config(**{key: wider}), BOXED)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_box_has_an_extent_along_every_axis(axis: int) -> None:
    flat = list(VASE["upper_m"])
    flat[axis] = VASE["lower_m"][axis]
    for key, wrong in (
        ("zones", config(zones=[VASE | {"upper_m": flat}])),
        ("workspace", config(workspace_lower_m=VASE["lower_m"], workspace_upper_m=flat)),
    ):
        with pytest.raises(ConfigurationError, match=f"^limits.{key}: "):
            motion_rules(wrong, ROBOT)
    with pytest.raises(
        ConfigurationError, match=r"^limits.obstacles: 'vase' reaches from .* which is no box"
    ):
        collision_of(config(obstacles=[VASE | {"upper_m": flat}]), ROBOT)


def test_zones_keep_their_names_and_corners() -> None:
    zones = motion_rules(config(zones=[VASE, POT]), ROBOT).zones
    assert [(zone.name, zone.lower_m.tolist(), zone.upper_m.tolist()) for zone in zones] == [
        ("vase", VASE["lower_m"], VASE["upper_m"]),
        ("pot", POT["lower_m"], POT["upper_m"]),
    ]


@pytest.mark.parametrize(
    ("key", "tighter", "configured", "wider"),
    [
        *(("velocity_fraction", 0.4, 0.5, 0.6), ("acceleration_fraction", 0.4, 0.5, 0.6)),
        *(("max_step_m", 0.04, 0.05, 0.06), ("max_step_rad", 0.4, 0.5, 0.6)),
        *(("max_speed_m_s", 0.4, 0.5, 0.6), ("max_turn_rad_s", 0.4, 0.5, 0.6)),
        *(("min_height_m", 0.1, 0.0, -0.1), ("min_singular_value", 0.06, 0.05, 0.04)),
        ("workspace_lower_m", [0.0, 0.0, 0.1], [0.0, 0.0, 0.0], [0.1, 0.1, -0.1]),
        ("workspace_upper_m", [1.0, 1.0, 0.9], [1.0, 1.0, 1.0], [0.9, 0.9, 1.1]),
    ],
)
def test_a_number_may_stay_or_be_tightened(
    key: str, tighter: Any, configured: Any, wider: Any
) -> None:
    before = config(**{key: configured})
    for allowed in (tighter, configured):
        check_tighter(config(**{key: allowed}), before)
    with pytest.raises(ConfigurationError, match=f"limits.{key} = .* only be tightened"):
        check_tighter(config(**{key: wider}), before)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("min_height_m", -5.0),
        ("workspace_lower_m", [0.0, 0.0, 0.0]),
        ("workspace_upper_m", [1.0, 1.0, 1.0]),
    ],
)
def test_a_limit_may_be_added_and_none_removed(key: str, value: Any) -> None:
    check_tighter(config(**{key: value}), LimitsConfig())
    check_tighter(LimitsConfig(), LimitsConfig())
    with pytest.raises(ConfigurationError, match=f"limits.{key} = None is wider"):
        check_tighter(LimitsConfig(), config(**{key: value}))


def test_zones_may_be_added_and_none_removed_or_changed() -> None:
    check_tighter(config(zones=[POT, VASE]), config(zones=[VASE]))
    check_tighter(config(zones=[VASE]), LimitsConfig())
    for other in ([], [POT], [VASE | {"name": "bowl"}]):
        with pytest.raises(ConfigurationError, match="lacks a configured zone"):
            check_tighter(config(zones=other), config(zones=[VASE, POT]))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("on_zone", "refuse"),
        ("on_position", "scale"),
        ("collision", False),
        ("min_distance_m", 0.1),
    ],
)
def test_whatever_is_no_number_to_tighten_stays(key: str, value: Any) -> None:
    check_tighter(config(**{key: value}), config(**{key: value}))
    with pytest.raises(ConfigurationError, match=f"limits.{key} cannot be changed"):
        check_tighter(config(**{key: value}), LimitsConfig())


TABLE = Obstacle(name="table", lower_m=np.zeros(3), upper_m=np.ones(3))
GIVEN = CollisionProfile(min_distance_m=0.02, obstacles=(TABLE,), tool_links=("hand",))
CAREFUL = RobotProfile(name="arm", collision=GIVEN)


def test_collisions_are_checked_as_the_robot_says() -> None:
    assert collision_of(LimitsConfig(), CAREFUL) is GIVEN
    assert collision_of(LimitsConfig(), ROBOT) is None


def test_collisions_that_are_switched_off_are_not_checked() -> None:
    asked = {"min_distance_m": 0.05, "obstacles": [VASE]}
    assert collision_of(config(collision=False, **asked), CAREFUL) is None
    assert collision_of(config(collision=False, **asked), ROBOT) is None


@pytest.mark.parametrize("distance_m", [0.02, 0.03])
def test_the_least_distance_may_be_the_robots_or_longer(distance_m: float) -> None:
    made = collision_of(config(min_distance_m=distance_m), CAREFUL)
    assert made is not None
    assert (made.min_distance_m, made.obstacles, made.tool_links) == (
        distance_m,
        (TABLE,),
        ("hand",),
    )


def test_the_least_distance_is_no_shorter_than_the_robots() -> None:
    with pytest.raises(
        ConfigurationError, match=r"min_distance_m = 0.019 is less than the 0.02 m of robot 'arm'"
    ):
        collision_of(config(min_distance_m=0.019), CAREFUL)


def test_a_robot_that_says_nothing_of_collisions_is_checked_when_the_configuration_does() -> None:
    near = collision_of(config(min_distance_m=0.001), ROBOT)
    assert near is not None
    assert (near.min_distance_m, near.obstacles) == (0.001, ())
    around = collision_of(config(obstacles=[VASE]), ROBOT)
    assert around is not None
    assert (around.min_distance_m, [box.name for box in around.obstacles]) == (0.01, ["vase"])


def test_configured_obstacles_replace_the_robots() -> None:
    made = collision_of(config(obstacles=[VASE, POT]), CAREFUL)
    assert made is not None
    assert (made.min_distance_m, made.tool_links) == (0.02, ("hand",))
    assert [(box.name, box.lower_m.tolist(), box.upper_m.tolist()) for box in made.obstacles] == [
        ("vase", VASE["lower_m"], VASE["upper_m"]),
        ("pot", POT["lower_m"], POT["upper_m"]),
    ]
    none = collision_of(config(obstacles=[]), CAREFUL)
    assert none is not None
    assert none.obstacles == ()


class Plain(Controller):
    """Returns the TCP pose, 1 m beyond its joint."""

    def load(self) -> None: ...

    def compute(self, action: Any, joints: JointSample, step_s: float) -> Any:
        raise NotImplementedError

    def close(self) -> None: ...

    def forward(self, joints: JointSample) -> Pose:
        return Pose(
            position_m=np.array([1.0 + joints.position[0], 0.0, 0.0]), quaternion_xyzw=np.eye(4)[3]
        )


class Inspecting(Plain):
    """Also returns an inspection."""

    def inspect(self, joints: JointSample) -> Posture:
        return Posture(pose=self.forward(joints), smallest_singular_value=0.5)


def test_a_controller_that_inspects_is_asked_for_the_posture_and_another_for_the_pose() -> None:
    joints = JointSample(names=("a",), position=np.array([0.25]))
    full = inspector_of(Inspecting())(joints)
    assert (full.pose.position_m[0], full.smallest_singular_value) == (1.25, 0.5)
    plain = inspector_of(Plain())(joints)
    assert (plain.pose.position_m[0], plain.smallest_singular_value, plain.near) == (
        1.25,
        None,
        None,
    )

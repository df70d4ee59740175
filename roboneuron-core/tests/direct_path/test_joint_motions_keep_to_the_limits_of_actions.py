"""Joint commands pass the same limits of place and speed as actions: forward kinematics along the
way.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roboneuron.config import LimitsConfig
from roboneuron.contract import (
    CollisionProfile,
    JointLimits,
    JointSample,
    Pose,
    Posture,
    Proximity,
    RobotProfile,
    Workspace,
)
from roboneuron.direct_path.gate import Gate
from roboneuron.direct_path.request import AllowedEndpoint
from roboneuron.errors import ConfigurationError, RefusedError, UnsafeError
from roboneuron.gate.motion import collision_of, motion_rules
from roboneuron.gate.motion.path import levers_m
from roboneuron.gate.motion.path_limits import Leg, PathLimiter

PROFILE = RobotProfile(
    name="arm",
    arm_joints=("j1", "j2"),
    tcp_link="tcp",
    limits=JointLimits(
        lower=np.full(2, -3.0),
        upper=np.full(2, 3.0),
        velocity=np.full(2, 4.0),
        acceleration=np.full(2, 20.0),
        effort=np.ones(2),
    ),
)
"""Two links of 0.5 m that turn about z, on a shelf at z = 0.4 m."""
SLOW_S = 20.0
PERSON = {"name": "person", "lower_m": [0.75, 0.5, 0.0], "upper_m": [0.85, 0.6, 1.0]}


def inspect(joints: JointSample) -> Posture:
    """The second joint bends the arm; the links come near each other beyond 2 rad."""
    known = dict(zip(joints.names, joints.position.tolist(), strict=True))
    if len(known) < 2:
        raise UnsafeError(f"Joint 'j2' is not measured: {known}.")
    a, b = known["j1"], known["j2"]
    position = np.array(
        [
            0.5 * math.cos(a) + 0.5 * math.cos(a + b),
            0.5 * math.sin(a) + 0.5 * math.sin(a + b),
            0.4 - 0.1 * b * b,
        ]
    )
    turn = np.array([0.0, 0.0, math.sin((a + b) / 2), math.cos((a + b) / 2)])
    gap = Proximity(
        first="upper arm", second="hand", distance_m=0.01 + (2.0 - abs(b)) * 0.05, least_m=0.01
    )
    return Posture(
        pose=Pose(position_m=position, quaternion_xyzw=turn),
        smallest_singular_value=0.25 * abs(math.sin(b)),
        near=(gap,) if gap.distance_m < gap.least_m else (),
    )


def at(a: float, b: float) -> JointSample:
    return JointSample(names=("j1", "j2"), position=np.array([a, b]))


def limiter(profile: RobotProfile = PROFILE, **limits: Any) -> PathLimiter:
    return PathLimiter(motion_rules(LimitsConfig.model_validate(limits), profile), profile, inspect)


@pytest.fixture
def move(latch: Any, audit: Any, clock: Any, ask: Any, endpoints: Any) -> Callable[..., Any]:
    """Ask a gate for a trajectory of (time, positions); the limits are keyword arguments."""

    def make(
        *points: tuple[float, list[float]], start: JointSample | None = None, rates: bool = False,
        simulated: bool = False, **limits: Any,
    ) -> Any:  # fmt: skip
        paths = limiter(**limits)
        entry = AllowedEndpoint(
            robot="arm", endpoint=endpoints["trajectory"], profile=PROFILE, path=lambda: paths
        )  # fmt: skip
        gate = Gate([entry], latch=latch, audit=audit, clock=clock.monotonic)
        made = [
            {"positions": q, "time_from_start": t, **({"velocities": [0.0, 3.0]} if rates else {})}
            for t, q in points
        ]
        value = {"joint_names": ["j1", "j2"], "points": made}
        return gate.check(
            ask(endpoints["trajectory"], value, joints=start or at(0.0, 0.5), simulated=simulated)
        )

    return make


def test_a_joint_motion_within_all_limits_passes(move: Any) -> None:
    assert move((SLOW_S, [0.5, 0.6])).may_send


@pytest.mark.parametrize(
    ("target", "limits", "rule", "text"),
    [
        ([1.2, 0.5], {"zones": [PERSON]}, "zone", "would enter 'person'"),
        ([0.0, 1.0], {"min_height_m": 0.35}, "height", "at a height of 0.3"),
        ([1.2, 0.5], {"workspace_upper_m": [1.0, 0.7, 1.0]}, "workspace", "outside the workspace"),
        (
            [0.0, 2.5],
            {},
            "collision",
            r"upper arm and hand would be \d+.\d mm apart, at least 10 mm are required",
        ),
    ],
)
def test_the_way_is_judged_not_only_the_target(
    move: Any, target: Any, limits: Any, rule: str, text: str
) -> None:
    with pytest.raises(RefusedError, match=text):
        move((SLOW_S, target), **limits)
    verdict = move((SLOW_S, target), simulated=True, **limits)
    assert (verdict.allowed, verdict.may_send, verdict.rule) == (False, False, rule)


def test_a_thin_zone_between_two_postures_is_not_jumped(move: Any) -> None:
    wall = {"name": "wall", "lower_m": [0.0, 0.40, 0.0], "upper_m": [1.0, 0.4001, 1.0]}
    assert move((SLOW_S, [1.2, 0.5])).may_send
    with pytest.raises(RefusedError, match="'wall'"):
        move((SLOW_S, [1.2, 0.5]), zones=[wall])


def test_a_trajectory_that_goes_back_to_its_start_is_judged_between_its_points(move: Any) -> None:
    with pytest.raises(RefusedError, match=r"points\[1\].*'person'"):
        move(
            (SLOW_S, [0.0, 0.4]), (2 * SLOW_S, [1.2, 0.5]), (3 * SLOW_S, [0.0, 0.5]), zones=[PERSON]
        )


def test_speed_and_turn_of_the_tcp_are_limited_and_the_answer_says_how_long_it_takes(
    move: Any,
) -> None:
    with pytest.raises(
        RefusedError,
        match=r"TCP would move at 0\.9\d+ m/s, allowed is 0.5 m/s. Give it 1\.9\d? times",
    ):
        move((1.0, [1.0, 0.5]))
    assert move((2.0, [1.0, 0.5])).may_send
    with pytest.raises(RefusedError, match=r"allowed is 0.3 rad/s"):
        move((2.0, [1.0, 0.5]), max_turn_rad_s=0.3)


def test_slowdown_is_what_the_speed_limit_asks_for() -> None:
    paths = limiter()
    leg = Leg(names=("j1",), position=np.array([1.0]), duration_s=1.0)
    factor = paths.slowdown([leg], at(0.0, 0.5))
    paths.check([replace(leg, duration_s=factor * 1.001)], at(0.0, 0.5))
    with pytest.raises(RefusedError):
        paths.check([replace(leg, duration_s=factor * 0.999)], at(0.0, 0.5))
    assert paths.slowdown([replace(leg, duration_s=100.0)], at(0.0, 0.5)) == 1.0


def test_ways_out_are_allowed_and_ways_deeper_in_are_not(move: Any) -> None:
    folded = at(0.0, 2.3)
    assert move((SLOW_S, [0.0, 1.5]), start=folded).may_send
    with pytest.raises(RefusedError, match="mm apart"):
        move((SLOW_S, [0.0, 2.4]), start=folded)


def test_a_singularity_does_not_limit_joint_motions(move: Any) -> None:
    assert move((SLOW_S, [0.0, 0.0]), (2 * SLOW_S, [0.0, -0.5])).may_send


def test_velocities_that_bend_the_way_are_followed_on_the_cubic(move: Any) -> None:
    """With 3 rad/s at its end the cubic overshoots j2 by far, though both points are where they may
    be.
    """
    high = {"name": "ceiling", "lower_m": [-2.0, -2.0, 0.0], "upper_m": [2.0, 2.0, 0.3]}
    points = ((4.0, [0.0, 0.55]), (8.0, [0.0, 0.5]))
    assert move(*points, zones=[high]).may_send
    with pytest.raises(RefusedError, match=r"ceiling|TCP would"):
        move(*points, rates=True, zones=[high])


def test_an_arm_without_kinematics_is_refused_not_unlimited(
    latch, audit, clock, ask, endpoints
) -> None:
    def fail() -> PathLimiter:
        raise ConfigurationError("There is no controller.", hint="Install one.")

    entry = AllowedEndpoint(
        robot="arm", endpoint=endpoints["trajectory"], profile=PROFILE, path=fail
    )
    gate = Gate([entry], latch=latch, audit=audit, clock=clock.monotonic)
    value = {"joint_names": ["j1"], "points": [{"positions": [0.1], "time_from_start": 5.0}]}
    request = ask(endpoints["trajectory"], value, joints=at(0.0, 0.5))
    with pytest.raises(
        RefusedError, match=r"cannot be checked: There is no controller\. Install one\."
    ):
        gate.check(request)
    assert gate.check(replace(request, simulated=True)).rule == "kinematics"


def test_distances_that_nobody_tells_are_refused() -> None:
    profile = replace(PROFILE, collision=CollisionProfile())
    blind = PathLimiter(
        motion_rules(LimitsConfig(), profile),
        profile,
        lambda joints: replace(inspect(joints), near=None),
    )
    with pytest.raises(RefusedError, match="reports no distances"):
        blind.check([Leg(names=("j1",), position=np.array([0.1]), duration_s=5.0)], at(0.0, 0.5))


def test_an_unmeasured_joint_of_the_arm_is_refused() -> None:
    with pytest.raises(RefusedError, match="'j2' is not measured"):
        limiter().check(
            [Leg(names=("j2",), position=np.zeros(1), duration_s=5.0)],
            JointSample(names=("j1", "j2"), position=np.array([0.0, math.nan])),
        )


def test_a_way_that_would_take_too_long_to_judge_is_refused(move: Any) -> None:
    points = [(SLOW_S * (i + 1), [2.9 * (-1) ** i, 0.5]) for i in range(200)]
    with pytest.raises(RefusedError, match="too long to be checked"):
        move(*points)


@pytest.mark.parametrize(
    "count",
    [
        12,
        pytest.param(30, marks=pytest.mark.exhaustive),
        pytest.param(100, marks=pytest.mark.slow),
    ],
)
def test_nothing_that_passes_meets_a_zone(move: Any, count: int) -> None:
    """Against a fine walk along the way, zones of any thickness."""

    @settings(max_examples=count, deadline=None)
    @given(
        st.lists(st.tuples(st.floats(-2.9, 2.9), st.floats(-1.9, 1.9)), min_size=1, max_size=3),
        st.floats(0.002, 0.2),
    )
    def check(targets: list[tuple[float, float]], thickness: float) -> None:
        zone = {
            "name": "box",
            "lower_m": [0.3, 0.2, 0.0],
            "upper_m": [0.3 + thickness, 0.2 + thickness, 1.0],
        }
        points = [(SLOW_S * (i + 1), list(q)) for i, q in enumerate(targets)]
        try:
            move(*points, zones=[zone], max_speed_m_s=3.0, max_turn_rad_s=10.0)
        except RefusedError:
            return
        here = np.array([0.0, 0.5])
        for target in targets:
            for s in np.linspace(0.0, 1.0, 2000):
                x, y, _ = inspect(at(*(here + (np.array(target) - here) * s))).pose.position_m
                depth = min(x - 0.3, 0.3 + thickness - x, y - 0.2, 0.2 + thickness - y)
                assert depth < 5e-4  # what a way bends between two postures 2 cm apart
            here = np.array(target)

    check()


def test_levers_bound_how_far_the_arm_moves() -> None:
    urdf = (
        '<robot name="x"><link name="base"/><link name="a"/><link name="b"/><link name="tcp"/>'
        '<joint name="turn" type="revolute"><parent link="base"/><child link="a"/></joint>'
        '<joint name="slide" type="prismatic"><parent link="a"/><child link="b"/><origin xyz="0.3 '
        '0 0.4"/>'
        '<limit lower="0" upper="0.2"/></joint>'
        '<joint name="tip" type="fixed"><parent link="b"/><child link="tcp"/><origin xyz="0 0 '
        '1"/></joint></robot>'
    )
    levers = levers_m(replace(PROFILE, urdf=urdf, base_link="base"))
    assert levers["slide"] == 1.0
    assert levers["turn"] == pytest.approx(0.1 + 1.0 + 0.5 + 0.2)
    assert levers_m(replace(PROFILE, urdf="no xml")) == {}


def test_obstacles_and_distance_come_from_the_configuration_or_the_profile() -> None:
    own = replace(PROFILE, collision=CollisionProfile(min_distance_m=0.01), workspace=Workspace(
        lower_m=np.full(3, -1.0), upper_m=np.ones(3)))  # fmt: skip
    box = {"name": "shelf", "lower_m": [0, 0, 0], "upper_m": [1, 1, 1]}
    assert collision_of(LimitsConfig(), PROFILE) is None
    assert collision_of(LimitsConfig(), own) is own.collision
    assert collision_of(LimitsConfig(collision=False), own) is None
    made = collision_of(
        LimitsConfig.model_validate({"obstacles": [box], "min_distance_m": 0.03}), own
    )
    assert made is not None
    assert ([o.name for o in made.obstacles], made.min_distance_m) == (["shelf"], 0.03)
    assert collision_of(LimitsConfig.model_validate({"obstacles": [box]}), PROFILE) is not None
    with pytest.raises(ConfigurationError, match="can only be tightened"):
        collision_of(LimitsConfig(min_distance_m=0.005), own)
    with pytest.raises(ConfigurationError, match=r"limits.obstacles: 'shelf'.* no box"):
        collision_of(
            LimitsConfig.model_validate({"obstacles": [box | {"upper_m": [0, 1, 1]}]}), own
        )

"""A refused joint path tells its first and its deepest forbidden place, and what is allowed."""

from __future__ import annotations

import json
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from roboneuron.config import LimitsConfig
from roboneuron.contract import JointLimits, JointSample, Pose, Posture, Proximity, RobotProfile
from roboneuron.contract.motion import LinkExtents
from roboneuron.errors import RefusedError, UnsafeError
from roboneuron.gate.motion import path_limits
from roboneuron.gate.motion.joint_paths import check_joints
from roboneuron.gate.motion.joint_space import JointLimit
from roboneuron.gate.motion.path_limits import Leg, LimitError, PathLimiter
from roboneuron.gate.motion.rules import motion_rules

NAMES = ("x", "y")
PROFILE = RobotProfile(
    name="arm",
    arm_joints=NAMES,
    tcp_link="tcp",
    limits=JointLimits(
        lower=np.full(2, -2.0),
        upper=np.full(2, 2.0),
        velocity=np.full(2, 9.0),
        acceleration=np.full(2, 9.0),
        effort=np.ones(2),
    ),
)
"""Slides along x and y, 0.4 m above the floor; beyond y = 1.5 m its hand nears its post."""
START = JointSample(names=NAMES, position=np.array([0.0, 0.0]))
PANE = {"name": "pane", "lower_m": [0.5, -1.0, 0.0], "upper_m": [1.5, 1.0, 1.0]}
SOLID = {**PANE, "applies_to": "arm"}


def inspect(joints: JointSample) -> Posture:
    x, y = joints.position.tolist()
    if x > 1.9:
        raise UnsafeError("It cannot be computed.")
    gap = Proximity(first="hand", second="post", distance_m=0.01 + 1.5 - y, least_m=0.01)
    at = np.array([x, y, 0.4])
    links = LinkExtents(names=("hand",), lower_m=at[np.newaxis] - 0.05, upper_m=at[np.newaxis])
    return Posture(
        pose=Pose(position_m=at, quaternion_xyzw=np.array([0.0, 0.0, 0.0, 1.0])),
        smallest_singular_value=None,
        near=(gap,) if gap.distance_m < gap.least_m else (),
        extents=lambda: links,
    )


def refusal(*ends: Sequence[float], **limits: Any) -> LimitError:
    legs = [
        Leg(names=NAMES, position=np.array(end), duration_s=None, where=f"points[{number}]: ")
        for number, end in enumerate(ends)
    ]
    rules = motion_rules(LimitsConfig.model_validate(limits), PROFILE)
    with pytest.raises(LimitError) as caught:
        PathLimiter(rules, PROFILE, inspect).check(legs, START)
    return caught.value


@pytest.mark.parametrize(
    ("limits", "limit", "what", "deepest_mm"),
    [
        ({"zones": [PANE]}, "zone", "'pane'", 400),
        ({"zones": [SOLID]}, "zone", "hand", 400),
        ({"workspace_upper_m": [0.5, 1.0, 1.0]}, "workspace", "x <= 0.5 m", 400),
    ],
)
def test_the_first_and_the_deepest_place_are_told(
    limits: dict[str, Any], limit: str, what: str, deepest_mm: int
) -> None:
    error = refusal((0.3, 0.0), (0.6, 0.0), (0.9, 0.0), (0.2, 0.0), **limits)
    first, _, deepest = str(error).partition("Deepest")
    assert error.limit == limit
    assert first.startswith("points[1]: ")
    assert what in first
    assert f"{deepest_mm} mm" in deepest
    assert "points[2]: " in deepest
    assert what in deepest


def test_links_that_come_too_near_are_told_by_how_much() -> None:
    error = refusal((0.0, 1.6))
    assert error.limit == "collision"
    assert "Deepest, by 100 mm" in error.message


def test_a_place_that_is_first_and_deepest_is_told_once() -> None:
    error = refusal((0.505, 0.0), zones=[PANE])
    assert error.message.count("'pane'") == 1
    assert "5 mm" in error.message


def test_the_hint_says_how_far_the_first_part_is_allowed() -> None:
    error = refusal((0.8, 0.0), zones=[PANE])
    call = error.hint[error.hint.index("{") : error.hint.rindex("}") + 1]
    positions = json.loads(call)["positions"]
    assert "move_joints" in error.hint
    assert 0.4 < positions["x"] < 0.5
    rules = motion_rules(LimitsConfig.model_validate({"zones": [PANE]}), PROFILE)
    part = Leg(names=NAMES, position=np.array([positions[n] for n in NAMES]), duration_s=None)
    PathLimiter(rules, PROFILE, inspect).check([part], START)


def test_the_hint_says_which_parts_are_allowed_before_a_later_one() -> None:
    error = refusal((0.3, 0.0), (0.4, 0.1), (0.8, 0.0), zones=[PANE])
    assert "points[2]" in error.hint
    assert "move_joints" not in error.hint


def test_a_way_that_ends_where_nothing_can_be_judged_tells_what_was_found() -> None:
    error = refusal((0.8, 0.0), (2.0, 1.2), zones=[PANE])
    assert error.limit == "zone"


def test_a_way_that_becomes_too_long_tells_what_was_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(path_limits, "MAX_POSTURES", 60)
    assert refusal((0.8, 0.0), (0.0, 0.0), (0.8, 0.0), zones=[PANE]).limit == "zone"


def trajectory(*ends: float, joint: str = "x") -> Any:
    points = [
        SimpleNamespace(
            positions=[end],
            velocities=[],
            accelerations=[],
            effort=[],
            time_from_start=SimpleNamespace(sec=10 * number, nanosec=0),
        )
        for number, end in enumerate(ends, 1)
    ]
    return SimpleNamespace(joint_names=[joint], points=points)


@pytest.mark.parametrize(
    ("messages", "first", "deepest"),
    [
        ([trajectory(1.0, 2.1, 2.4, 2.2)], "points[1]: ", "by 0.4: points[2]: "),
        ([trajectory(2.1), trajectory(0.0, -2.5)], "steps[0]: ", "by 0.5: steps[1]: points[1]: "),
        ([trajectory(2.4, 2.1)], "points[0]: ", ""),
        ([trajectory(2.4), trajectory(9.0, joint="other")], "steps[0]: points[0]: ", ""),
        ([trajectory(2.4, float("nan"))], "points[0]: ", "by inf: points[1]: "),
    ],
)
def test_of_positions_out_of_range_the_first_and_the_farthest_are_told(
    messages: list[Any], first: str, deepest: str
) -> None:
    with pytest.raises(RefusedError) as caught:
        check_joints(JointLimit.by_joint(PROFILE), messages, START)
    before, _, after = caught.value.message.partition("Deepest, ")
    assert before.startswith(first)
    assert after.startswith(deepest)
    assert bool(after) == bool(deepest)

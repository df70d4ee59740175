"""Limits that apply to the arm: no link, and nothing held, gets in; an arm that is in gets out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from roboneuron.config import LimitsConfig
from roboneuron.contract import JointSample, LinkExtents, Pose, Posture, RobotProfile, Workspace
from roboneuron.errors import ConfigurationError, UnsafeError
from roboneuron.gate.motion import motion_rules
from roboneuron.gate.motion.path_limits import Leg, LimitError, PathLimiter
from roboneuron.gate.motion.rules import check_tighter
from roboneuron.gate.motion.task_space import TaskSpace

ROBOT = RobotProfile(
    name="arm",
    arm_joints=("y",),
    workspace=Workspace(lower_m=np.array([0.2, -0.5, 0.0]), upper_m=np.array([0.8, 0.5, 0.9])),
)
HALF_M = 0.1
FACES = {
    "x >= 0.25 m": {"workspace_lower_m": [0.25, -9.0, -9.0], "workspace_upper_m": [9.0, 9.0, 9.0]},
    "y <= 0.2 m": {"workspace_lower_m": [-9.0, -9.0, -9.0], "workspace_upper_m": [9.0, 0.2, 9.0]},
    "z >= 0.15 m": {"min_height_m": 0.15},
}
VASE = {"name": "vase", "lower_m": [0.4, 0.3, 0.0], "upper_m": [0.6, 0.5, 0.3], "applies_to": "arm"}


def posture(x_m: float, y_m: float, z_m: float, *, tells: bool = True) -> Posture:
    """A hand of 0.2 m around its TCP, and a base that stays at the origin."""
    tcp = np.array([x_m, y_m, z_m])
    lower, upper = np.array([tcp - HALF_M, [-0.1] * 3]), np.array([tcp + HALF_M, [0.1] * 3])
    found = LinkExtents(names=("hand", "shoulder"), lower_m=lower, upper_m=upper)
    return Posture(
        pose=Pose(position_m=tcp, quaternion_xyzw=np.array([0.0, 0.0, 0.0, 1.0])),
        extents=(lambda: found) if tells else None,
    )


def limits(**values: Any) -> LimitsConfig:
    return LimitsConfig.model_validate(values)


def places(config: LimitsConfig, start: Posture, end: Posture) -> list[tuple[str, str]]:
    found = TaskSpace(motion_rules(config, ROBOT)).places(start.pose, end, lambda: start)
    return [(one.limit, one.reason) for one in found]


INSIDE = (0.5, 0.0, 0.4)


@pytest.mark.parametrize(
    ("config", "to_m", "limit", "name"),
    [
        ({"applies_to": "arm", **FACES["x >= 0.25 m"]}, (0.34, 0.0, 0.4), "workspace", "x >= 0.25"),
        ({"applies_to": "arm", **FACES["y <= 0.2 m"]}, (0.5, 0.11, 0.4), "workspace", "y <= 0.2"),
        ({"applies_to": "arm", **FACES["z >= 0.15 m"]}, (0.5, 0.0, 0.24), "height", "z >= 0.15"),
        ({"zones": [VASE]}, (0.5, 0.21, 0.35), "zone", "vase"),
    ],
)
def test_no_link_gets_where_the_tcp_alone_may(
    config: dict[str, Any], to_m: tuple[float, float, float], limit: str, name: str
) -> None:
    (told,) = places(limits(**config), posture(*INSIDE), posture(*to_m))
    assert told[0] == limit
    assert "hand" in told[1]
    assert name in told[1]
    of_tcp = {key: value for key, value in config.items() if key not in ("applies_to", "zones")}
    if of_tcp:
        with_tcp = limits(**{**of_tcp, "workspace_lower_m": None, "workspace_upper_m": None})
        assert places(with_tcp, posture(*INSIDE), posture(*to_m)) == []


def test_what_touches_a_face_is_not_beyond_it() -> None:
    config = limits(applies_to="arm", **FACES["y <= 0.2 m"])
    assert places(config, posture(*INSIDE), posture(0.5, 0.1, 0.4)) == []


def test_an_arm_that_is_beyond_a_face_may_only_get_out() -> None:
    config = limits(applies_to="arm", **FACES["y <= 0.2 m"])
    here = posture(0.5, 0.3, 0.4)
    assert places(config, here, posture(0.5, 0.25, 0.4)) == []
    assert [name for name, _ in places(config, here, posture(0.5, 0.31, 0.4))] == ["workspace"]
    # the shoulder sticks out all the time, and does not keep the hand from moving
    front = limits(applies_to="arm", **FACES["x >= 0.25 m"])
    assert places(front, posture(*INSIDE), posture(0.6, 0.0, 0.4)) == []


def test_a_controller_that_tells_no_links_cannot_be_judged() -> None:
    config = limits(zones=[VASE])
    with pytest.raises(UnsafeError, match="applies_to"):
        places(config, posture(*INSIDE), posture(0.5, 0.1, 0.4, tells=False))
    assert places(limits(), posture(*INSIDE), posture(0.5, 0.1, 0.4, tells=False)) == []


def test_the_robots_own_workspace_stays_that_of_its_tcp() -> None:
    rules = motion_rules(limits(applies_to="arm", **FACES["y <= 0.2 m"]), ROBOT)
    assert ROBOT.workspace is not None
    assert rules.lower_m.tolist() == ROBOT.workspace.lower_m.tolist()
    assert rules.upper_m.tolist() == ROBOT.workspace.upper_m.tolist()


def test_a_path_of_joints_is_judged_by_every_link() -> None:
    def inspect(joints: JointSample) -> Posture:
        return posture(0.5, float(joints.position[0]), 0.2)

    limiter = PathLimiter(motion_rules(limits(zones=[VASE]), ROBOT), ROBOT, inspect)
    joints = JointSample(names=("y",), position=np.array([0.0]))
    limiter.check([Leg(names=("y",), position=np.array([0.15]), duration_s=None)], joints)
    beyond = Leg(names=("y",), position=np.array([0.45]), duration_s=None)
    with pytest.raises(LimitError) as refusal:
        limiter.check([beyond], joints)
    assert refusal.value.limit == "zone"
    with pytest.raises(LimitError):
        limiter.check_stand(beyond, joints)


def test_whole_arm_limits_are_tightened_and_never_widened() -> None:
    check_tighter(limits(zones=[VASE]), limits())
    with pytest.raises(ConfigurationError):
        check_tighter(limits(zones=[{**VASE, "applies_to": "tcp"}]), limits(zones=[VASE]))

"""What the server of a model tells is what a robot goes by: its space, cameras and rows."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import pytest

from roboneuron import (
    EE_DELTA,
    ActionSpace,
    Backend,
    BackendSpec,
    ConfigurationError,
    ControlSpace,
    PlanningError,
    PluginError,
    RobotProfile,
    robot_space,
)
from roboneuron.modules.inference.loaded import ServedElsewhere, _as_served
from roboneuron.modules.inference.planning import ResolvedPolicy

ROBOT = RobotProfile(name="arm", arm_joints=("a", "b"))
JOINTS = robot_space("joint_position", ROBOT, 20.0)
SPEC = BackendSpec(name="shared", summary="x", target="x:y", action_space=ActionSpace(horizon=100))
SERVED = replace(SPEC, action_space=ActionSpace(horizon=12), max_committed_rows=4)


class Remote:
    """A backend that has reached its server."""

    def __init__(self, told: tuple[BackendSpec, ControlSpace] | None) -> None:
        self.told = told

    def served_spec(self, profile: RobotProfile) -> tuple[BackendSpec, ControlSpace] | None:
        assert profile is ROBOT
        return self.told


def asked(
    told: tuple[BackendSpec, ControlSpace] | None, declared: ControlSpace | None
) -> tuple[ResolvedPolicy, ControlSpace]:
    remote = Remote(told)
    assert isinstance(remote, ServedElsewhere)
    policy = ResolvedPolicy(
        robot=cast("object", SimpleNamespace(name="arm")),  # type: ignore[arg-type]
        driver=cast("object", SimpleNamespace(name="sim")),  # type: ignore[arg-type]
        backend=SPEC,
        runtime=None,
        acceleration=None,
        cameras={"primary": "top"},
    )
    return _as_served(policy, cast("Backend", remote), declared, ROBOT)


def test_the_space_and_the_rows_are_those_of_the_server() -> None:
    policy, space = asked((SERVED, JOINTS), None)
    assert space is JOINTS
    assert policy.backend.action_space.horizon == 12
    assert policy.backend.max_committed_rows == 4
    assert asked((SERVED, JOINTS), JOINTS)[1] is JOINTS


def test_a_space_that_is_declared_otherwise_here_is_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"joint_position@20:a,b.*say 'ee_delta"):
        asked((SERVED, JOINTS), replace(EE_DELTA, rate_hz=5.0))


def test_a_camera_that_the_robot_lacks_is_named() -> None:
    needs = replace(SERVED, cameras=("primary", "wrist"))
    with pytest.raises(PlanningError, match=r"role wrist; of robot 'arm'.*primary \(top\)"):
        asked((needs, JOINTS), None)


def test_a_model_of_this_machine_is_as_its_backend_declares() -> None:
    policy, space = asked(None, EE_DELTA)
    assert (policy.backend, space) == (SPEC, EE_DELTA)
    with pytest.raises(PluginError, match="Neither"):
        asked(None, None)

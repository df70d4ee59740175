"""Control is planned from descriptors, for the interpreter it will run under."""

from __future__ import annotations

from dataclasses import replace

import pytest

from rn_testing.fakes import FAKE_CONTROLLER, FAKE_ROBOT, fake_registry
from roboneuron import PlanningError
from roboneuron.feature import Config
from roboneuron.modules.control.planning import plan_control


def config(**control: str) -> Config:
    return Config.model_validate({"robot": {"name": "gantry"}, "control": control})


def test_a_controller_that_moves_the_robot_is_planned() -> None:
    registry = fake_registry(FAKE_ROBOT, FAKE_CONTROLLER)
    plan = plan_control(config(controller="gantry"), registry)
    assert (plan.kind, plan.robot, plan.spec) == ("control", FAKE_ROBOT, FAKE_CONTROLLER)
    assert (dict(plan.names), plan.inputs) == ({"controller": "gantry"}, ("robot",))


def test_a_controller_of_other_robots_is_refused() -> None:
    registry = fake_registry(FAKE_ROBOT, replace(FAKE_CONTROLLER, robot_kinds=("base",)))
    with pytest.raises(PlanningError, match="gantry"):
        plan_control(config(controller="gantry"), registry)

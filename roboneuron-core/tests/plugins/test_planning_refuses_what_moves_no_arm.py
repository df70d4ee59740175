"""A robot, its driver and its controller are resolved and checked without importing any target;
features plan their own parts.
"""

from __future__ import annotations

import sys

import pytest

from roboneuron.config import Config
from roboneuron.errors import ConfigurationError, InvalidInputError, PlanningError
from roboneuron.planning import KIND_ENTRIES, Plan
from roboneuron.plugins.registry import Offer, Registry, Status
from roboneuron.plugins.specs import (
    ControllerSpec,
    DriverSpec,
    FeatureSpec,
    Requirement,
    RobotSpec,
    Spec,
)

TARGET = "never_imported_module:Thing"
ABSENT = Requirement(module="absent_x", install="pip install x")
DRIVERS = (
    DriverSpec(name="simulated", summary="S.", target=TARGET),
    DriverSpec(name="hardware", summary="H.", target=TARGET, requires=(ABSENT,)),
)
ARM = RobotSpec(name="arm", summary="A.", target=TARGET, drivers=DRIVERS)
ROVER = RobotSpec(
    name="rover", summary="R.", target=TARGET, drivers=DRIVERS, robot_kind="base", action_widths=()
)
IK = ControllerSpec(name="ik", summary="I.", target=TARGET)
DRIVE = ControllerSpec(name="drive", summary="D.", target=TARGET, robot_kinds=("base",))
CONTROL = FeatureSpec(
    name="control",
    summary="C.",
    target=TARGET,
    module=TARGET,
    module_plan="roboneuron.modules.control.planning:plan_control",
)
FEATURE = FeatureSpec(
    name="inference",
    summary="F.",
    target=TARGET,
    module=TARGET,
    module_plan=f"{__name__}:plan_of_a_feature",
)


def plan_of_a_feature(config: Config, registry: Registry) -> Plan:
    raise PlanningError(f"{config.inference.backend} was planned by its feature.")


def _registry(*specs: Spec, status: Status = Status.READY) -> Registry:
    offers = [
        Offer(
            spec=spec,
            plugin="rn-test",
            distribution="rn-test",
            status=Status.READY if isinstance(spec, RobotSpec | FeatureSpec) else status,
            reason="Needs 'absent_x'.",
        )
        for spec in specs
    ]
    return Registry(plugins=(), all_offers=tuple(offers))


REGISTRY = _registry(ARM, ROVER, IK, DRIVE, CONTROL)


def _plan(kind: str = "control", registry: Registry = REGISTRY, **sections: dict[str, str]) -> Plan:
    tables = {"robot": {"name": "arm"}, "control": {"controller": "ik"}, **sections}
    return KIND_ENTRIES[kind].plan(Config.model_validate(tables), registry)


def test_a_fitting_combination_is_resolved():
    plan = _plan()
    assert (plan.robot, plan.driver, plan.spec, plan.inputs) == (ARM, DRIVERS[0], IK, ("robot",))
    assert plan.plugin == "ik"
    rover = _plan(robot={"name": "rover"}, control={"controller": "drive"})
    assert (rover.robot, rover.spec) == (ROVER, DRIVE)
    assert "never_imported_module" not in sys.modules


def test_a_robot_alone_is_a_plan():
    plan = _plan("robot")
    assert (plan.robot, plan.spec, plan.inputs) == (ARM, DRIVERS[0], ())
    assert dict(plan.names) == {"robot": "arm", "driver": "simulated"}


def test_what_runs_under_another_interpreter_may_lack_its_modules_here():
    lacking = _registry(ARM, IK, CONTROL, status=Status.UNAVAILABLE)
    robot = {"name": "arm", "driver": "hardware", "python": "/x"}
    control = {"controller": "ik", "python": "/x"}
    assert _plan(registry=lacking, robot=robot, control=control).spec is IK
    del robot["python"]
    with pytest.raises(
        PlanningError, match=r"'hardware' of robot 'arm' cannot be used: .*absent_x"
    ):
        _plan(registry=lacking, robot=robot, control=control)
    del control["python"]
    with pytest.raises(ConfigurationError, match="cannot be used"):
        _plan(registry=lacking, control=control)


REFUSALS = {
    "unknown driver": (
        {"robot": {"name": "arm", "driver": "simulate"}},
        "no driver 'simulate'; choose one of: simulated, hardware",
    ),
    "driver lacks a module": (
        {"robot": {"name": "arm", "driver": "hardware"}},
        "'hardware' of robot 'arm' cannot be used: .*pip install x",
    ),
    "controller of another kind": (
        {"control": {"controller": "drive"}},
        "moves robots of kind base, but 'arm' is of kind 'arm'",
    ),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_an_unfit_combination_is_refused_in_one_sentence(case):
    sections, words = REFUSALS[case]
    with pytest.raises(PlanningError, match=words) as caught:
        _plan(**sections)
    assert "\n" not in str(caught.value)
    assert "never_imported_module" not in sys.modules


@pytest.mark.parametrize(
    ("kind", "sections"),
    [
        ("robot", {"robot": {"name": "nothing-like-it"}}),
        ("controller", {"control": {"controller": "nothing-like-it"}}),
    ],
)
def test_an_unknown_name_of_any_kind_is_a_configuration_error(kind, sections):
    with pytest.raises(ConfigurationError, match=f"There is no {kind} 'nothing-like-it'"):
        _plan(**sections)


def test_the_feature_that_brings_a_module_plans_it():
    inference = {"backend": "policy"}
    with pytest.raises(PlanningError, match="policy was planned by its feature"):
        _plan("inference", _registry(ARM, FEATURE), inference=inference)
    with pytest.raises(ConfigurationError, match="There is no feature 'inference'"):
        _plan("inference", inference=inference)
    with pytest.raises(InvalidInputError, match="The configuration names no backend"):
        _plan("inference", _registry(ARM, FEATURE))

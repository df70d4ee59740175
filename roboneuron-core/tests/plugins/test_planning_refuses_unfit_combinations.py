"""Planning resolves names to descriptors, or refuses in one sentence, without importing any
target.
"""

from __future__ import annotations

import sys

import pytest

from roboneuron.errors import ConfigurationError, PlanningError
from roboneuron.planning import check_plan
from roboneuron.plugins.registry import Offer, Registry, Status
from roboneuron.plugins.specs import (
    AccelerationSpec,
    ActionSpace,
    BackendSpec,
    CameraSpec,
    ControllerSpec,
    DriverSpec,
    PerceptionSpec,
    Requirement,
    RobotSpec,
    RuntimeSpec,
    Spec,
)

TARGET = "never_imported_module:Thing"
ABSENT = Requirement(module="absent_x", install="pip install x")


def _named(kind: type[Spec], name: str, **more: object) -> Spec:
    return kind(name=name, summary=f"{name}.", target=TARGET, **more)


SPECS = (
    _named(
        RobotSpec,
        "arm",
        drivers=(
            DriverSpec(name="simulated", summary="S.", target=TARGET),
            DriverSpec(name="hardware", summary="H.", target=TARGET, requires=(ABSENT,)),
        ),
        cameras=(CameraSpec(name="front", role="primary"), CameraSpec(name="hand", role="wrist")),
    ),
    _named(
        RobotSpec,
        "rover",
        robot_kind="base",
        drivers=(DriverSpec(name="simulated", summary="S.", target=TARGET),),
        action_widths=(),
    ),
    _named(BackendSpec, "plain"),
    _named(BackendSpec, "blind", cameras=()),
    _named(BackendSpec, "wristed", cameras=("primary", "wrist"), optional_cameras=("overhead",)),
    _named(BackendSpec, "three-eyed", cameras=("primary", "left", "right")),
    _named(BackendSpec, "two-armed", action_space=ActionSpace(width=14)),
    _named(BackendSpec, "vla", family="openvla", runtimes_required=True),
    _named(BackendSpec, "vla-default", family="openvla", default_runtime="local"),
    _named(BackendSpec, "vla-lost", family="openvla", default_runtime="not-installed"),
    _named(BackendSpec, "vla-inside", family="openvla", capabilities=("pruning",)),
    _named(BackendSpec, "flow", family="pi0"),
    _named(RuntimeSpec, "local", families=("openvla",), capabilities=("pruning",)),
    _named(RuntimeSpec, "remote", families=("openvla",), served=True),
    _named(RuntimeSpec, "flow-engine", families=("pi0",)),
    _named(AccelerationSpec, "prune", families=("openvla",), capability="pruning"),
    _named(AccelerationSpec, "quantise", families=("openvla",)),
    _named(PerceptionSpec, "camera"),
    _named(PerceptionSpec, "sim-camera", drivers=("simulated",)),
    _named(PerceptionSpec, "rover-camera", robots=("rover",)),
    _named(PerceptionSpec, "real-camera", drivers=("hardware",)),
    _named(ControllerSpec, "ik"),
    _named(ControllerSpec, "drive", robot_kinds=("base",)),
)
REGISTRY = Registry(
    plugins=(),
    all_offers=tuple(
        Offer(spec=s, plugin="rn-test", distribution="rn-test", status=Status.READY) for s in SPECS
    ),
)


def _plan(**names: object):
    return check_plan(REGISTRY, **{"robot": "arm", "driver": "simulated", **names})


def test_a_fitting_combination_is_resolved():
    plan = _plan(
        perception="sim-camera",
        controller="ik",
        backend="vla",
        runtime="local",
        acceleration="prune",
    )
    names = [plan.robot.name, plan.driver.name, plan.perception.name, plan.controller.name]
    names += [plan.backend.name, plan.runtime.name, plan.acceleration.name]
    assert names == ["arm", "simulated", "sim-camera", "ik", "vla", "local", "prune"]
    assert plan.cameras == {"primary": "front"}
    assert "never_imported_module" not in sys.modules


def test_the_default_runtime_is_taken_when_none_is_named():
    assert _plan(backend="vla-default").runtime.name == "local"
    assert _plan(backend="vla-default", runtime="remote").runtime.name == "remote"


def test_a_backend_without_family_runs_without_runtime():
    assert _plan(backend="plain").runtime is None


def test_roles_follow_the_robot_and_yield_to_the_caller():
    assert _plan(backend="wristed").cameras == {"primary": "front", "wrist": "hand"}
    assert _plan(backend="wristed", cameras={"primary": "hand"}).cameras == {
        "primary": "hand",
        "wrist": "hand",
    }
    assert _plan(backend="wristed", cameras={"overhead": "front"}).cameras["overhead"] == "front"


def test_an_acceleration_may_rest_on_the_backend_itself():
    assert _plan(backend="vla-inside", acceleration="prune").acceleration.name == "prune"


def test_a_robot_alone_is_a_plan():
    plan = check_plan(REGISTRY, robot="rover", driver="simulated", controller="drive")
    assert (plan.robot.name, plan.backend, dict(plan.cameras)) == ("rover", None, {})


LACKING = Registry(
    plugins=(),
    all_offers=tuple(
        Offer(
            spec=s,
            plugin="rn-test",
            distribution="rn-test",
            status=Status.UNAVAILABLE,
            reason="Needs 'absent_x'.",
        )
        if not isinstance(s, RobotSpec)
        else Offer(spec=s, plugin="rn-test", distribution="rn-test", status=Status.READY)
        for s in SPECS
    ),
)
ELSEWHERE = {
    "driver": {"driver": "hardware"},
    "perception": {"perception": "camera"},
    "controller": {"controller": "ik"},
    "backend": {"backend": "vla", "runtime": "local", "acceleration": "prune"},
}


@pytest.mark.parametrize("part", ELSEWHERE)
def test_what_runs_under_another_interpreter_may_lack_its_modules_here(part):
    names = {"robot": "arm", "driver": "simulated", **ELSEWHERE[part]}
    plan = check_plan(LACKING, **names, elsewhere=(part,))
    assert {name: getattr(plan, name).name for name in ELSEWHERE[part]} == ELSEWHERE[part]
    others = set(ELSEWHERE) - {part}
    with pytest.raises((PlanningError, ConfigurationError), match="cannot be used"):
        check_plan(LACKING, **names, elsewhere=others)


REFUSALS = {
    "unknown driver": (
        {"driver": "simulate"},
        "no driver 'simulate'; choose one of: simulated, hardware",
    ),
    "driver lacks a module": (
        {"driver": "hardware"},
        "'hardware' of robot 'arm' cannot be used: .*pip install x",
    ),
    "missing roles": (
        {"backend": "three-eyed"},
        r"needs a camera of role left, right, but robot 'arm' has: front \(role primary\), hand "
        r"\(role wrist\)",
    ),
    "unknown camera": (
        {"backend": "plain", "cameras": {"primary": "top"}},
        "Camera 'top' for role 'primary' is unknown; robot 'arm' has: front, hand",
    ),
    "unused role": (
        {"backend": "plain", "cameras": {"wrist": "hand"}},
        "uses no camera role 'wrist'",
    ),
    "width": ({"backend": "two-armed"}, "actions of width 14, but robot 'arm' executes widths 7"),
    "no actions at all": (
        {"robot": "rover", "backend": "blind"},
        "'rover' executes no model actions",
    ),
    "runtime for none": (
        {"backend": "plain", "runtime": "local"},
        "'plain' takes no runtime, but 'local' was asked",
    ),
    "runtime family": (
        {"backend": "flow", "runtime": "local"},
        "executes the families openvla, but backend 'flow' is of family 'pi0'; installed ones "
        "that fit: flow-engine",
    ),
    "runtime required": (
        {"backend": "vla"},
        "needs a runtime for the family 'openvla'.*fit: local, remote",
    ),
    "runtime without backend": ({"runtime": "local"}, "runtime 'local' has nothing to execute"),
    "acceleration without backend": (
        {"acceleration": "prune"},
        "acceleration 'prune' has nothing to execute",
    ),
    "acceleration family": (
        {"backend": "flow", "acceleration": "quantise"},
        "'quantise' knows the families openvla, but backend 'flow' is of family 'pi0'",
    ),
    "acceleration without runtime": (
        {"backend": "vla-inside", "acceleration": "quantise"},
        "'quantise' needs a runtime .*'vla-inside' was to run without one.*fit: local, remote",
    ),
    "acceleration for none": ({"backend": "plain", "acceleration": "prune"}, "is of family 'none'"),
    "served runtime that cannot": (
        {"backend": "vla", "runtime": "remote", "acceleration": "prune"},
        "'remote' runs the model in another process and offers none; installed ones that fit: "
        "local",
    ),
    "source of another robot": (
        {"perception": "rover-camera"},
        "serves only the robots rover, not 'arm'",
    ),
    "source of another driver": (
        {"perception": "real-camera"},
        "works only with the drivers hardware, not with 'simulated' of robot 'arm'",
    ),
    "controller of another kind": (
        {"controller": "drive"},
        "moves robots of kind base, but 'arm' is of kind 'arm'",
    ),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_an_unfit_combination_is_refused_in_one_sentence(case):
    names, words = REFUSALS[case]
    with pytest.raises(PlanningError, match=words) as caught:
        _plan(**names)
    assert "\n" not in str(caught.value)
    assert "never_imported_module" not in sys.modules


@pytest.mark.parametrize(
    "kind", ["robot", "perception", "controller", "backend", "runtime", "acceleration"]
)
def test_an_unknown_name_of_any_kind_is_a_configuration_error(kind):
    names = {"backend": "vla", "runtime": "local"} if kind != "robot" else {}
    with pytest.raises(ConfigurationError, match=f"There is no {kind} 'nothing-like-it'"):
        _plan(**{**names, kind: "nothing-like-it"})


def test_a_default_runtime_that_is_not_installed_is_no_silent_fallback():
    with pytest.raises(ConfigurationError, match="no runtime 'not-installed'"):
        _plan(backend="vla-lost")

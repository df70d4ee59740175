"""Planning resolves names to descriptors, or refuses in one sentence, without importing any
target.
"""

from __future__ import annotations

import sys

import pytest

from roboneuron.config import Config
from roboneuron.errors import CheckpointError, ConfigurationError, InvalidInputError, PlanningError
from roboneuron.modules.inference.planning import ResolvedPolicy, plan_inference
from roboneuron.modules.perception.planning import plan_perception
from roboneuron.plugins.registry import Offer, Registry, Status
from roboneuron.plugins.specs import (
    AccelerationSpec,
    ActionSpace,
    BackendSpec,
    CameraSpec,
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
    _named(BackendSpec, "stated", needs_state=True),
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
)
REGISTRY = Registry(
    plugins=(),
    all_offers=tuple(
        Offer(spec=s, plugin="rn-test", distribution="rn-test", status=Status.READY) for s in SPECS
    ),
)


def _plan(registry: Registry = REGISTRY, **names: object):
    return ResolvedPolicy.of(registry, **{"robot": "arm", "driver": "simulated", **names})


def _perception(registry: Registry = REGISTRY, **section: object):
    tables = {"robot": {"name": "arm"}, "perception": {"source": "camera", **section}}
    return plan_perception(Config.model_validate(tables), registry)


def test_a_fitting_combination_is_resolved():
    plan = _plan(backend="vla", runtime="local", acceleration="prune")
    names = [plan.robot.name, plan.driver.name]
    names += [plan.backend.name, plan.runtime.name, plan.acceleration.name]
    assert names == ["arm", "simulated", "vla", "local", "prune"]
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


def test_a_source_is_resolved_with_the_cameras_that_it_serves():
    assert dict(_perception().names) == {"source": "camera", "cameras": "front, hand"}
    assert _perception(cameras=["hand"]).names["cameras"] == "hand"
    assert _perception().inputs == ()
    assert _perception(source="sim-camera").inputs == ("robot",)


def _inference(**section: object):
    tables = {"robot": {"name": "arm"}, "inference": section}
    return plan_inference(Config.model_validate(tables), REGISTRY)


def test_a_fallback_is_planned_beside_its_policy():
    plan = _inference(backend="wristed", fallback="stated", cameras={"primary": "hand"})
    assert plan.fallback is not None
    assert plan.fallback.backend.name == plan.names["fallback"] == "stated"
    assert plan.fallback.cameras == {"primary": "hand"}, "as the policy that it stands in for"
    assert plan.inputs == ("robot", "perception", "control"), "one of both needs the state"
    assert _inference(backend="wristed").fallback is None
    assert "fallback" not in _inference(backend="wristed").names


def test_a_fallback_gets_only_camera_roles_that_it_knows():
    plan = _inference(backend="wristed", fallback="plain", cameras={"wrist": "hand"})
    assert plan.fallback is not None
    assert plan.fallback.cameras == {"primary": "front"}


@pytest.mark.parametrize(
    ("fallback", "error", "said"),
    [
        ("wristed", PlanningError, "The fallback is 'wristed' itself"),
        ("three-eyed", PlanningError, "Backend 'three-eyed' needs a camera of role left, right"),
        ("two-armed", PlanningError, "Backend 'two-armed' yields actions of width 14"),
        ("vla", PlanningError, "Backend 'vla' needs a runtime"),
        ("nobody", ConfigurationError, "'nobody'"),
    ],
)
def test_a_fallback_that_does_not_fit_is_refused(fallback: str, error: type[Exception], said: str):
    with pytest.raises(error, match=said):
        _inference(backend="wristed", fallback=fallback)


def test_a_source_serves_the_cameras_of_the_fallback_too():
    plan = _inference(backend="plain", fallback="wristed")
    running = Config.model_validate(
        {"robot": {"name": "arm"}, "perception": {"source": "camera", "cameras": ["front"]}}
    )
    with pytest.raises(InvalidInputError, match="Backend 'wristed' needs the camera hand"):
        plan.check_beside({"perception": running})


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


def test_what_runs_under_another_interpreter_may_lack_its_modules_here():
    parts = {"backend": "vla", "runtime": "local", "acceleration": "prune"}
    plan = _plan(LACKING, **parts, is_elsewhere=True)
    assert {name: getattr(plan, name).name for name in parts} == parts
    with pytest.raises(ConfigurationError, match="cannot be used"):
        _plan(LACKING, **parts)
    with pytest.raises(PlanningError, match="cannot be used"):
        _plan(LACKING, **parts, driver="hardware", is_elsewhere=True)
    assert _plan(LACKING, **parts, driver="hardware", is_elsewhere=True, is_driver_elsewhere=True)
    assert _perception(LACKING, python="/x").spec.name == "camera"
    with pytest.raises(ConfigurationError, match="cannot be used"):
        _perception(LACKING)


REFUSALS = {
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
}


@pytest.mark.parametrize("case", REFUSALS)
def test_an_unfit_combination_is_refused_in_one_sentence(case):
    names, words = REFUSALS[case]
    with pytest.raises(PlanningError, match=words) as caught:
        _plan(**names)
    assert "\n" not in str(caught.value)
    assert "never_imported_module" not in sys.modules


SOURCES = {
    "source of another robot": (
        {"source": "rover-camera"},
        "serves only the robots rover, not 'arm'",
    ),
    "source of another driver": (
        {"source": "real-camera"},
        "works only with the drivers hardware, not with 'simulated' of robot 'arm'",
    ),
}


@pytest.mark.parametrize("case", SOURCES)
def test_a_source_that_does_not_fit_is_refused_in_one_sentence(case):
    section, words = SOURCES[case]
    with pytest.raises(PlanningError, match=words):
        _perception(**section)


def test_a_camera_that_the_robot_lacks_is_refused():
    with pytest.raises(InvalidInputError, match="'arm' has no camera 'top'") as caught:
        _perception(cameras=["top"])
    assert "front, hand" in caught.value.hint


@pytest.mark.parametrize("kind", ["robot", "backend", "runtime", "acceleration"])
def test_an_unknown_name_of_any_kind_is_a_configuration_error(kind):
    names = {"backend": "vla", "runtime": "local"}
    with pytest.raises(ConfigurationError, match=f"There is no {kind} 'nothing-like-it'"):
        _plan(**{**names, kind: "nothing-like-it"})


def test_an_unknown_source_is_a_configuration_error():
    with pytest.raises(ConfigurationError, match="There is no perception 'nothing-like-it'"):
        _perception(source="nothing-like-it")


def test_a_default_runtime_that_is_not_installed_is_no_silent_fallback():
    with pytest.raises(ConfigurationError, match="no runtime 'not-installed'"):
        _plan(backend="vla-lost")


def test_a_checkpoint_is_given_more_time_to_load(tmp_path):
    def timeout_s(**section: object) -> float:
        tables = {"robot": {"name": "arm"}, "inference": {"backend": "trained", **section}}
        plan = plan_inference(Config.model_validate(tables), registry).checked(registry)
        assert plan.names["checkpoint"] == plan.config.inference.checkpoint == str(tmp_path)
        return plan.config.start_timeout_s("inference")

    trained = Offer(
        spec=_named(BackendSpec, "trained", needs_checkpoint=True),
        plugin="rn-test",
        distribution="rn-test",
        status=Status.READY,
    )
    registry = Registry(plugins=(), all_offers=(*REGISTRY.all_offers, trained))
    assert timeout_s(checkpoint=str(tmp_path)) == 900.0
    assert timeout_s(checkpoint=str(tmp_path), start_timeout_s=30.0) == 30.0
    with pytest.raises(InvalidInputError, match="'trained' needs a checkpoint"):
        timeout_s()
    with pytest.raises(CheckpointError, match="does not exist"):
        timeout_s(checkpoint=str(tmp_path / "absent"))

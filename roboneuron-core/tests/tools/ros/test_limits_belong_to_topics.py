"""A second name of a topic brings no other limits, and some topics have no name for agents at
all.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from rn_testing.fakes import fake_registry
from roboneuron.config import feature_options, parse_config
from roboneuron.contract import Endpoint
from roboneuron.direct_path.exposed import allowed_endpoint
from roboneuron.direct_path.feature import direct_path
from roboneuron.direct_path.gate import Gate
from roboneuron.direct_path.plugin import FEATURE as DIRECT_PATH
from roboneuron.errors import ConfigurationError, RefusedError
from roboneuron.estop import EmergencyStopLatch
from roboneuron.feature import ExposedEndpoint, GateRequest
from roboneuron.gate import AuditLog
from roboneuron.modules.plugin import load_profile
from roboneuron.server.app import Application
from roboneuron.tools.ros.exposing import Admin
from roboneuron.tools.ros.exposure import Exposure, exposure
from roboneuron.tools.ros.options import ExposeConfig, RosToolsOptions
from roboneuron.tools.ros.plugin import FEATURE

ROVER = """
[robot]
name = "rover"
[direct]
expose_without_token = true
[[expose]]
name = "velocity"
kind = "publish"
topic = "cmd_vel"
type = "geometry_msgs/msg/Twist"
bounds = { "linear.x" = [-0.5, 0.5] }
rate_hz = 10
stop_message = "zero"
"""
ADMIN = Admin(who="chief", role="admin", tool="expose_endpoint", arguments={})
ALIAS = {
    "name": "fast",
    "kind": "publish",
    "topic": "/rover/cmd_vel",
    "type": "geometry_msgs/msg/Twist",
}


def exposed(text: str, *added: ExposeConfig) -> Exposure:
    registry = fake_registry(DIRECT_PATH, FEATURE)
    config = parse_config(text)
    options = feature_options(FEATURE, config)
    assert isinstance(options, RosToolsOptions)
    return exposure(config, options, registry, added)


def made(text: str, *added: dict[str, Any]) -> dict[str, ExposedEndpoint]:
    entries = [ExposeConfig.model_validate(entry) for entry in added]
    return {e.label: e for e in exposed(text, *entries).endpoints}


def refused(text: str, *added: dict[str, Any]) -> str:
    with pytest.raises(ConfigurationError) as error:
        made(text, *added)
    return str(error.value)


def test_a_second_name_has_the_limits_of_the_first() -> None:
    for endpoints in (
        made(ROVER, ALIAS),
        made(ROVER, {**ALIAS, "stop_message": "", "topic": "cmd_vel"}),
    ):
        fast = endpoints["fast"].endpoint
        assert (fast.bounds, fast.rate_hz, fast.stop_message) == (
            {"linear.x": (-0.5, 0.5)},
            10.0,
            "zero",
        )


def test_a_second_name_cannot_ask_for_more() -> None:
    assert "can only be tightened" in refused(
        ROVER, {**ALIAS, "bounds": {"linear.x": [-100.0, 100.0]}}
    )
    assert "above the robot's 10" in refused(ROVER, {**ALIAS, "rate_hz": 100.0})


def test_what_the_second_name_tightens_holds_for_the_first() -> None:
    endpoints = made(ROVER, {**ALIAS, "bounds": {"linear.x": [-0.1, 0.2], "angular.z": [0.0, 0.0]}})
    assert endpoints["velocity"].endpoint.bounds == {
        "linear.x": (-0.1, 0.2),
        "angular.z": (0.0, 0.0),
    }


def test_the_limits_stay_when_the_first_name_moves_to_another_topic() -> None:
    moved = {"name": "velocity", "kind": "publish", "topic": "elsewhere"}
    assert made(ROVER, moved, ALIAS)["fast"].endpoint.bounds == {"linear.x": (-0.5, 0.5)}


def test_the_limits_of_a_profile_hold_though_it_is_not_exposed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    drive = Endpoint(
        name="drive",
        kind="publish",
        topic="cmd_vel",
        type="geometry_msgs/msg/Twist",
        summary="Drive.",
        bounds={"linear.x": (-0.5, 0.5)},
        rate_hz=5.0,
        min_turning_radius_m=0.4,
        stop_message="zero",
    )
    profile = replace(load_profile(fake_registry(), "gantry"), endpoints=(drive,))
    monkeypatch.setattr(
        "roboneuron.tools.ros.exposure.load_profile", lambda registry, name: profile
    )
    config = '[robot]\nname = "gantry"\n[direct]\nprofile = false\n'
    mine = made(config, {**ALIAS, "topic": "/gantry/cmd_vel"})["fast"].endpoint
    assert mine == replace(drive, name="fast", topic="/gantry/cmd_vel", summary="")


def test_run_time_neither_frees_a_topic_of_the_policy_nor_lets_it_hold_nan() -> None:
    freed = made(ROVER, {**ALIAS, "moves": False, "nonfinite": ["angular.z"]})["fast"]
    assert (freed.moves, freed.nonfinite) == (True, frozenset())
    again = made(ROVER, {"name": "velocity", "moves": False, "nonfinite": ["angular.z"]})[
        "velocity"
    ]
    assert (again.moves, again.nonfinite) == (True, frozenset())


def test_limits_of_a_pattern_hold_for_names_of_run_time() -> None:
    pattern = (
        '[[discover]]\npattern = "/rover/*"\nkinds = '
        '["publish"]\n[discover.limits."geometry_msgs/msg/Twist"]\n'
    )
    text = '[robot]\nname = "rover"\n' + pattern + '"linear.x" = [-0.5, 0.5]\n"*" = [0.0, 0.0]\n'
    bounds = made(text, {**ALIAS, "topic": "arm_vel"})["fast"].endpoint.bounds
    assert (bounds["linear.x"], bounds["angular.z"]) == ((-0.5, 0.5), (0.0, 0.0))


def test_another_robot_is_no_way_to_a_topic() -> None:
    assert "is of the robot 'rover'" in refused(ROVER, {**ALIAS, "robot": "second"})
    assert "another robot has it" in refused(
        ROVER, {**ALIAS, "robot": "second", "namespace": "rover"}
    )
    node = {
        "name": "n",
        "kind": "parameters",
        "topic": "/rover/base",
        "parameters": ["a"],
        "robot": "second",
    }
    assert "is of the robot 'rover'" in refused(ROVER, node)


@pytest.mark.parametrize(
    "topic", ["action", "/rover/action", "emergency_stop", "/x/emergency_stop", "joint_states"]
)
def test_topics_of_the_control_plane_are_refused(topic: str) -> None:
    entry = {
        "name": "x",
        "kind": "publish",
        "topic": topic,
        "type": "std_msgs/msg/Float64MultiArray",
    }
    assert "RoboNeuron alone" in refused(ROVER, entry)
    assert "x" in made(ROVER, {**entry, "kind": "read"})


def test_the_simulators_truth_is_exposed_only_where_it_is_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    entry = {"name": "x", "kind": "read", "topic": "sim/state", "type": "std_msgs/msg/Float64"}
    assert "not for agents" in refused(ROVER, entry)
    assert "not for agents" in refused(ROVER, {**entry, "topic": "/rover/sim/handed_over"})
    monkeypatch.setenv("ROBONEURON_SIMULATOR_TRUTH", "on")
    assert "x" in made(ROVER, entry)


def test_services_of_nodes_and_parameters_of_modules_are_refused() -> None:
    state = {
        "name": "x",
        "kind": "service",
        "topic": "control/change_state",
        "type": "lifecycle_msgs/srv/ChangeState",
    }
    assert "lifecycle service" in refused(ROVER, state)
    setting = {
        "kind": "service",
        "topic": "/n/set_parameters",
        "type": "rcl_interfaces/srv/SetParameters",
    }
    assert "lifecycle service" in refused(ROVER, {"name": "x", **setting})
    module = {
        "name": "n",
        "kind": "parameters",
        "topic": "control_b",
        "parameters": ["use_sim_time"],
    }
    assert "a module of RoboNeuron" in refused(ROVER, module)


def test_two_names_share_one_rate(tmp_path: Any) -> None:
    from geometry_msgs.msg import Twist

    latch = EmergencyStopLatch(tmp_path / "latch", lambda: 1)
    gate = Gate((), latch=latch, audit=AuditLog(tmp_path / "audit", lambda: 1), clock=lambda: 0.0)
    gate.replace(allowed_endpoint(e) for e in made(ROVER, ALIAS).values())
    request = GateRequest(
        who="a", role="operator", tool="t", robot="rover", endpoint="velocity", messages=(Twist(),)
    )
    for _ in range(5):
        gate.check(request)
        gate.check(replace(request, endpoint="fast"))
    with pytest.raises(RefusedError, match="Too many messages"):
        gate.check(request)


def test_a_withdrawn_topic_does_not_come_back_through_a_pattern(
    make_application: Callable[..., Application],
) -> None:
    application = make_application(ROVER)
    path = application.features.loaded.get(FEATURE.name)
    path.unexpose(None, "velocity", None, ADMIN)
    found = made('[robot]\nname = "rover"\n' + ROVER.split("expose_without_token = true")[1])[
        "velocity"
    ]
    path._on_discovered((replace(found, label="cmd_vel"),))
    assert not direct_path(application.host).judge.allowed()


def test_parameters_are_exposed_by_name() -> None:
    node = '[[expose]]\nname = "n"\nkind = "parameters"\ntopic = "base"\n'
    with pytest.raises(ConfigurationError, match="names no parameter"):
        exposed(ROVER + node)
    with pytest.raises(ConfigurationError, match="no name of a parameter"):
        exposed(ROVER + node + 'parameters = ["gain\\u0000"]\n')
    both = (
        node
        + "bounds = { gain = [0, 10] }\n"
        + node.replace('"n"', '"m"')
        + "bounds = { gain = [5, 20] }\n"
    )
    found = exposed(ROVER + both).nodes
    assert [n.bounds for n in found] == [{"gain": (5.0, 10.0)}] * 2

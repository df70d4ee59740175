"""An endpoint is exposed only with a name, kind, topic, type, rate and bounds that can be."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from roboneuron.contract import Endpoint
from roboneuron.direct_path.fields import filled, load_type
from roboneuron.direct_path.gate import Gate
from roboneuron.direct_path.limits import check_endpoint, check_type, sent_type
from roboneuron.errors import ConfigurationError, RefusedError
from roboneuron.feature import GateRequest

ACTION = Endpoint(
    name="go", kind="action", topic="go", type="test_msgs/action/Fibonacci", summary="go"
)


@pytest.mark.parametrize(
    "changes",
    [
        *({"name": "a"}, {"name": "a" * 60}, {"name": "a_1"}),
        *({"topic": "a" * 200}, {"topic": "/a/b_1/c"}, {"topic": "A"}),
        *({"rate_hz": 0.0}, {"rate_hz": 0.5}, {"bounds": {}}),
        *({"bounds": {"linear.x": (0.5, 0.5)}}, {"bounds": {"linear.x": (-math.inf, 0.25)}}),
    ],
)
def test_what_can_be_exposed_passes(endpoints: dict[str, Endpoint], changes: Any) -> None:
    check_endpoint(replace(endpoints["velocity"], **changes))


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"name": "a" * 61}, "the name must be"),
        ({"name": "1a"}, "the name must be"),
        ({"name": "a\n"}, "the name must be"),
        ({"kind": "execute"}, "kind 'execute' is none of read, publish, service, action"),
        ({"topic": "a" * 201}, "is not a topic name"),
        ({"topic": "a\n"}, "is not a topic name"),
        ({"rate_hz": -0.5}, "rate_hz = -0.5 must be 0 or more"),
        ({"rate_hz": math.inf}, "rate_hz = inf must be 0 or more"),
        ({"bounds": {"angular.q": (0, 1)}}, r"has no number 'angular\.q'"),
        ({"bounds": {"linear.x": (0.5, 0.4)}}, r"the bounds of linear\.x are \[0\.5, 0\.4\]"),
        ({"bounds": {"linear.x": (math.nan, 0.4)}}, r"the bounds of linear\.x are \[nan, 0\.4\]"),
    ],
)
def test_what_cannot_be_exposed_is_refused_with_what_is_wrong(
    endpoints: dict[str, Endpoint], changes: Any, text: str
) -> None:
    with pytest.raises(ConfigurationError, match=rf"^Endpoint '.*': .*{text}"):
        check_endpoint(replace(endpoints["velocity"], **changes))


def test_the_hint_of_a_bound_names_the_numbers_that_there_are(
    endpoints: dict[str, Endpoint],
) -> None:
    with pytest.raises(ConfigurationError) as caught:
        check_endpoint(replace(endpoints["velocity"], bounds={"linear": (0, 1)}))
    assert "angular.x, angular.y, angular.z, linear.x" in caught.value.hint


@pytest.mark.parametrize(
    ("bounds", "is_good"),
    [
        *(((0, 10), True), ((-3, -3), True), ((-math.inf, 10), True), ((0, math.inf), True)),
        *(((0.5, 10), False), ((0, 10.5), False), ((-math.inf, 0.5), False)),
    ],
)
def test_bounds_of_an_integer_are_integers_or_infinite(
    endpoints: dict[str, Endpoint], bounds: tuple[float, float], is_good: bool
) -> None:
    number = replace(endpoints["velocity"], type="std_msgs/msg/Int8", bounds={"data": bounds})
    if is_good:
        check_endpoint(number)
        return
    with pytest.raises(ConfigurationError, match="the bounds of data are"):
        check_endpoint(number)


# What an endpoint is sent


@pytest.mark.parametrize(
    ("kind", "type_name", "part"),
    [
        ("publish", "geometry_msgs/msg/Twist", ""),
        ("read", "geometry_msgs/msg/Twist", ""),
        ("service", "std_srvs/srv/SetBool", "Request"),
        ("action", "test_msgs/action/Fibonacci", "Goal"),
        ("read", "rcl_interfaces/srv/GetParameters", "Request"),
        ("service", "rcl_interfaces/srv/GetParameters", "Request"),
    ],
)
def test_an_endpoint_is_sent_the_part_of_its_type_that_is_sent(
    endpoints: dict[str, Endpoint], kind: str, type_name: str, part: str
) -> None:
    whole = load_type(type_name)
    endpoint = replace(endpoints["velocity"], kind=kind, type=type_name)
    assert sent_type(endpoint) is (getattr(whole, part) if part else whole)


@pytest.mark.parametrize(
    ("kind", "type_name"),
    [
        ("publish", "std_srvs/srv/SetBool"),
        ("publish", "rcl_interfaces/srv/GetParameters"),
        ("publish", "test_msgs/action/Fibonacci"),
        ("read", "std_srvs/srv/SetBool"),
        ("read", "test_msgs/action/Fibonacci"),
        ("service", "geometry_msgs/msg/Twist"),
        ("service", "test_msgs/action/Fibonacci"),
        ("action", "std_srvs/srv/SetBool"),
        ("action", "geometry_msgs/msg/Twist"),
    ],
)
def test_an_endpoint_of_one_kind_has_no_type_of_another(
    endpoints: dict[str, Endpoint], kind: str, type_name: str
) -> None:
    endpoint = replace(endpoints["velocity"], kind=kind, type=type_name)
    with pytest.raises(ConfigurationError, match=f"a {kind} cannot be of {type_name}"):
        sent_type(endpoint)


def test_only_what_is_sent_of_a_type_passes_as_its_message(
    endpoints: dict[str, Endpoint],
) -> None:
    service, action = load_type("std_srvs/srv/SetBool"), load_type(ACTION.type)
    check_type(endpoints["enable"], filled(service.Request, {}))
    check_type(ACTION, filled(action.Goal, {}))
    with pytest.raises(RefusedError, match="which takes std_srvs/srv/SetBool_Request"):
        check_type(endpoints["enable"], filled(service.Response, {}))
    with pytest.raises(RefusedError, match="which takes test_msgs/action/Fibonacci_Goal"):
        check_type(ACTION, filled(action.Result, {}))
    with pytest.raises(RefusedError, match="which takes geometry_msgs/msg/Twist"):
        check_type(endpoints["velocity"], filled(service.Request, {}))


def test_values_at_their_bounds_pass_and_are_not_clamped(
    make_gate: Callable[..., Gate],
    ask: Callable[..., GateRequest],
    endpoints: dict[str, Endpoint],
) -> None:
    gate = make_gate(clamp=frozenset({"linear.x"}))
    for value in (0.5, -0.5):
        verdict = gate.check(ask(endpoints["velocity"], {"linear": {"x": value}}))
        assert (verdict.may_send, verdict.clamped) == (True, ())

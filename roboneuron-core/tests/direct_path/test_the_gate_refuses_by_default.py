"""Each rule of the gate, their order, clamping, dry runs."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from roboneuron.direct_path.fields import filled, load_type
from roboneuron.direct_path.limits import check_endpoint
from roboneuron.errors import ConfigurationError, RefusedError

FORWARD = {"linear": {"x": 0.2}}


def lines(audit) -> list[dict]:
    return [json.loads(line) for line in audit.path.read_text().splitlines()]


def test_what_is_within_all_limits_may_be_sent(make_gate, ask, endpoints, audit) -> None:
    verdict = make_gate().check(ask(endpoints["velocity"], FORWARD))
    assert verdict.may_send
    assert verdict.clamped == ()
    (line,) = lines(audit)
    assert line["verdict"] == "allowed"
    assert line["arguments"] == FORWARD
    assert (line["who"], line["role"], line["endpoint"]) == ("agent-1", "operator", "velocity")


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"endpoint": "weapons"}, "exposed are: enable"),
        ({"robot": "other"}, "robots: arm"),
        ({"endpoint": "../velocity"}, "not exposed"),
    ],
)
def test_only_the_allow_list_is_reachable(make_gate, ask, endpoints, audit, changes, text) -> None:
    with pytest.raises(RefusedError, match=text):
        make_gate().check(ask(endpoints["velocity"], FORWARD, **changes))
    assert lines(audit)[0]["rule"] == "allow_list"


@pytest.mark.parametrize("role", ["viewer", "", "root", "OPERATOR"])
def test_moving_needs_an_operator_and_reading_a_viewer(make_gate, ask, endpoints, role) -> None:
    gate = make_gate()
    for name, value in (("velocity", FORWARD), ("enable", {"data": True})):
        with pytest.raises(RefusedError, match="needs the role 'operator'"):
            gate.check(ask(endpoints[name], value, role=role))
    if role == "viewer":
        assert gate.check(ask(endpoints["scan"], role=role)).may_send


def test_another_message_type_is_refused(make_gate, ask, endpoints) -> None:
    other = filled(load_type("geometry_msgs/msg/Vector3"), {})
    with pytest.raises(RefusedError, match="Vector3 came"):
        make_gate().check(ask(endpoints["velocity"], messages=(other,)))
    with pytest.raises(RefusedError, match="No message"):
        make_gate().check(ask(endpoints["velocity"]))
    assert make_gate().check(ask(endpoints["enable"], {"data": True})).may_send


def test_values_that_are_not_finite_are_refused_at_every_depth(make_gate, ask, endpoints) -> None:
    request = ask(endpoints["pose"], {"poses": [{}, {}]})
    request.messages[0].poses[1].orientation.z = float("inf")
    with pytest.raises(RefusedError, match=r"poses\[1\]\.orientation\.z is not finite"):
        make_gate().check(request)
    request = ask(
        endpoints["trajectory"], {"joint_names": ["j1"], "points": [{"positions": [0.0]}]}
    )
    request.messages[0].points[0].positions[0] = float("nan")
    with pytest.raises(RefusedError, match=r"points\[0\]\.positions\[0\] is not finite"):
        make_gate().check(request)


def test_not_a_number_is_never_clamped_and_passes_only_where_configured(
    make_gate, ask, endpoints
) -> None:
    request = ask(endpoints["velocity"], FORWARD)
    request.messages[0].linear.x = float("nan")
    with pytest.raises(RefusedError, match="not finite"):
        make_gate(clamp=frozenset({"linear.x"})).check(request)
    with pytest.raises(RefusedError, match="allowed is"):
        make_gate(clamp=frozenset({"linear.x"}), nonfinite=frozenset({"linear.x"})).check(request)
    request.messages[0].linear.x, request.messages[0].linear.z = 0.0, float("nan")
    assert make_gate(nonfinite=frozenset({"linear.z"})).check(request).may_send


def test_values_out_of_bounds_are_refused_with_the_place(make_gate, ask, endpoints) -> None:
    with pytest.raises(RefusedError, match=r"linear\.x is 0\.6, allowed is -0\.5 \.\. 0\.5"):
        make_gate().check(ask(endpoints["velocity"], {"linear": {"x": 0.6}}))
    with pytest.raises(RefusedError, match=r"poses\[1\]\.position\.x is -1"):
        make_gate().check(ask(endpoints["pose"], {"poses": [{}, {"position": {"x": -1}}]}))


def test_values_are_clamped_only_where_configured_and_the_verdict_says_so(
    make_gate, ask, endpoints, audit
) -> None:
    request = ask(endpoints["velocity"], {"linear": {"x": 9.0}, "angular": {"z": -3}})
    verdict = make_gate(clamp=frozenset({"linear.x", "angular.z"})).check(request)
    assert [(c.path, c.asked, c.sent) for c in verdict.clamped] == [
        ("linear.x", 9.0, 0.5),
        ("angular.z", -3.0, -1.0),
    ]
    assert request.messages[0].linear.x == 0.5
    assert lines(audit)[0]["clamped"] == ["linear.x: 9 -> 0.5", "angular.z: -3 -> -1"]


def test_every_step_of_a_sequence_is_checked(make_gate, ask, endpoints) -> None:
    good, bad = (ask(endpoints["velocity"], {"linear": {"x": x}}).messages[0] for x in (0.1, 0.7))
    assert make_gate().check(ask(endpoints["velocity"], messages=(good, good))).may_send
    with pytest.raises(RefusedError, match=r"0\.7"):
        make_gate().check(ask(endpoints["velocity"], messages=(good, bad)))


def test_a_car_does_not_turn_on_the_spot(make_gate, ask, endpoints) -> None:
    gate = make_gate(replace(endpoints["velocity"], min_turning_radius_m=1.0))
    with pytest.raises(RefusedError, match="cannot turn on the spot"):
        gate.check(ask(endpoints["velocity"], {"angular": {"z": 0.3}}))
    assert gate.check(
        ask(endpoints["velocity"], {"linear": {"x": 0.4}, "angular": {"z": 0.3}})
    ).may_send


def test_too_many_calls_are_refused_and_refusals_do_not_count(
    make_gate, ask, endpoints, clock
) -> None:
    gate = make_gate()
    for _ in range(20):
        with pytest.raises(RefusedError):
            gate.check(ask(endpoints["velocity"], {"linear": {"x": 2.0}}))
    for _ in range(5):
        gate.check(ask(endpoints["velocity"], FORWARD))
    with pytest.raises(RefusedError, match="Too many messages for 'velocity'"):
        gate.check(ask(endpoints["velocity"], FORWARD))
    assert gate.check(ask(endpoints["velocity"], FORWARD, repeated=True)).may_send
    clock.now_s += 1.0
    assert gate.check(ask(endpoints["velocity"], FORWARD)).may_send


def test_what_was_sent_at_once_counts_also_when_the_rest_is_given_back(
    make_gate, ask, endpoints
) -> None:
    gate = make_gate()
    for _ in range(5):
        request = ask(endpoints["velocity"], FORWARD)
        gate.check(request)
        gate.release(request)
    with pytest.raises(RefusedError, match="Too many messages"):
        gate.check(ask(endpoints["velocity"], FORWARD))


def test_a_changed_allow_list_keeps_counting(make_gate, ask, endpoints) -> None:
    gate = make_gate()
    for _ in range(5):
        gate.check(ask(endpoints["velocity"], FORWARD))
    gate.replace(gate.allowed())
    with pytest.raises(RefusedError, match="Too many messages"):
        gate.check(ask(endpoints["velocity"], FORWARD))
    gate.replace(())
    with pytest.raises(RefusedError, match="robots: none"):
        gate.check(ask(endpoints["velocity"], FORWARD))


def test_a_latched_stop_refuses_all_motion_but_no_reading(make_gate, ask, endpoints) -> None:
    gate = make_gate()
    gate.latch.latch(who="viewer-1", reason="smoke", audit=gate.audit)
    for name, value in (("velocity", FORWARD), ("enable", {"data": True})):
        with pytest.raises(RefusedError, match='latched by viewer-1: "smoke"'):
            gate.check(ask(endpoints[name], value))
    with pytest.raises(RefusedError):
        gate.check_running()
    assert gate.check(ask(endpoints["scan"])).may_send
    gate.latch.reset(who="boss", role="admin", audit=gate.audit)
    gate.check_running()
    assert gate.check(ask(endpoints["velocity"], FORWARD)).may_send


def test_a_simulated_request_answers_and_sends_nothing(make_gate, ask, endpoints, audit) -> None:
    gate = make_gate()
    for _ in range(9):
        verdict = gate.check(ask(endpoints["velocity"], FORWARD, simulated=True))
        assert (verdict.allowed, verdict.may_send) == (True, False)
    verdict = gate.check(ask(endpoints["velocity"], {"linear": {"x": 3}}, simulated=True))
    assert (verdict.allowed, verdict.rule) == (False, "bounds")
    assert "linear.x is 3" in verdict.reason
    assert [line["verdict"] for line in lines(audit)] == ["would_allow"] * 9 + ["would_refuse"]
    assert not make_gate(simulated=True).check(ask(endpoints["velocity"], FORWARD)).may_send


@pytest.mark.parametrize(
    "changes",
    [
        {"name": "a b"},
        {"name": ""},
        {"kind": "execute"},
        {"kind": "service"},
        {"topic": "../x"},
        {"topic": "a//b"},
        {"topic": "a b"},
        {"topic": ""},
        {"topic": "x" * 300},
        {"type": "geometry_msgs/Twist"},
        {"type": "geometry_msgs/msg/Twits"},
        {"type": "std_srvs/srv/Empty"},
        {"bounds": {"linear.q": (0, 1)}},
        {"bounds": {"linear": (0, 1)}},
        {"bounds": {"linear.x": (1, 0)}},
        {"rate_hz": -1.0},
        {"rate_hz": float("nan")},
    ],
)
def test_endpoints_that_cannot_be_are_refused_when_configured(endpoints, changes) -> None:
    check_endpoint(endpoints["velocity"])
    with pytest.raises(ConfigurationError):
        check_endpoint(replace(endpoints["velocity"], **changes))


def test_bounds_of_integers_are_integers(endpoints) -> None:
    number = replace(endpoints["velocity"], type="std_msgs/msg/Int8", bounds={"data": (0, 10)})
    check_endpoint(number)
    with pytest.raises(ConfigurationError):
        check_endpoint(replace(number, bounds={"data": (0.5, 10)}))


def test_bounds_reach_into_arrays_of_numbers(make_gate, ask, endpoints) -> None:
    values = replace(
        endpoints["pose"], type="std_msgs/msg/Float64MultiArray", bounds={"data": (-1, 1)}
    )
    request = ask(values, {"data": [0.0, 2.0, -3.0]})
    with pytest.raises(RefusedError, match=r"data\[1\] is 2"):
        make_gate(values).check(request)
    verdict = make_gate(values, clamp=frozenset({"data"})).check(request)
    assert list(request.messages[0].data) == [0.0, 1.0, -1.0]
    assert len(verdict.clamped) == 2
    covariance = replace(
        values, type="geometry_msgs/msg/PoseWithCovariance", bounds={"covariance": (0, 1)}
    )
    request = ask(covariance, {"covariance": [5.0] * 36})
    make_gate(covariance, clamp=frozenset({"covariance"})).check(request)
    assert np.array_equal(request.messages[0].covariance, np.ones(36))

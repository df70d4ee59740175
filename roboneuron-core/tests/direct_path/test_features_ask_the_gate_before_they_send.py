"""What features are given of the gate, what it answers to a question, and services."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import pytest

from roboneuron.contract import Endpoint
from roboneuron.direct_path.fields import load_type
from roboneuron.direct_path.gate import Gate
from roboneuron.direct_path.motion_gate import DirectGate
from roboneuron.errors import RefusedError
from roboneuron.feature import ExposedEndpoint, GateRequest

Ask = Callable[..., GateRequest]
FORWARD = {"linear": {"x": 0.25}}


# What features are given


def test_what_features_are_given_is_the_gates_the_arbiters_and_the_allow_lists(
    bench: Any,
) -> None:
    gate = bench.motion_gate
    assert gate.exposed == ("one",)
    assert gate.max_duration_s == 60.0
    assert gate.check == bench.check
    assert gate.slowdown == bench.gate.slowdown
    assert (gate.check_free, gate.claim, gate.end_motions) == (
        bench.arbiter.check_free,
        bench.arbiter.claim,
        bench.arbiter.end_all,
    )
    assert (gate.newest_joints, gate.joints) == (bench.traffic.newest_joints, bench.traffic.joints)
    assert (gate.is_served, gate.cancel_goal) == (
        bench.traffic.is_served,
        bench.traffic.cancel_goal,
    )


def test_a_gate_without_a_say_permits_everything_and_is_never_still(
    bench: Any, drive: ExposedEndpoint, ask: Ask
) -> None:
    gate = DirectGate(
        bench.gate,
        bench.arbiter,
        bench.traffic,  # type: ignore[arg-type]
        bench.listed,  # type: ignore[arg-type]
        60.0,
    )
    assert gate.publish_now(drive, ask(drive.endpoint, FORWARD)) is not None
    assert gate.publish(drive, ask(drive.endpoint, FORWARD), timeout_s=1.0).messages == 1


# A question


def test_a_question_is_answered_by_the_gate(bench: Any, drive: ExposedEndpoint, ask: Ask) -> None:
    verdict = bench.motion_gate.ask(drive, ask(drive.endpoint, FORWARD, simulated=True))
    assert (verdict.allowed, verdict.simulated, verdict.may_send) == (True, True, False)
    far = ask(drive.endpoint, {"linear": {"x": 9.0}}, simulated=True)
    assert bench.motion_gate.ask(drive, far).rule == "bounds"


def test_a_question_while_a_policy_moves_the_robot_is_answered_no(
    bench: Any, drive: ExposedEndpoint, ask: Ask
) -> None:
    bench.policy = "The policy 'instant' moves 'arm'."
    request = ask(drive.endpoint, FORWARD, simulated=True)
    verdict = bench.motion_gate.ask(drive, request)
    assert (verdict.allowed, verdict.simulated, verdict.rule) == (False, True, "ownership")
    assert verdict.reason.startswith(bench.policy)
    bench.gate.latch.press(who="a person", reason="a test")
    verdict = bench.motion_gate.ask(drive, request)
    assert (verdict.allowed, verdict.rule) == (False, "emergency_stop")


@pytest.mark.parametrize("is_motion", [False, True])
def test_a_simulated_request_sends_nothing_and_tells_who_listens(
    bench: Any, drive: ExposedEndpoint, ask: Ask, is_motion: bool
) -> None:
    request = ask(drive.endpoint, FORWARD, simulated=True)
    bench.writer.listeners = 3
    if is_motion:
        sent = bench.play(drive, request)
    else:
        sent = bench.motion_gate.publish(drive, request, timeout_s=1.0)
    assert (sent.messages, sent.subscribers) == (0, 3)
    assert sent.verdict.simulated
    assert sent.verdict.allowed
    assert (bench.sent, bench.writer.waits_s, bench.permitted) == ([], [], [])


# Services


def test_a_request_is_sent_to_its_service(
    bench: Any, endpoints: dict[str, Endpoint], ask: Ask, expose: Callable[..., ExposedEndpoint]
) -> None:
    enable = expose(endpoints["enable"])
    request = ask(enable.endpoint, {"data": True})
    done = threading.Event()
    verdict, call = bench.motion_gate.send_request(enable, request, done.set)
    assert verdict.may_send
    assert call == "the call"
    assert bench.traffic.calls == [
        (load_type(enable.endpoint.type), "/arm/enable", request.messages[0], done.set)
    ]
    assert bench.permitted == ["enable"]


def test_a_request_is_not_sent_while_somebody_else_moves_the_robot(
    bench: Any, endpoints: dict[str, Endpoint], ask: Ask, expose: Callable[..., ExposedEndpoint]
) -> None:
    enable = expose(endpoints["enable"])
    bench.policy = "The policy 'instant' moves 'arm'."
    with pytest.raises(RefusedError, match="instant"):
        bench.motion_gate.send_request(enable, ask(enable.endpoint, {"data": True}), print)
    assert (bench.traffic.calls, bench.checked) == ([], [])


def test_a_stop_while_a_request_waits_to_be_sent_keeps_it_from_its_service(
    bench: Any, endpoints: dict[str, Endpoint], ask: Ask, expose: Callable[..., ExposedEndpoint]
) -> None:
    enable = expose(endpoints["enable"])
    bench.on_permit = lambda: bench.gate.latch.press(who="a person", reason="a test")
    with pytest.raises(RefusedError, match="Nothing was sent"):
        bench.motion_gate.send_request(enable, ask(enable.endpoint, {"data": True}), print)
    assert bench.traffic.calls == []


def test_a_simulated_request_of_a_request_calls_nobody(
    bench: Any, endpoints: dict[str, Endpoint], ask: Ask, expose: Callable[..., ExposedEndpoint]
) -> None:
    enable = expose(endpoints["enable"])
    request = ask(enable.endpoint, {"data": True}, simulated=True)
    verdict, call = bench.motion_gate.send_request(enable, request, print)
    assert (verdict.allowed, call) == (True, None)
    assert (bench.traffic.calls, bench.permitted) == ([], [])


def test_a_query_is_answered_in_a_simulated_request_and_while_a_policy_moves_the_robot(
    make_gate: Callable[..., Gate],
    ask: Ask,
    expose: Callable[..., ExposedEndpoint],
    make_bench: Callable[..., Any],
) -> None:
    query = Endpoint(
        name="state",
        kind="read",
        topic="state",
        type="rcl_interfaces/srv/GetParameters",
        summary="ask",
    )
    bench = make_bench(make_gate(query))
    bench.policy = "The policy 'instant' moves 'arm'."
    state = expose(query)
    request = ask(query, {}, simulated=True)
    verdict, call = bench.motion_gate.send_request(state, request, print)
    assert (verdict.allowed, call) == (True, "the call")
    assert bench.permitted == [], "it asks for no motion"
    bench = make_bench(make_gate(simulated=True))
    verdict, call = bench.motion_gate.send_request(state, ask(query, {}), print)
    assert (verdict.allowed, call) == (False, None), "it is not exposed"
    assert bench.traffic.calls == []

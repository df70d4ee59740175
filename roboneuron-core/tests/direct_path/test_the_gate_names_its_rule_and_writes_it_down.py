"""Which rule refused is told and written down, and the record stays of a bounded length."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from roboneuron.contract import Endpoint
from roboneuron.direct_path.gate import Gate
from roboneuron.direct_path.request import AllowedEndpoint
from roboneuron.errors import ConfigurationError, RefusedError
from roboneuron.estop import EmergencyStopLatch
from roboneuron.feature import GateRequest
from roboneuron.gate import AuditLog
from roboneuron.gate.motion.path_limits import LimitError

Ask = Callable[..., GateRequest]
Make = Callable[..., Gate]
FORWARD = {"linear": {"x": 0.25}}
STEP = {"name": ["j1"], "position": [0.1]}


def records(gate: Gate) -> list[dict[str, Any]]:
    return [json.loads(line) for line in gate.audit.path.read_text().splitlines()]


class Judge:
    """Refuses every way of the joints with `error`."""

    def __init__(self, error: Exception) -> None:
        self.error = error

    def check(self, legs: object, joints: object) -> None:
        raise self.error


def breaking(
    rule: str, make_gate: Make, ask: Ask, endpoints: dict[str, Endpoint]
) -> tuple[Gate, GateRequest]:
    """A gate, and a request that the rule refuses though all rules before it hold."""
    gate, request = make_gate(), ask(endpoints["velocity"], FORWARD)
    if rule == "allow_list":
        return gate, replace(request, endpoint="unknown")
    if rule == "role":
        return gate, replace(request, role="viewer")
    if rule == "type":
        return gate, replace(request, messages=())
    if rule == "finite":
        request.messages[0].linear.x = float("nan")
    elif rule == "bounds":
        request.messages[0].linear.x = 9.0
    elif rule == "steering":
        gate = make_gate(replace(endpoints["velocity"], min_turning_radius_m=1.0))
        request.messages[0].angular.z, request.messages[0].linear.x = 0.5, 0.0
    elif rule == "frame":
        place = replace(
            endpoints["velocity"],
            name="goal",
            topic="goal",
            type="geometry_msgs/msg/PoseStamped",
            bounds={},
            stop_message="",
            frame="map",
        )
        gate, request = make_gate(place), ask(place, {"header": {"frame_id": "odom"}})
    elif rule == "joints":
        request = ask(endpoints["joints"], {"name": ["j1"], "position": [9.0]})
    elif rule == "kinematics":
        gate = make_gate(path=lambda: Judge(RefusedError("It cannot be computed.")))
        request = ask(endpoints["joints"], STEP)
    elif rule == "zone":
        gate = make_gate(path=lambda: Judge(LimitError("zone", "It would enter the pane.")))
        request = ask(endpoints["joints"], STEP)
    elif rule == "emergency_stop":
        gate.latch.press(who="a person", reason="a test")
    else:
        for _ in range(5):
            gate.check(request)
    return gate, request


@pytest.mark.parametrize(
    "rule",
    [
        *("allow_list", "role", "type", "finite", "bounds", "steering", "frame"),
        *("joints", "kinematics", "zone", "emergency_stop", "rate"),
    ],
)
def test_the_rule_that_does_not_hold_is_told_and_written_down(
    rule: str, make_gate: Make, ask: Ask, endpoints: dict[str, Endpoint]
) -> None:
    gate, request = breaking(rule, make_gate, ask, endpoints)
    verdict = gate.check(replace(request, simulated=True))
    assert (verdict.allowed, verdict.simulated, verdict.rule) == (False, True, rule)
    with pytest.raises(RefusedError) as caught:
        gate.check(request)
    asked, refused = records(gate)[-2:]
    assert (asked["verdict"], asked["rule"]) == ("would_refuse", rule)
    assert (refused["verdict"], refused["rule"]) == ("refused", rule)
    assert refused["reason"] == str(caught.value) == verdict.reason
    assert caught.value.rule == rule


def test_a_refusal_by_a_prediction_is_one_of_the_path(
    make_gate: Make, ask: Ask, endpoints: dict[str, Endpoint]
) -> None:
    def predict() -> None:
        raise RefusedError("It would stop short.")

    request = ask(endpoints["velocity"], FORWARD, predict=predict, simulated=True)
    assert make_gate().check(request).rule == "path"


def test_only_a_gate_that_never_sends_asks_for_the_prediction_of_a_later_message(
    make_gate: Make, ask: Ask, endpoints: dict[str, Endpoint]
) -> None:
    asked: list[str] = []
    request = ask(endpoints["velocity"], FORWARD, predict=lambda: asked.append("predicted"))
    make_gate().check_next(request)
    assert asked == []
    make_gate(simulated=True).check_next(request)
    assert asked == ["predicted"]


def test_what_is_allowed_is_written_down_without_a_rule(
    make_gate: Make, ask: Ask, endpoints: dict[str, Endpoint]
) -> None:
    gate = make_gate()
    verdict = gate.check(ask(endpoints["velocity"], FORWARD))
    assert (verdict.allowed, verdict.simulated, verdict.rule) == (True, False, "")
    (record,) = records(gate)
    assert (record["tool"], record["robot"]) == ("publish_velocity", "arm")
    assert not {"rule", "reason"} & record.keys()


def test_a_later_message_that_is_refused_is_written_down_with_what_was_asked(
    make_gate: Make, ask: Ask, endpoints: dict[str, Endpoint]
) -> None:
    gate = make_gate()
    with pytest.raises(RefusedError):
        gate.check_next(ask(endpoints["velocity"], {"linear": {"x": 9.0}}))
    (record,) = records(gate)
    assert record["arguments"] == {"linear": {"x": 9.0}}
    assert (record["who"], record["verdict"]) == ("agent-1", "refused")


def test_long_words_of_a_client_are_cut_in_the_record(
    make_gate: Make, ask: Ask, endpoints: dict[str, Endpoint]
) -> None:
    gate = make_gate()
    long = "x" * 1000
    words = dict.fromkeys(("who", "role", "tool", "robot", "endpoint"), long)
    verdict = gate.check(ask(endpoints["velocity"], FORWARD, simulated=True, **words))
    (record,) = records(gate)
    assert {name: len(record[name]) for name in words} == {
        "who": 200,
        "role": 20,
        "tool": 200,
        "robot": 200,
        "endpoint": 200,
    }
    assert record["reason"] == verdict.reason


def test_a_long_reason_is_cut_in_the_record_alone(
    make_gate: Make, ask: Ask, endpoints: dict[str, Endpoint]
) -> None:
    gate = make_gate(path=lambda: Judge(RefusedError("x" * 1000 + ".")))
    verdict = gate.check(ask(endpoints["joints"], STEP, simulated=True))
    assert len(verdict.reason) == 1001
    (record,) = records(gate)
    assert record["reason"] == "x" * 500


def test_twenty_clamped_values_are_written_down_and_all_are_told(
    make_gate: Make, ask: Ask, endpoints: dict[str, Endpoint]
) -> None:
    values = replace(
        endpoints["pose"], type="std_msgs/msg/Float64MultiArray", bounds={"data": (-1, 1)}
    )
    gate = make_gate(values, clamp=frozenset({"data"}))
    verdict = gate.check(ask(values, {"data": [2.0] * 25}))
    assert len(verdict.clamped) == 25
    (record,) = records(gate)
    assert record["clamped"] == [f"data[{i}]: 2 -> 1" for i in range(20)]


def test_a_clamp_of_each_message_of_a_request_is_told(
    make_gate: Make, ask: Ask, endpoints: dict[str, Endpoint]
) -> None:
    gate = make_gate(clamp=frozenset({"linear.x"}))
    one, two = (ask(endpoints["velocity"], {"linear": {"x": x}}).messages[0] for x in (7.0, -8.0))
    verdict = gate.check(ask(endpoints["velocity"], messages=(one, two)))
    assert [(clamp.asked, clamp.sent) for clamp in verdict.clamped] == [(7.0, 0.5), (-8.0, -0.5)]


def test_a_full_disk_changes_no_answer_that_sends_nothing(
    make_gate: Make, ask: Ask, endpoints: dict[str, Endpoint], tmp_path: Path, clock: Any
) -> None:
    (tmp_path / "full").symlink_to("/dev/full")
    gate = make_gate(audit=AuditLog(tmp_path / "full", clock.wall_ns))
    unknown = ask(endpoints["velocity"], FORWARD, endpoint="unknown")
    with pytest.raises(RefusedError, match="'unknown' of 'arm' is not exposed"):
        gate.check(unknown)
    assert gate.check(replace(unknown, simulated=True)).rule == "allow_list"
    assert gate.check(ask(endpoints["velocity"], FORWARD, simulated=True)).allowed
    with pytest.raises(RefusedError, match="cannot be written"):
        gate.check(ask(endpoints["velocity"], FORWARD))


# What is said of an endpoint that is not exposed


def test_up_to_twenty_names_are_told_instead_of_one_that_is_not_exposed(
    latch: EmergencyStopLatch, audit: AuditLog, clock: Any, ask: Ask, endpoints: Any
) -> None:
    def gate_of(count: int) -> Gate:
        return Gate(
            [
                AllowedEndpoint(
                    robot="arm", endpoint=replace(endpoints["velocity"], name=f"e{i:02}")
                )
                for i in reversed(range(count))
            ],
            latch=latch,
            audit=audit,
            clock=clock.monotonic,
        )

    names = ", ".join(f"e{i:02}" for i in range(20))
    for count, end in ((20, "."), (21, " ....")):
        verdict = gate_of(count).check(ask(endpoints["velocity"], FORWARD, simulated=True))
        assert verdict.reason == (f"'velocity' of 'arm' is not exposed; exposed are: {names}{end}")


def test_the_robots_are_told_instead_of_one_that_there_is_not(
    latch: EmergencyStopLatch, audit: AuditLog, clock: Any, ask: Ask, endpoints: Any
) -> None:
    entries = [
        AllowedEndpoint(robot=robot, endpoint=endpoints["velocity"]) for robot in ("left", "base")
    ]
    gate = Gate(entries, latch=latch, audit=audit, clock=clock.monotonic)
    request = ask(endpoints["velocity"], FORWARD, simulated=True)
    assert gate.check(request).reason == (
        "No endpoint of a robot called 'arm' is exposed; robots: base, left."
    )
    gate.replace(())
    assert gate.check(request).reason.endswith("robots: none.")


def test_a_way_that_cannot_be_judged_is_refused_with_what_to_do(
    make_gate: Make, ask: Ask, endpoints: dict[str, Endpoint]
) -> None:
    error = ConfigurationError("There is no controller.", hint="Install one.")
    gate = make_gate(path=lambda: Judge(error))
    with pytest.raises(RefusedError) as caught:
        gate.check(ask(endpoints["joints"], STEP))
    assert caught.value.hint == "Install one."
    assert caught.value.__cause__ is error


def test_durations_count_only_when_there_is_one_for_each_command(
    make_gate: Make, ask: Ask, endpoints: dict[str, Endpoint]
) -> None:
    """Durations of something else would be judged as if they were those of the commands."""
    gate = make_gate()
    step = ask(endpoints["joints"], {"name": ["j1"], "position": [0.9]})
    with pytest.raises(RefusedError, match="per second"):
        gate.check(replace(step, durations_s=(0.1,)))
    assert gate.check(replace(step, durations_s=(0.1, 0.1))).may_send


def test_a_gate_that_is_told_of_no_simulated_request_sends(
    latch: EmergencyStopLatch, audit: AuditLog, clock: Any, ask: Ask, endpoints: Any
) -> None:
    entry = AllowedEndpoint(robot="arm", endpoint=endpoints["velocity"])
    gate = Gate([entry], latch=latch, audit=audit, clock=clock.monotonic)
    assert gate.check(ask(endpoints["velocity"], FORWARD)).may_send
    assert gate.allowed() == (entry,)

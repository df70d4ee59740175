"""The rate of an endpoint is the rate of its topic: whatever name it is sent by."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from roboneuron.contract import Endpoint
from roboneuron.direct_path.gate import Gate
from roboneuron.direct_path.request import AllowedEndpoint
from roboneuron.errors import ConfigurationError, RefusedError
from roboneuron.estop import EmergencyStopLatch
from roboneuron.feature import GateRequest
from roboneuron.gate import AuditLog

Ask = Callable[..., GateRequest]
FORWARD = {"linear": {"x": 0.25}}


@pytest.fixture
def make(
    latch: EmergencyStopLatch, audit: AuditLog, clock: Any
) -> Callable[[list[AllowedEndpoint]], Gate]:
    """A gate over entries."""
    return lambda entries: Gate(entries, latch=latch, audit=audit, clock=clock.monotonic)


def entry(endpoint: Endpoint, **changes: Any) -> AllowedEndpoint:
    return AllowedEndpoint(**({"robot": "arm", "endpoint": endpoint} | changes))


def use_up(gate: Gate, request: GateRequest, count: int = 5) -> None:
    """Send as many messages as the rate of five per second allows."""
    for _ in range(count):
        gate.check(request)
    with pytest.raises(RefusedError, match="Too many messages"):
        gate.check(request)


def test_two_names_of_one_topic_have_one_rate(make: Any, ask: Ask, endpoints: Any) -> None:
    drive, again = endpoints["velocity"], replace(endpoints["velocity"], name="again")
    gate = make([entry(drive, topic="/arm/cmd_vel"), entry(again, topic="/arm/cmd_vel")])
    use_up(gate, ask(drive, FORWARD))
    with pytest.raises(RefusedError, match="Too many messages"):
        gate.check(ask(again, FORWARD))


def test_two_topics_have_a_rate_each(make: Any, ask: Ask, endpoints: Any) -> None:
    drive, again = endpoints["velocity"], replace(endpoints["velocity"], name="again")
    gate = make([entry(drive, topic="/arm/cmd_vel"), entry(again, topic="/base/cmd_vel")])
    use_up(gate, ask(drive, FORWARD))
    use_up(gate, ask(again, FORWARD))


def test_a_service_of_the_name_of_a_topic_has_a_rate_of_its_own(
    make: Any, ask: Ask, endpoints: Any
) -> None:
    drive, enable = endpoints["velocity"], replace(endpoints["enable"], rate_hz=5.0)
    gate = make([entry(drive, topic="/arm/same"), entry(enable, topic="/arm/same")])
    use_up(gate, ask(drive, FORWARD))
    use_up(gate, ask(enable, {"data": True}))


def test_without_a_topic_each_name_of_each_robot_has_a_rate_of_its_own(
    make: Any, ask: Ask, endpoints: Any
) -> None:
    drive, again = endpoints["velocity"], replace(endpoints["velocity"], name="again")
    gate = make([entry(drive), entry(again), entry(drive, robot="base")])
    for request in (ask(drive, FORWARD), ask(again, FORWARD), ask(drive, FORWARD, robot="base")):
        use_up(gate, request)


def test_another_rate_begins_anew_and_the_same_one_goes_on(
    make: Any, ask: Ask, endpoints: Any, clock: Any
) -> None:
    drive = endpoints["velocity"]
    gate = make([entry(drive, topic="/arm/cmd_vel")])
    use_up(gate, ask(drive, FORWARD))
    gate.replace([entry(replace(drive, rate_hz=3.0), topic="/arm/cmd_vel")])
    use_up(gate, ask(drive, FORWARD), 3)
    renamed = replace(drive, name="renamed", rate_hz=3.0)
    gate.replace([entry(renamed, topic="/arm/cmd_vel")])
    with pytest.raises(RefusedError, match="Too many messages"):
        gate.check(ask(renamed, FORWARD))
    clock.now_s += 1.0
    use_up(gate, ask(renamed, FORWARD), 3)


def test_an_allow_list_that_cannot_be_leaves_the_old_one(
    make: Any, ask: Ask, endpoints: Any
) -> None:
    drive = endpoints["velocity"]
    gate = make([entry(drive)])
    with pytest.raises(ConfigurationError):
        gate.replace([entry(endpoints["scan"]), entry(replace(drive, name="A b"))])
    assert gate.check(ask(drive, FORWARD)).may_send
    assert [one.endpoint.name for one in gate.allowed()] == ["velocity"]


def test_each_message_of_a_request_counts_and_a_look_counts_as_one(
    make: Any, ask: Ask, endpoints: Any
) -> None:
    drive, scan = endpoints["velocity"], replace(endpoints["scan"], rate_hz=2.0)
    gate = make([entry(drive), entry(scan)])
    (message,) = ask(drive, FORWARD).messages
    gate.check(ask(drive, messages=(message,) * 4))
    with pytest.raises(RefusedError, match="Too many messages"):
        gate.check(ask(drive, messages=(message,) * 2))
    use_up(gate, ask(drive, messages=(message,)), 1)
    use_up(gate, ask(scan), 2)


def test_messages_at_once_are_sent_now_not_later(
    make: Any, ask: Ask, endpoints: Any, clock: Any
) -> None:
    drive = endpoints["velocity"]
    gate = make([entry(drive)])
    use_up(gate, ask(drive, FORWARD))
    clock.now_s += 0.999
    with pytest.raises(RefusedError, match="Too many messages"):
        gate.check(ask(drive, FORWARD))
    clock.now_s += 0.001
    gate.check(ask(drive, FORWARD))


def test_a_simulated_request_counts_nothing_but_tells_of_the_rate(
    make: Any, ask: Ask, endpoints: Any
) -> None:
    drive = endpoints["velocity"]
    gate = make([entry(drive)])
    question = ask(drive, FORWARD, simulated=True)
    for _ in range(9):
        assert gate.check(question).allowed
    use_up(gate, ask(drive, FORWARD))
    verdict = gate.check(question)
    assert (verdict.allowed, verdict.rule) == (False, "rate")


def test_messages_that_follow_each_other_too_fast_are_told_from_too_many(
    make: Any, ask: Ask, endpoints: Any
) -> None:
    drive = endpoints["velocity"]
    gate = make([entry(drive)])
    (message,) = ask(drive, FORWARD).messages
    times_s = tuple(i * 0.1 for i in range(6))
    with pytest.raises(RefusedError, match="follow each other faster than its 5 per second"):
        gate.check(ask(drive, messages=(message,) * 6, send_at_s=times_s))
    slower_s = tuple(i * 0.2 for i in range(6))
    gate.check(ask(drive, messages=(message,) * 6, send_at_s=slower_s))


def test_only_the_messages_of_the_request_that_is_given_back_are_forgotten(
    make: Any, ask: Ask, endpoints: Any
) -> None:
    drive = endpoints["velocity"]
    gate = make([entry(drive)])
    (message,) = ask(drive, FORWARD).messages
    first = ask(drive, messages=(message,) * 3, send_at_s=(0.5, 0.6, 0.7))
    second = ask(drive, messages=(message,) * 2, send_at_s=(0.5, 0.6))
    gate.check(first)
    gate.check(second)
    gate.release(second)
    use_up(gate, ask(drive, FORWARD), 2)

"""One message: sent once, or not at all; also without blocking."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from roboneuron.contract import Endpoint
from roboneuron.direct_path.gate import Gate
from roboneuron.errors import RefusedError
from roboneuron.feature import ExposedEndpoint, GateRequest

Ask = Callable[..., GateRequest]
FORWARD = {"linear": {"x": 0.25}}


# One message


def test_a_message_that_is_allowed_is_sent_once(
    bench: Any, drive: ExposedEndpoint, ask: Ask
) -> None:
    request = ask(drive.endpoint, FORWARD)
    sent = bench.motion_gate.publish(drive, request, timeout_s=1.5)
    assert bench.sent == [request.messages[0]]
    assert (sent.messages, sent.subscribers, sent.stopped) == (1, 2, False)
    assert sent.verdict.may_send
    assert sent.duration_s == 0.0
    assert bench.writer.waits_s == [1.5]
    assert bench.permitted == ["velocity"]
    assert len(bench.checked) == 1


def test_the_time_that_sending_takes_is_told(bench: Any, drive: ExposedEndpoint, ask: Ask) -> None:
    bench.writer.takes_s = 0.125
    publish = bench.writer.publish

    def slow(message: Any) -> None:
        bench.clock.now_s += 0.5
        publish(message)

    bench.writer.publish = slow  # type: ignore[method-assign]
    request = ask(drive.endpoint, FORWARD)
    assert bench.motion_gate.publish(drive, request, timeout_s=1.0).duration_s == 0.5
    now = bench.motion_gate.publish_now(drive, ask(drive.endpoint, FORWARD))
    assert now is not None
    assert now.duration_s == 0.5


@pytest.mark.parametrize("how", ["now", "later", "motion"])
def test_a_message_that_is_refused_is_not_sent(
    bench: Any, drive: ExposedEndpoint, ask: Ask, how: str
) -> None:
    request = ask(drive.endpoint, {"linear": {"x": 9.0}})
    with pytest.raises(RefusedError, match=r"linear\.x"):
        bench.send_one(drive, request, how)
    assert (bench.sent, bench.permitted) == ([], [])


@pytest.mark.parametrize("how", ["now", "later", "motion"])
def test_a_message_is_not_sent_while_a_policy_moves_the_robot(
    bench: Any, drive: ExposedEndpoint, ask: Ask, how: str
) -> None:
    bench.policy = "The policy 'instant' moves 'arm'."
    with pytest.raises(RefusedError, match="instant"):
        bench.send_one(drive, ask(drive.endpoint, FORWARD), how)
    assert (bench.sent, bench.checked) == ([], [])


@pytest.mark.parametrize("how", ["now", "later", "motion"])
def test_a_message_is_not_sent_while_the_emergency_stop_is_latched(
    bench: Any, drive: ExposedEndpoint, ask: Ask, how: str
) -> None:
    bench.gate.latch.press(who="a person", reason="a test")
    with pytest.raises(RefusedError, match="Nothing was sent"):
        bench.send_one(drive, ask(drive.endpoint, FORWARD), how)
    assert bench.sent == []


def test_what_keeps_the_robot_still_keeps_a_message_from_being_sent(
    bench: Any, drive: ExposedEndpoint, ask: Ask
) -> None:
    def refuse() -> None:
        raise RefusedError("Motion needs a new start.")

    bench.on_permit = refuse
    with pytest.raises(RefusedError, match="new start"):
        bench.motion_gate.publish(drive, ask(drive.endpoint, FORWARD), timeout_s=1.0)
    assert bench.sent == []


@pytest.mark.parametrize("is_now", [False, True])
def test_a_message_carries_the_time_of_sending_when_it_is_to(
    bench: Any,
    ask: Ask,
    endpoints: dict[str, Endpoint],
    is_now: bool,
    expose: Callable[..., ExposedEndpoint],
) -> None:
    for stamped in (False, True):
        pose = expose(endpoints["pose"])
        request = ask(pose.endpoint, {"poses": [{"position": {"x": 0.5}}]})
        options = {"stamped": True} if stamped else {}
        if is_now:
            assert bench.motion_gate.publish_now(pose, request, **options) is not None
        else:
            bench.motion_gate.publish(pose, request, timeout_s=1.0, **options)
        assert (bench.sent[-1].header.stamp.sec > 0) == stamped


def test_a_gate_that_only_answers_sends_nothing(
    make_gate: Callable[..., Gate], drive: ExposedEndpoint, ask: Ask, make_bench: Callable[..., Any]
) -> None:
    bench = make_bench(make_gate(simulated=True))
    bench.writer.listeners = 3
    sent = bench.motion_gate.publish(drive, ask(drive.endpoint, FORWARD), timeout_s=1.0)
    assert (sent.messages, sent.subscribers, sent.verdict.may_send) == (0, 3, False)
    now = bench.motion_gate.publish_now(drive, ask(drive.endpoint, FORWARD))
    assert now is not None
    assert (now.messages, now.subscribers) == (0, 2)
    assert (bench.sent, bench.permitted) == ([], [])


# One message, without blocking


def test_a_message_is_sent_at_once_when_nothing_has_to_be_waited_for(
    bench: Any, drive: ExposedEndpoint, ask: Ask
) -> None:
    request = ask(drive.endpoint, FORWARD)
    sent = bench.motion_gate.publish_now(drive, request)
    assert sent is not None
    assert bench.sent == [request.messages[0]]
    assert (sent.messages, sent.subscribers, sent.duration_s) == (1, 2, 0.0)
    assert sent.verdict.may_send
    assert bench.writer.waits_s == []


@pytest.mark.parametrize("why", ["no writer", "dry run", "joints", "still", "no subscriber"])
def test_what_has_to_be_waited_for_is_left_to_a_thread(
    bench: Any, drive: ExposedEndpoint, move: ExposedEndpoint, ask: Ask, why: str
) -> None:
    place, request = drive, ask(drive.endpoint, FORWARD)
    if why == "no writer":
        bench.traffic.is_known = False
    elif why == "dry run":
        request = replace(request, simulated=True)
    elif why == "joints":
        place, request = move, ask(move.endpoint, {"name": ["j1"], "position": [0.1]})
    elif why == "still":
        bench.is_still = True
    else:
        bench.writer.subscribers = 0
    assert bench.motion_gate.publish_now(place, request) is None
    assert (bench.sent, bench.checked) == ([], [])

"""The rest of a motion, as the gate judges it: later messages, given back ones, and its speed."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from roboneuron.contract import JointSample
from roboneuron.direct_path.gate import Gate
from roboneuron.errors import NotReadyError, RefusedError
from roboneuron.feature import ExposedEndpoint, GateRequest

Ask = Callable[..., GateRequest]
FORWARD = {"linear": {"x": 0.25}}


# The rest of a motion, as the gate judges it


def test_only_a_refusal_of_a_later_message_is_written_down(
    make_gate: Callable[..., Gate], ask: Ask, drive: ExposedEndpoint
) -> None:
    gate = make_gate()
    request = ask(drive.endpoint, FORWARD)
    for _ in range(20):
        gate.check_next(request)
    assert not gate.audit.path.exists(), "it belongs to a motion that was allowed"
    with pytest.raises(RefusedError, match=r"linear\.x"):
        gate.check_next(ask(drive.endpoint, {"linear": {"x": 9.0}}))
    (line,) = gate.audit.path.read_text().splitlines()
    record = json.loads(line)
    assert (record["verdict"], record["rule"]) == ("refused", "bounds")


def test_a_later_message_does_not_count_against_the_rate_and_one_of_a_new_request_does(
    make_gate: Callable[..., Gate], ask: Ask, drive: ExposedEndpoint
) -> None:
    gate = make_gate()
    request = ask(drive.endpoint, FORWARD)
    for _ in range(20):
        gate.check_next(request)
    for _ in range(5):
        gate.check(request)
    with pytest.raises(RefusedError, match="Too many messages"):
        gate.check(request)


def test_a_later_message_that_a_dry_gate_refuses_is_recorded_as_refused(
    make_gate: Callable[..., Gate], ask: Ask, drive: ExposedEndpoint
) -> None:
    gate = make_gate(simulated=True)
    with pytest.raises(RefusedError):
        gate.check_next(ask(drive.endpoint, {"linear": {"x": 9.0}}))
    (line,) = gate.audit.path.read_text().splitlines()
    assert json.loads(line)["verdict"] == "refused"


def test_released_messages_count_no_more(
    make_gate: Callable[..., Gate], ask: Ask, drive: ExposedEndpoint
) -> None:
    gate = make_gate()
    message = ask(drive.endpoint, FORWARD).messages[0]
    later = ask(
        drive.endpoint,
        FORWARD,
        messages=(message,) * 5,
        send_at_s=(0.2, 0.4, 0.6, 0.8, 1.0),
    )
    gate.check(later)
    gate.release(later)
    gate.release(replace(later, endpoint="unknown"))
    gate.release(replace(later, robot="another"))
    for _ in range(5):
        gate.check(ask(drive.endpoint, FORWARD))


class Path:
    """A path that can be judged, or not."""

    def __init__(self, answer: float | Exception) -> None:
        self.answer = answer
        self.asked: list[tuple[Any, Any]] = []

    def slowdown(self, legs: Any, joints: Any) -> float:
        self.asked.append((legs, joints))
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


def test_how_much_more_time_a_path_needs_is_asked_of_the_path(
    make_gate: Callable[..., Gate],
    here: JointSample,
    joint_request: Callable[..., GateRequest],
) -> None:
    path = Path(2.5)
    gate = make_gate(path=lambda: path)
    assert gate.slowdown(joint_request()) == 2.5
    ((legs, joints),) = path.asked
    assert len(legs) == 1
    assert joints is here


def test_without_joints_a_path_or_an_endpoint_no_more_time_is_needed(
    make_gate: Callable[..., Gate],
    joint_request: Callable[..., GateRequest],
) -> None:
    path = Path(2.5)
    gate = make_gate(path=lambda: path)
    assert gate.slowdown(joint_request(joints=None)) == 1.0
    assert gate.slowdown(joint_request(endpoint="unknown")) == 1.0
    assert gate.slowdown(joint_request(robot="another")) == 1.0
    assert path.asked == []
    assert make_gate().slowdown(joint_request()) == 1.0


def test_a_path_that_cannot_be_judged_is_refused(
    make_gate: Callable[..., Gate],
    joint_request: Callable[..., GateRequest],
) -> None:
    gate = make_gate(path=lambda: Path(NotReadyError("no description", hint="Start it.")))
    with pytest.raises(RefusedError, match="cannot be checked: no description") as caught:
        gate.slowdown(joint_request())
    assert caught.value.hint == "Start it."
    gate = make_gate(path=lambda: Path(RefusedError("it is too far")))
    with pytest.raises(RefusedError, match=r"^it is too far"):
        gate.slowdown(joint_request())

"""Between the verdict on a message and its sending, while a subscriber or joints are waited for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from roboneuron.contract import Endpoint, JointSample
from roboneuron.errors import NotReadyError, RefusedError, StateError
from roboneuron.feature import ExposedEndpoint, GateRequest

Ask = Callable[..., GateRequest]
FORWARD = {"linear": {"x": 0.25}}


# Waiting for a subscriber


@pytest.mark.parametrize("how", ["later", "motion"])
def test_a_message_that_nobody_would_receive_is_not_sent(
    bench: Any, drive: ExposedEndpoint, ask: Ask, how: str
) -> None:
    bench.writer.subscribers = bench.writer.listeners = 0
    request = ask(drive.endpoint, FORWARD)
    with pytest.raises(NotReadyError, match=r"/arm/cmd_vel .* has no subscriber"):
        bench.send_one(drive, request, how)
    assert (bench.sent, bench.writer.waits_s, bench.permitted) == ([], [0.5], [])


def test_a_policy_that_does_not_fit_is_named(bench: Any, drive: ExposedEndpoint, ask: Ask) -> None:
    bench.writer.subscribers, bench.writer.misfit = 0, "liveliness"
    said = r"/arm/cmd_vel .* has no subscriber that fits, because of liveliness: nothing was sent"
    with pytest.raises(NotReadyError, match=said):
        bench.send_one(drive, ask(drive.endpoint, FORWARD), "later")


@pytest.mark.parametrize(("listeners", "wait_s"), [(0, 0.0), (1, 0.5)])
def test_a_message_that_needs_no_subscriber_waits_only_for_one_that_is_there(
    bench: Any,
    endpoints: dict[str, Endpoint],
    ask: Ask,
    listeners: int,
    wait_s: float,
    expose: Callable[..., ExposedEndpoint],
) -> None:
    drive = expose(endpoints["velocity"], require_subscriber=False)
    bench.writer.subscribers, bench.writer.listeners = 0, listeners
    sent = bench.motion_gate.publish(drive, ask(drive.endpoint, FORWARD), timeout_s=0.5)
    assert (sent.messages, sent.subscribers) == (1, 0)
    assert bench.writer.waits_s == [wait_s]


def test_after_a_quarter_of_a_second_the_gate_is_asked_again(
    bench: Any, drive: ExposedEndpoint, ask: Ask
) -> None:
    bench.writer.takes_s = 0.25
    bench.motion_gate.publish(drive, ask(drive.endpoint, FORWARD), timeout_s=1.0)
    assert len(bench.checked) == 1
    bench.writer.takes_s = 0.2501
    bench.motion_gate.publish(drive, ask(drive.endpoint, FORWARD), timeout_s=1.0)
    assert [request.repeated for request in bench.checked] == [False, False, True]
    assert bench.checked[2].joints is None, "no joints are limited"


@pytest.mark.parametrize("how", ["later", "motion"])
def test_a_stop_while_it_waits_for_a_subscriber_keeps_a_message_from_being_sent(
    bench: Any, drive: ExposedEndpoint, ask: Ask, how: str
) -> None:
    bench.writer.takes_s = 0.3
    bench.writer.on_connect = lambda: bench.gate.latch.press(who="a person", reason="a test")
    with pytest.raises(RefusedError):
        bench.send_one(drive, ask(drive.endpoint, FORWARD), how)
    assert (bench.sent, bench.permitted) == ([], [])


@pytest.mark.parametrize("how", ["later", "motion"])
def test_a_stop_during_a_short_wait_keeps_a_message_from_being_sent(
    bench: Any, drive: ExposedEndpoint, ask: Ask, how: str
) -> None:
    bench.writer.takes_s = 0.1  # the gate is not asked again
    bench.writer.on_connect = lambda: bench.gate.latch.press(who="a person", reason="a test")
    with pytest.raises(RefusedError):
        bench.send_one(drive, ask(drive.endpoint, FORWARD), how)
    assert bench.sent == []


@pytest.mark.parametrize("how", ["later", "motion"])
def test_a_stop_of_the_robot_during_a_wait_is_not_ended_by_the_request_from_before(
    bench: Any, drive: ExposedEndpoint, ask: Ask, how: str
) -> None:
    def fail() -> None:
        bench.starts.arm_stops, bench.starts.reason = 1, "a fault of the robot"

    bench.writer.on_connect = fail
    with pytest.raises(StateError, match="a fault of the robot"):
        bench.send_one(drive, ask(drive.endpoint, FORWARD), how)
    assert (bench.sent, bench.permitted) == ([], [])


def test_a_policy_that_starts_meanwhile_keeps_a_message_from_being_sent(
    bench: Any, drive: ExposedEndpoint, ask: Ask
) -> None:
    bench.writer.takes_s = 0.3
    bench.writer.on_connect = lambda: setattr(bench, "policy", "The policy 'late' moves 'arm'.")
    with pytest.raises(RefusedError, match="late"):
        bench.motion_gate.publish(drive, ask(drive.endpoint, FORWARD), timeout_s=1.0)
    assert bench.sent == []


def test_an_owned_motion_is_not_in_its_own_way_after_a_wait(
    bench: Any, drive: ExposedEndpoint, ask: Ask
) -> None:
    bench.writer.takes_s = 0.3
    assert bench.play(drive, ask(drive.endpoint, FORWARD)).messages == 1


def test_the_joints_are_measured_again_after_a_wait(
    bench: Any,
    move: ExposedEndpoint,
    here: JointSample,
    joint_request: Callable[..., GateRequest],
) -> None:
    """The arm may have been moved meanwhile: what was near may be far by now."""
    bench.writer.takes_s = 0.3
    there = replace(here, position=np.array([0.9, 0.2, 0.0]))
    bench.writer.on_connect = lambda: setattr(bench.traffic, "now_joints", there)
    request = joint_request()
    bench.motion_gate.publish(move, request, timeout_s=1.0)
    first, again = bench.checked
    assert (first.joints, again.joints) == (here, there)
    assert again.messages == request.messages
    assert (first.repeated, again.repeated) == (False, True)


# Joints


def test_joints_are_measured_when_a_request_has_none(
    bench: Any, move: ExposedEndpoint, ask: Ask, here: JointSample
) -> None:
    value = {"name": ["j1", "j2"], "position": [0.11, 0.2]}
    request = ask(move.endpoint, value, joints=None)
    assert bench.motion_gate.publish(move, request, timeout_s=0.75).messages == 1
    assert bench.traffic.waits_s == [0.75]
    assert bench.checked[0].joints is here


def test_joints_that_a_request_has_are_not_measured_again(
    bench: Any, move: ExposedEndpoint, ask: Ask
) -> None:
    value = {"name": ["j1", "j2"], "position": [0.01, 0.0]}
    bench.motion_gate.publish(move, ask(move.endpoint, value), timeout_s=0.75)
    assert bench.traffic.waits_s == []


def test_joints_are_not_measured_for_what_moves_none(
    bench: Any, drive: ExposedEndpoint, ask: Ask
) -> None:
    bench.motion_gate.publish(drive, ask(drive.endpoint, FORWARD, joints=None), timeout_s=0.75)
    assert bench.traffic.waits_s == []

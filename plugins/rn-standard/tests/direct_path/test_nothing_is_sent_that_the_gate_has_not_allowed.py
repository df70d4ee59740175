"""How an allowed message, motion, request or goal is sent, and what keeps it from being sent.

The gate and the arbiter are real; what would be on ROS is played by the test.
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rn_standard.direct_path import motion_gate as motion_gate_module
from rn_standard.direct_path.arbiter import Ending, MotionArbiter, MotionEnd
from rn_standard.direct_path.fields import load_type
from rn_standard.direct_path.gate import Gate
from rn_standard.direct_path.motion_gate import DirectGate
from roboneuron.contract import Endpoint, JointSample
from roboneuron.errors import NotReadyError, RefusedError, StateError
from roboneuron.feature import ExposedEndpoint, GateRequest, TimedCommand

Ask = Callable[..., GateRequest]
FORWARD = {"linear": {"x": 0.25}}
HERE = JointSample(names=("j1", "j2", "finger"), position=np.array([0.1, 0.2, 0.0]))


class Clock:
    """Stands where a test sets it."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s


class Writer:
    """A topic with subscribers that come when the test says so."""

    topic = "/arm/cmd_vel"

    def __init__(self, clock: Clock) -> None:
        self.published: list[Any] = []
        self.waits_s: list[float] = []
        self.subscribers = 2
        self.listeners = 2
        self.takes_s = 0.0
        self.on_connect: Callable[[], object] = lambda: None
        self._clock = clock

    def listening(self) -> int:
        return self.listeners

    def matched(self) -> int:
        return self.subscribers

    def connect(self, timeout_s: float) -> int:
        self.waits_s.append(timeout_s)
        self._clock.now_s += self.takes_s
        self.on_connect()
        return self.subscribers

    def publish(self, message: Any) -> None:
        self.published.append(message)

    publish_if_possible = publish


class Traffic:
    """Stands for ROS."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self.made = Writer(clock)
        self.is_known = True
        self.waits_s: list[float] = []
        self.now_joints: JointSample | None = HERE
        self.calls: list[tuple[Any, ...]] = []
        self.goals: list[tuple[Any, dict[str, Any]]] = []
        self.served = [True]

    def known_writer(self, exposed: ExposedEndpoint) -> Writer | None:
        return self.made if self.is_known else None

    def writer(self, exposed: ExposedEndpoint) -> Writer:
        return self.made

    def newest_joints(self, exposed: ExposedEndpoint) -> JointSample | None:
        assert isinstance(exposed, ExposedEndpoint)
        return self.now_joints

    def joints(self, exposed: ExposedEndpoint, timeout_s: float) -> JointSample | None:
        self.waits_s.append(timeout_s)
        return self.newest_joints(exposed)

    def is_served(self, exposed: ExposedEndpoint) -> bool:
        assert isinstance(exposed, ExposedEndpoint)
        return self.served.pop(0) if len(self.served) > 1 else self.served[0]

    def cancel_goal(self, exposed: ExposedEndpoint, goal_id: object) -> None: ...

    def link(self) -> Any:
        return SimpleNamespace(call=lambda *told: self.calls.append(told) or "the call")

    def action_client(self, exposed: ExposedEndpoint) -> Any:
        def send(goal: Any, **options: Any) -> str:
            self.goals.append((goal, options))
            return "the future"

        return SimpleNamespace(send_goal_async=send)


class Bench:
    """The gate as features use it."""

    def __init__(self, gate: Gate, clock: Clock) -> None:
        self.clock = clock
        self.gate = gate
        self.checked: list[GateRequest] = []
        self.next: list[GateRequest] = []
        self._check, self._check_next = gate.check, gate.check_next
        gate.check = self.check  # type: ignore[method-assign]
        gate.check_next = self.check_next  # type: ignore[method-assign]
        self.policy = ""
        starts: Any = SimpleNamespace(look=lambda: None, arm_stops=0, reason="")
        self.starts = starts
        self.arbiter = MotionArbiter(gate, lambda exposed: self.policy, starts)
        self.traffic = Traffic(clock)
        self.permitted: list[str] = []
        self.on_permit: Callable[[], object] = lambda: None
        self.is_still = False
        self.listed = SimpleNamespace(exposed=("one",), expose=None, on_change=None, relimit=None)
        self.motion_gate = DirectGate(
            gate,
            self.arbiter,
            self.traffic,  # type: ignore[arg-type]
            self.listed,  # type: ignore[arg-type]
            60.0,
            self.permit,
            lambda: self.is_still,
        )

    def check(self, request: GateRequest) -> Any:
        self.checked.append(request)
        return self._check(request)

    def check_next(self, request: GateRequest) -> None:
        self.next.append(request)
        self._check_next(request)

    def permit(self, exposed: ExposedEndpoint) -> None:
        self.permitted.append(exposed.label)
        self.on_permit()

    @property
    def writer(self) -> Writer:
        return self.traffic.made

    @property
    def sent(self) -> list[Any]:
        return self.writer.published


@pytest.fixture
def bench(make_gate: Callable[..., Gate], monkeypatch: pytest.MonkeyPatch) -> Bench:
    clock = Clock()
    monkeypatch.setattr(motion_gate_module, "time", clock)
    return Bench(make_gate(), clock)


def exposed(endpoint: Endpoint, **changes: Any) -> ExposedEndpoint:
    return ExposedEndpoint(
        robot="arm", namespace="arm", label=endpoint.name, endpoint=endpoint, **changes
    )


@pytest.fixture
def drive(endpoints: dict[str, Endpoint]) -> ExposedEndpoint:
    return exposed(endpoints["velocity"])


@pytest.fixture
def move(endpoints: dict[str, Endpoint]) -> ExposedEndpoint:
    return exposed(endpoints["joints"])


def send_one(bench: Bench, place: ExposedEndpoint, request: GateRequest, how: str) -> Any:
    """Send one message: without blocking, with, or as a motion."""
    if how == "now":
        return bench.motion_gate.publish_now(place, request)
    if how == "motion":
        return play(bench, place, request, timeout_s=0.5)
    return bench.motion_gate.publish(place, request, timeout_s=0.5)


# What features are given


def test_what_features_are_given_is_the_gates_the_arbiters_and_the_allow_lists(
    bench: Bench,
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
    bench: Bench, drive: ExposedEndpoint, ask: Ask
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


def test_a_question_is_answered_by_the_gate(bench: Bench, drive: ExposedEndpoint, ask: Ask) -> None:
    verdict = bench.motion_gate.ask(drive, ask(drive.endpoint, FORWARD, dry_run=True))
    assert (verdict.allowed, verdict.dry_run, verdict.may_send) == (True, True, False)
    far = ask(drive.endpoint, {"linear": {"x": 9.0}}, dry_run=True)
    assert bench.motion_gate.ask(drive, far).rule == "bounds"


def test_a_question_while_a_policy_moves_the_robot_is_answered_no(
    bench: Bench, drive: ExposedEndpoint, ask: Ask
) -> None:
    bench.policy = "The policy 'instant' moves 'arm'."
    request = ask(drive.endpoint, FORWARD, dry_run=True)
    verdict = bench.motion_gate.ask(drive, request)
    assert (verdict.allowed, verdict.dry_run, verdict.rule) == (False, True, "ownership")
    assert verdict.reason.startswith(bench.policy)
    bench.gate.latch.press(who="a person", reason="a test")
    verdict = bench.motion_gate.ask(drive, request)
    assert (verdict.allowed, verdict.rule) == (False, "emergency_stop")


@pytest.mark.parametrize("is_motion", [False, True])
def test_a_dry_run_sends_nothing_and_tells_who_listens(
    bench: Bench, drive: ExposedEndpoint, ask: Ask, is_motion: bool
) -> None:
    request = ask(drive.endpoint, FORWARD, dry_run=True)
    bench.writer.listeners = 3
    if is_motion:
        sent = play(bench, drive, request)
    else:
        sent = bench.motion_gate.publish(drive, request, timeout_s=1.0)
    assert (sent.messages, sent.subscribers) == (0, 3)
    assert sent.verdict.dry_run
    assert sent.verdict.allowed
    assert (bench.sent, bench.writer.waits_s, bench.permitted) == ([], [], [])


# One message


def test_a_message_that_is_allowed_is_sent_once(
    bench: Bench, drive: ExposedEndpoint, ask: Ask
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


def test_the_time_that_sending_takes_is_told(
    bench: Bench, drive: ExposedEndpoint, ask: Ask
) -> None:
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
    bench: Bench, drive: ExposedEndpoint, ask: Ask, how: str
) -> None:
    request = ask(drive.endpoint, {"linear": {"x": 9.0}})
    with pytest.raises(RefusedError, match=r"linear\.x"):
        send_one(bench, drive, request, how)
    assert (bench.sent, bench.permitted) == ([], [])


@pytest.mark.parametrize("how", ["now", "later", "motion"])
def test_a_message_is_not_sent_while_a_policy_moves_the_robot(
    bench: Bench, drive: ExposedEndpoint, ask: Ask, how: str
) -> None:
    bench.policy = "The policy 'instant' moves 'arm'."
    with pytest.raises(RefusedError, match="instant"):
        send_one(bench, drive, ask(drive.endpoint, FORWARD), how)
    assert (bench.sent, bench.checked) == ([], [])


@pytest.mark.parametrize("how", ["now", "later", "motion"])
def test_a_message_is_not_sent_while_the_emergency_stop_is_latched(
    bench: Bench, drive: ExposedEndpoint, ask: Ask, how: str
) -> None:
    bench.gate.latch.press(who="a person", reason="a test")
    with pytest.raises(RefusedError, match="Nothing was sent"):
        send_one(bench, drive, ask(drive.endpoint, FORWARD), how)
    assert bench.sent == []


def test_what_keeps_the_robot_still_keeps_a_message_from_being_sent(
    bench: Bench, drive: ExposedEndpoint, ask: Ask
) -> None:
    def refuse() -> None:
        raise RefusedError("Motion needs a new start.")

    bench.on_permit = refuse
    with pytest.raises(RefusedError, match="new start"):
        bench.motion_gate.publish(drive, ask(drive.endpoint, FORWARD), timeout_s=1.0)
    assert bench.sent == []


@pytest.mark.parametrize("is_now", [False, True])
def test_a_message_carries_the_time_of_sending_when_it_is_to(
    bench: Bench, ask: Ask, endpoints: dict[str, Endpoint], is_now: bool
) -> None:
    for stamped in (False, True):
        pose = exposed(endpoints["pose"])
        request = ask(pose.endpoint, {"poses": [{"position": {"x": 0.5}}]})
        options = {"stamped": True} if stamped else {}
        if is_now:
            assert bench.motion_gate.publish_now(pose, request, **options) is not None
        else:
            bench.motion_gate.publish(pose, request, timeout_s=1.0, **options)
        assert (bench.sent[-1].header.stamp.sec > 0) == stamped


def test_a_gate_that_only_answers_sends_nothing(
    make_gate: Callable[..., Gate], drive: ExposedEndpoint, ask: Ask
) -> None:
    bench = Bench(make_gate(dry_run=True), Clock())
    bench.writer.listeners = 3
    sent = bench.motion_gate.publish(drive, ask(drive.endpoint, FORWARD), timeout_s=1.0)
    assert (sent.messages, sent.subscribers, sent.verdict.may_send) == (0, 3, False)
    now = bench.motion_gate.publish_now(drive, ask(drive.endpoint, FORWARD))
    assert now is not None
    assert (now.messages, now.subscribers) == (0, 2)
    assert (bench.sent, bench.permitted) == ([], [])


# One message, without blocking


def test_a_message_is_sent_at_once_when_nothing_has_to_be_waited_for(
    bench: Bench, drive: ExposedEndpoint, ask: Ask
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
    bench: Bench, drive: ExposedEndpoint, move: ExposedEndpoint, ask: Ask, why: str
) -> None:
    place, request = drive, ask(drive.endpoint, FORWARD)
    if why == "no writer":
        bench.traffic.is_known = False
    elif why == "dry run":
        request = replace(request, dry_run=True)
    elif why == "joints":
        place, request = move, ask(move.endpoint, {"name": ["j1"], "position": [0.1]})
    elif why == "still":
        bench.is_still = True
    else:
        bench.writer.subscribers = 0
    assert bench.motion_gate.publish_now(place, request) is None
    assert (bench.sent, bench.checked) == ([], [])


# Waiting for a subscriber


@pytest.mark.parametrize("how", ["later", "motion"])
def test_a_message_that_nobody_would_receive_is_not_sent(
    bench: Bench, drive: ExposedEndpoint, ask: Ask, how: str
) -> None:
    bench.writer.subscribers = bench.writer.listeners = 0
    request = ask(drive.endpoint, FORWARD)
    with pytest.raises(NotReadyError, match=r"/arm/cmd_vel .* has no subscriber"):
        send_one(bench, drive, request, how)
    assert (bench.sent, bench.writer.waits_s, bench.permitted) == ([], [0.5], [])


@pytest.mark.parametrize(("listeners", "wait_s"), [(0, 0.0), (1, 0.5)])
def test_a_message_that_needs_no_subscriber_waits_only_for_one_that_is_there(
    bench: Bench,
    endpoints: dict[str, Endpoint],
    ask: Ask,
    listeners: int,
    wait_s: float,
) -> None:
    drive = exposed(endpoints["velocity"], require_subscriber=False)
    bench.writer.subscribers, bench.writer.listeners = 0, listeners
    sent = bench.motion_gate.publish(drive, ask(drive.endpoint, FORWARD), timeout_s=0.5)
    assert (sent.messages, sent.subscribers) == (1, 0)
    assert bench.writer.waits_s == [wait_s]


def test_after_a_quarter_of_a_second_the_gate_is_asked_again(
    bench: Bench, drive: ExposedEndpoint, ask: Ask
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
    bench: Bench, drive: ExposedEndpoint, ask: Ask, how: str
) -> None:
    bench.writer.takes_s = 0.3
    bench.writer.on_connect = lambda: bench.gate.latch.press(who="a person", reason="a test")
    with pytest.raises(RefusedError):
        send_one(bench, drive, ask(drive.endpoint, FORWARD), how)
    assert (bench.sent, bench.permitted) == ([], [])


def test_a_policy_that_starts_meanwhile_keeps_a_message_from_being_sent(
    bench: Bench, drive: ExposedEndpoint, ask: Ask
) -> None:
    bench.writer.takes_s = 0.3
    bench.writer.on_connect = lambda: setattr(bench, "policy", "The policy 'late' moves 'arm'.")
    with pytest.raises(RefusedError, match="late"):
        bench.motion_gate.publish(drive, ask(drive.endpoint, FORWARD), timeout_s=1.0)
    assert bench.sent == []


def test_an_owned_motion_is_not_in_its_own_way_after_a_wait(
    bench: Bench, drive: ExposedEndpoint, ask: Ask
) -> None:
    bench.writer.takes_s = 0.3
    assert play(bench, drive, ask(drive.endpoint, FORWARD)).messages == 1


def test_the_joints_are_measured_again_after_a_wait(
    bench: Bench, move: ExposedEndpoint, ask: Ask
) -> None:
    """The arm may have been moved meanwhile: what was near may be far by now."""
    bench.writer.takes_s = 0.3
    there = replace(HERE, position=np.array([0.9, 0.2, 0.0]))
    bench.writer.on_connect = lambda: setattr(bench.traffic, "now_joints", there)
    request = joint_request(ask, move)
    bench.motion_gate.publish(move, request, timeout_s=1.0)
    first, again = bench.checked
    assert (first.joints, again.joints) == (HERE, there)
    assert again.messages == request.messages
    assert (first.repeated, again.repeated) == (False, True)


# Joints


def test_joints_are_measured_when_a_request_has_none(
    bench: Bench, move: ExposedEndpoint, ask: Ask
) -> None:
    value = {"name": ["j1", "j2"], "position": [0.11, 0.2]}
    request = ask(move.endpoint, value, joints=None)
    assert bench.motion_gate.publish(move, request, timeout_s=0.75).messages == 1
    assert bench.traffic.waits_s == [0.75]
    assert bench.checked[0].joints is HERE


def test_joints_that_a_request_has_are_not_measured_again(
    bench: Bench, move: ExposedEndpoint, ask: Ask
) -> None:
    value = {"name": ["j1", "j2"], "position": [0.01, 0.0]}
    bench.motion_gate.publish(move, ask(move.endpoint, value), timeout_s=0.75)
    assert bench.traffic.waits_s == []


def test_joints_are_not_measured_for_what_moves_none(
    bench: Bench, drive: ExposedEndpoint, ask: Ask
) -> None:
    bench.motion_gate.publish(drive, ask(drive.endpoint, FORWARD, joints=None), timeout_s=0.75)
    assert bench.traffic.waits_s == []


# Motion that lasts


def play(
    bench: Bench,
    place: ExposedEndpoint,
    request: GateRequest,
    *,
    commands: Any = None,
    total_s: float = 2.0,
    timeout_s: float = 1.0,
    halt: threading.Event | None = None,
    **options: Any,
) -> Any:
    """Send the request's messages, each due at once."""
    due = [TimedCommand(message=message, due_s=0.0) for message in request.messages]
    return bench.motion_gate.play(
        place,
        request,
        due if commands is None else commands,
        total_s=total_s,
        timeout_s=timeout_s,
        halt=halt or threading.Event(),
        **options,
    )


def test_a_motion_sends_its_commands_and_tells_what_it_sent(
    bench: Bench, drive: ExposedEndpoint, ask: Ask
) -> None:
    request = ask(drive.endpoint, FORWARD)
    sent = play(bench, drive, request, timeout_s=0.75)
    assert bench.sent == [request.messages[0]]
    assert (sent.messages, sent.subscribers, sent.stopped) == (1, 2, False)
    assert sent.verdict.may_send
    assert 0.0 < sent.duration_s < 60.0
    assert bench.writer.waits_s == [0.75]
    assert bench.permitted == ["velocity"]
    bench.motion_gate.check_free(drive)


def test_a_motion_of_joints_measures_them_first(
    bench: Bench, move: ExposedEndpoint, ask: Ask
) -> None:
    request = ask(move.endpoint, {"name": ["j1", "j2"], "position": [0.11, 0.2]}, joints=None)
    assert play(bench, move, request, timeout_s=0.75).messages == 1
    assert bench.traffic.waits_s == [0.75]
    assert bench.checked[0].joints is HERE


def test_a_motion_has_its_robot_to_itself(bench: Bench, drive: ExposedEndpoint, ask: Ask) -> None:
    request = ask(drive.endpoint, FORWARD)
    refusals: list[str] = []

    def commands() -> Any:
        with pytest.raises(RefusedError) as caught:
            bench.motion_gate.check_free(drive)
        refusals.append(caught.value.message)
        yield TimedCommand(message=request.messages[0], due_s=0.0)

    play(bench, drive, request, commands=commands())
    assert refusals == ["publish_velocity moves 'arm' now."]


def test_a_motion_that_is_refused_waits_for_nobody(
    bench: Bench, drive: ExposedEndpoint, ask: Ask
) -> None:
    with pytest.raises(RefusedError, match=r"linear\.x"):
        play(bench, drive, ask(drive.endpoint, {"linear": {"x": 9.0}}))
    assert (bench.sent, bench.writer.waits_s, bench.permitted) == ([], [], [])
    bench.motion_gate.check_free(drive)


def test_a_gate_that_only_answers_plays_nothing(
    make_gate: Callable[..., Gate], drive: ExposedEndpoint, ask: Ask
) -> None:
    bench = Bench(make_gate(dry_run=True), Clock())
    bench.writer.listeners = 3
    sent = play(bench, drive, ask(drive.endpoint, FORWARD))
    assert (sent.messages, sent.subscribers, sent.verdict.may_send) == (0, 3, False)
    assert (bench.sent, bench.writer.waits_s) == ([], [])


def test_what_keeps_the_robot_still_keeps_a_motion_from_beginning(
    bench: Bench, drive: ExposedEndpoint, ask: Ask
) -> None:
    def refuse() -> None:
        raise RefusedError("Motion needs a new start.")

    bench.on_permit = refuse
    with pytest.raises(RefusedError, match="new start"):
        play(bench, drive, ask(drive.endpoint, FORWARD))
    assert bench.sent == []
    bench.motion_gate.check_free(drive)


def test_a_message_that_was_not_known_beforehand_is_judged_before_it_is_sent(
    bench: Bench, drive: ExposedEndpoint, ask: Ask
) -> None:
    request = ask(drive.endpoint, FORWARD)
    far = ask(drive.endpoint, {"linear": {"x": 9.0}}).messages[0]
    commands = [
        TimedCommand(message=request.messages[0], due_s=0.0),
        TimedCommand(message=far, due_s=0.0),
    ]
    with pytest.raises(RefusedError, match=r"linear\.x"):
        play(bench, drive, request, commands=commands)
    assert bench.sent == [request.messages[0]]
    assert [one.messages for one in bench.next] == [(far,)]


def test_a_motion_that_is_cancelled_ends_with_its_stop_message_and_says_so(
    bench: Bench, endpoints: dict[str, Endpoint], ask: Ask
) -> None:
    drive = exposed(replace(endpoints["velocity"], stop_message="zero"))
    request = ask(drive.endpoint, FORWARD)
    halt = threading.Event()

    def commands() -> Any:
        yield TimedCommand(message=request.messages[0], due_s=0.0)
        halt.set()
        yield TimedCommand(message=request.messages[0], due_s=0.0)

    with pytest.raises(
        StateError, match=r"of 2\.00 s, the stop message was sent \(it is near\): The call was"
    ):
        play(bench, drive, request, commands=commands(), halt=halt, details=lambda: "it is near")
    assert [message.linear.x for message in bench.sent] == [0.25, 0.0]
    bench.motion_gate.check_free(drive)


def test_a_motion_that_comes_to_its_end_with_a_stop_message_says_so(
    bench: Bench, endpoints: dict[str, Endpoint], ask: Ask
) -> None:
    drive = exposed(replace(endpoints["velocity"], stop_message="zero"))
    sent = play(bench, drive, ask(drive.endpoint, FORWARD))
    assert (sent.messages, sent.stopped) == (2, True)


def test_joints_of_a_motion_that_is_cancelled_hold_where_they_are(
    bench: Bench, move: ExposedEndpoint, ask: Ask
) -> None:
    request = ask(move.endpoint, {"name": ["j1", "j2"], "position": [0.11, 0.2]}, joints=HERE)
    halt = threading.Event()

    def commands() -> Any:
        yield TimedCommand(message=request.messages[0], due_s=0.0)
        bench.traffic.now_joints = replace(HERE, position=np.array([0.105, 0.2, 0.0]))
        halt.set()
        yield TimedCommand(message=request.messages[0], due_s=0.0)

    with pytest.raises(StateError, match=r"s, the joints were told to hold: The call was"):
        play(bench, move, request, commands=commands(), halt=halt)
    assert list(bench.sent[-1].position) == [0.105, 0.2]


def test_what_a_motion_did_not_send_does_not_count_against_the_rate(
    bench: Bench, drive: ExposedEndpoint, ask: Ask
) -> None:
    released: list[GateRequest] = []
    bench.gate.release = released.append  # type: ignore[method-assign]
    request = ask(drive.endpoint, FORWARD)
    play(bench, drive, request)
    assert [one.messages for one in released] == [request.messages]

    def fail() -> Any:
        raise StateError("a test")
        yield

    with pytest.raises(StateError, match="a test"):
        play(bench, drive, request, commands=fail())
    assert len(released) == 2


# Services


def test_a_request_is_sent_to_its_service(
    bench: Bench, endpoints: dict[str, Endpoint], ask: Ask
) -> None:
    enable = exposed(endpoints["enable"])
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
    bench: Bench, endpoints: dict[str, Endpoint], ask: Ask
) -> None:
    enable = exposed(endpoints["enable"])
    bench.policy = "The policy 'instant' moves 'arm'."
    with pytest.raises(RefusedError, match="instant"):
        bench.motion_gate.send_request(enable, ask(enable.endpoint, {"data": True}), print)
    assert (bench.traffic.calls, bench.checked) == ([], [])


def test_a_dry_run_of_a_request_calls_nobody(
    bench: Bench, endpoints: dict[str, Endpoint], ask: Ask
) -> None:
    enable = exposed(endpoints["enable"])
    request = ask(enable.endpoint, {"data": True}, dry_run=True)
    verdict, call = bench.motion_gate.send_request(enable, request, print)
    assert (verdict.allowed, call) == (True, None)
    assert (bench.traffic.calls, bench.permitted) == ([], [])


def test_a_query_is_answered_in_a_dry_run_and_while_a_policy_moves_the_robot(
    make_gate: Callable[..., Gate], endpoints: dict[str, Endpoint], ask: Ask
) -> None:
    query = Endpoint(
        name="state",
        kind="read",
        topic="state",
        type="rcl_interfaces/srv/GetParameters",
        summary="ask",
    )
    bench = Bench(make_gate(query), Clock())
    bench.policy = "The policy 'instant' moves 'arm'."
    state = exposed(query)
    request = ask(query, {}, dry_run=True)
    verdict, call = bench.motion_gate.send_request(state, request, print)
    assert (verdict.allowed, call) == (True, "the call")
    assert bench.permitted == [], "it asks for no motion"
    bench = Bench(make_gate(dry_run=True), Clock())
    verdict, call = bench.motion_gate.send_request(state, ask(query, {}), print)
    assert (verdict.allowed, call) == (False, None), "it is not exposed"
    assert bench.traffic.calls == []


# Goals


GO = Endpoint(
    name="go",
    kind="action",
    topic="go",
    type="test_msgs/action/Fibonacci",
    summary="go",
)


class Goals:
    """A goal on its way."""

    def __init__(self, make_gate: Callable[..., Gate], ask: Ask, endpoint: Endpoint = GO) -> None:
        self.bench = Bench(make_gate(endpoint), Clock())
        self.place = exposed(endpoint)
        goal = load_type(endpoint.type).Goal(order=3)
        self.request = replace(ask(endpoint), messages=(goal,))
        self.feedback: list[Any] = []
        self.slept_s: list[float] = []
        self.on_sleep: Callable[[], object] = lambda: None
        self.checks = 0
        self.must_end_at = 0
        self.motion: Any = SimpleNamespace(check=self.check, sleep_until=self.sleep_until)

    def check(self) -> None:
        self.checks += 1
        if self.checks == self.must_end_at:
            raise StateError("The call was cancelled.")

    def sleep_until(self, end_s: float) -> None:
        clock = self.bench.clock
        self.slept_s.append(round(end_s - clock.now_s, 6))
        clock.now_s = end_s
        self.on_sleep()

    def send(self, server_s: float = 0.5) -> tuple[Any, Any]:
        return self.bench.motion_gate.send_goal(
            self.place,
            self.request,
            self.motion,
            "an id",  # type: ignore[arg-type]
            server_s,
            self.feedback.append,
        )

    @property
    def sent(self) -> list[tuple[Any, dict[str, Any]]]:
        return self.bench.traffic.goals


@pytest.fixture
def goals(make_gate: Callable[..., Gate], ask: Ask, monkeypatch: pytest.MonkeyPatch) -> Goals:
    made = Goals(make_gate, ask)
    monkeypatch.setattr(motion_gate_module, "time", made.bench.clock)
    return made


def test_a_goal_is_sent_to_its_action_with_its_id(goals: Goals) -> None:
    verdict, future = goals.send()
    assert verdict.may_send
    assert future == "the future"
    ((goal, options),) = goals.sent
    assert goal is goals.request.messages[0]
    assert options["goal_uuid"] == "an id"
    options["feedback_callback"](SimpleNamespace(feedback="half way"))
    assert goals.feedback == ["half way"]
    assert goals.bench.permitted == ["go"]
    assert len(goals.bench.checked) == 1
    assert goals.slept_s == []


def test_a_goal_that_is_refused_waits_for_nobody(goals: Goals) -> None:
    goals.bench.traffic.served = [False]
    goals.request = replace(goals.request, role="viewer")
    with pytest.raises(RefusedError, match="role"):
        goals.send()
    assert (goals.sent, goals.slept_s) == ([], [])


def test_a_dry_run_of_a_goal_sends_none(goals: Goals) -> None:
    goals.request = replace(goals.request, dry_run=True)
    verdict, future = goals.send()
    assert (verdict.allowed, future) == (True, None)
    assert (goals.sent, goals.bench.permitted) == ([], [])


def test_a_goal_waits_for_its_server_and_is_judged_again(goals: Goals) -> None:
    goals.bench.traffic.served = [False, False, False, True]
    verdict, _ = goals.send()
    assert verdict.may_send
    assert goals.slept_s == [0.02, 0.02]
    assert [request.repeated for request in goals.bench.checked] == [False, True]
    assert goals.bench.checked[1].joints is None
    assert len(goals.sent) == 1


def test_a_goal_that_nobody_serves_is_not_sent(goals: Goals) -> None:
    goals.bench.traffic.served = [False]
    with pytest.raises(NotReadyError, match="The action /arm/go has no server: nothing was sent"):
        goals.send(0.05)
    assert goals.slept_s == [0.02, 0.02, 0.01]
    assert (goals.sent, goals.bench.permitted) == ([], [])


def test_a_stop_while_a_goal_waits_for_its_server_keeps_it_from_being_sent(goals: Goals) -> None:
    goals.bench.traffic.served = [False, False, True]
    goals.on_sleep = lambda: goals.bench.gate.latch.press(who="a person", reason="a test")
    with pytest.raises(RefusedError):
        goals.send()
    assert (goals.sent, goals.bench.permitted) == ([], [])


@pytest.mark.parametrize("number", [1, 2])
def test_a_motion_that_has_to_end_sends_no_goal(goals: Goals, number: int) -> None:
    goals.must_end_at = number
    with pytest.raises(StateError, match="cancelled"):
        goals.send()
    assert goals.sent == []
    assert len(goals.bench.checked) == number - 1
    assert goals.bench.permitted == ["go"] * (number - 1)


def test_the_joints_of_a_goal_are_measured_again_after_a_wait(
    make_gate: Callable[..., Gate], ask: Ask, monkeypatch: pytest.MonkeyPatch
) -> None:
    goals = Goals(make_gate, ask)
    monkeypatch.setattr(motion_gate_module, "time", goals.bench.clock)
    checked: list[GateRequest] = []

    def check(request: GateRequest) -> Any:
        checked.append(request)
        return SimpleNamespace(may_send=True)

    goals.bench.gate.check = check  # type: ignore[method-assign]
    goals.place = exposed(replace(GO, joint_limited=True))
    goals.bench.traffic.served = [False, True]
    goals.send()
    assert [request.joints is HERE for request in checked] == [False, True]


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
    gate = make_gate(dry_run=True)
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


def joint_request(ask: Ask, move: ExposedEndpoint, **changes: Any) -> GateRequest:
    value = {"name": ["j1", "j2"], "position": [0.11, 0.2]}
    return ask(move.endpoint, value, **({"joints": HERE} | changes))


def test_how_much_more_time_a_path_needs_is_asked_of_the_path(
    make_gate: Callable[..., Gate], ask: Ask, move: ExposedEndpoint
) -> None:
    path = Path(2.5)
    gate = make_gate(path=lambda: path)
    assert gate.slowdown(joint_request(ask, move)) == 2.5
    ((legs, joints),) = path.asked
    assert len(legs) == 1
    assert joints is HERE


def test_without_joints_a_path_or_an_endpoint_no_more_time_is_needed(
    make_gate: Callable[..., Gate], ask: Ask, move: ExposedEndpoint
) -> None:
    path = Path(2.5)
    gate = make_gate(path=lambda: path)
    assert gate.slowdown(joint_request(ask, move, joints=None)) == 1.0
    assert gate.slowdown(joint_request(ask, move, endpoint="unknown")) == 1.0
    assert gate.slowdown(joint_request(ask, move, robot="another")) == 1.0
    assert path.asked == []
    assert make_gate().slowdown(joint_request(ask, move)) == 1.0


def test_a_path_that_cannot_be_judged_is_refused(
    make_gate: Callable[..., Gate], ask: Ask, move: ExposedEndpoint
) -> None:
    gate = make_gate(path=lambda: Path(NotReadyError("no description", hint="Start it.")))
    with pytest.raises(RefusedError, match="cannot be checked: no description") as caught:
        gate.slowdown(joint_request(ask, move))
    assert caught.value.hint == "Start it."
    gate = make_gate(path=lambda: Path(RefusedError("it is too far")))
    with pytest.raises(RefusedError, match=r"^it is too far"):
        gate.slowdown(joint_request(ask, move))


# How a motion ended


def test_a_motion_that_came_to_its_end_has_no_cause() -> None:
    MotionEnd(after_s=1.0).check()


def test_a_motion_that_ended_early_raises_its_cause_with_what_became_of_it() -> None:
    cause = RefusedError("The emergency stop is latched.", hint="Ask a person.")
    end = MotionEnd(
        after_s=1.234, total_s=5.678, ending=Ending.HOLD, details="at home", cause=cause
    )
    with pytest.raises(RefusedError) as caught:
        end.check()
    assert caught.value.message == (
        "Ended after 1.23 of 5.68 s, the joints were told to hold (at home): "
        "The emergency stop is latched."
    )
    assert caught.value.hint == "Ask a person."
    assert caught.value.__cause__ is cause
    with pytest.raises(RefusedError, match=r"^Ended after 1\.00 s, nothing could be sent to end"):
        MotionEnd(after_s=1.0, cause=cause).check()


# The emergency stop


def test_the_emergency_stop_sends_what_ends_each_motion_and_wakes_its_thread(
    bench: Bench, drive: ExposedEndpoint, endpoints: dict[str, Endpoint]
) -> None:
    sent: list[str] = []
    other = exposed(endpoints["scan"], moves=False)
    halt = threading.Event()
    with (
        bench.arbiter.claim(drive, "one", halt) as motion,
        bench.arbiter.claim(other, "another", threading.Event()) as second,
    ):
        motion.stop_now = lambda: sent.append("one")
        second.stop_now = lambda: sent.append("another")
        bench.gate.latch.press(who="a person", reason="a test")
        assert sorted(sent) == ["another", "one"]
        assert halt.is_set()
        with pytest.raises(RefusedError):
            motion.check()

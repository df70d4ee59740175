"""Motion that lasts: what it sends, how it ends, and what is told of that."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from roboneuron.contract import Endpoint, JointSample
from roboneuron.direct_path.delivery import Ending, MotionEnd
from roboneuron.direct_path.gate import Gate
from roboneuron.errors import NotReadyError, RefusedError, StateError
from roboneuron.feature import ExposedEndpoint, GateRequest, TimedCommand

Ask = Callable[..., GateRequest]
FORWARD = {"linear": {"x": 0.25}}


# Motion that lasts


def test_a_motion_sends_its_commands_and_tells_what_it_sent(
    bench: Any, drive: ExposedEndpoint, ask: Ask
) -> None:
    request = ask(drive.endpoint, FORWARD)
    sent = bench.play(drive, request, timeout_s=0.75)
    assert bench.sent == [request.messages[0]]
    assert (sent.messages, sent.subscribers, sent.stopped) == (1, 2, False)
    assert sent.verdict.may_send
    assert 0.0 < sent.duration_s < 60.0
    assert bench.writer.waits_s == [0.75]
    assert bench.permitted == ["velocity"]
    bench.motion_gate.check_free(drive)


def test_a_motion_of_joints_measures_them_first(
    bench: Any, move: ExposedEndpoint, ask: Ask, here: JointSample
) -> None:
    request = ask(move.endpoint, {"name": ["j1", "j2"], "position": [0.11, 0.2]}, joints=None)
    assert bench.play(move, request, timeout_s=0.75).messages == 1
    assert bench.traffic.waits_s == [0.75]
    assert bench.checked[0].joints is here


def test_a_motion_has_its_robot_to_itself(bench: Any, drive: ExposedEndpoint, ask: Ask) -> None:
    request = ask(drive.endpoint, FORWARD)
    refusals: list[str] = []

    def commands() -> Any:
        with pytest.raises(RefusedError) as caught:
            bench.motion_gate.check_free(drive)
        refusals.append(caught.value.message)
        yield TimedCommand(message=request.messages[0], due_s=0.0)

    bench.play(drive, request, commands=commands())
    assert refusals == ["publish_velocity moves 'arm' now."]


def test_a_motion_that_is_refused_waits_for_nobody(
    bench: Any, drive: ExposedEndpoint, ask: Ask
) -> None:
    with pytest.raises(RefusedError, match=r"linear\.x"):
        bench.play(drive, ask(drive.endpoint, {"linear": {"x": 9.0}}))
    assert (bench.sent, bench.writer.waits_s, bench.permitted) == ([], [], [])
    bench.motion_gate.check_free(drive)


def test_a_gate_that_only_answers_plays_nothing(
    make_gate: Callable[..., Gate], drive: ExposedEndpoint, ask: Ask, make_bench: Callable[..., Any]
) -> None:
    bench = make_bench(make_gate(simulated=True))
    bench.writer.listeners = 3
    sent = bench.play(drive, ask(drive.endpoint, FORWARD))
    assert (sent.messages, sent.subscribers, sent.verdict.may_send) == (0, 3, False)
    assert (bench.sent, bench.writer.waits_s) == ([], [])


def test_what_keeps_the_robot_still_keeps_a_motion_from_beginning(
    bench: Any, drive: ExposedEndpoint, ask: Ask
) -> None:
    def refuse() -> None:
        raise RefusedError("Motion needs a new start.")

    bench.on_permit = refuse
    with pytest.raises(RefusedError, match="new start"):
        bench.play(drive, ask(drive.endpoint, FORWARD))
    assert bench.sent == []
    bench.motion_gate.check_free(drive)


def test_a_message_that_was_not_known_beforehand_is_judged_before_it_is_sent(
    bench: Any, drive: ExposedEndpoint, ask: Ask
) -> None:
    request = ask(drive.endpoint, FORWARD)
    far = ask(drive.endpoint, {"linear": {"x": 9.0}}).messages[0]
    commands = [
        TimedCommand(message=request.messages[0], due_s=0.0),
        TimedCommand(message=far, due_s=0.0),
    ]
    with pytest.raises(RefusedError, match=r"linear\.x"):
        bench.play(drive, request, commands=commands)
    assert bench.sent == [request.messages[0]]
    assert [one.messages for one in bench.next] == [(far,)]


def test_a_motion_that_is_cancelled_ends_with_its_stop_message_and_says_so(
    bench: Any, endpoints: dict[str, Endpoint], ask: Ask, expose: Callable[..., ExposedEndpoint]
) -> None:
    drive = expose(replace(endpoints["velocity"], stop_message="zero"))
    request = ask(drive.endpoint, FORWARD)
    halt = threading.Event()

    def commands() -> Any:
        yield TimedCommand(message=request.messages[0], due_s=0.0)
        halt.set()
        yield TimedCommand(message=request.messages[0], due_s=0.0)

    with pytest.raises(
        StateError,
        match=r"of the planned 2\.00 s; the stop message was sent \(it is near\): The call was",
    ):
        bench.play(drive, request, commands=commands(), halt=halt, details=lambda: "it is near")
    assert [message.linear.x for message in bench.sent] == [0.25, 0.0]
    bench.motion_gate.check_free(drive)


def test_a_motion_whose_arm_is_not_measured_any_more_tells_the_stop_behind_it(
    bench: Any, drive: ExposedEndpoint, ask: Ask
) -> None:
    request = ask(drive.endpoint, FORWARD)

    def commands(reason: str) -> Any:
        yield TimedCommand(message=request.messages[0], due_s=0.0)
        if reason:
            bench.starts.arm_stops, bench.starts.reason = 1, reason
        raise NotReadyError("Control publishes no pose.")

    with pytest.raises(NotReadyError, match="no pose"):
        bench.play(drive, request, commands=commands(""))
    with pytest.raises(StateError, match="robot has ended by itself"):
        bench.play(drive, request, commands=commands("robot has ended by itself"))


def test_a_motion_that_comes_to_its_end_with_a_stop_message_says_so(
    bench: Any, endpoints: dict[str, Endpoint], ask: Ask, expose: Callable[..., ExposedEndpoint]
) -> None:
    drive = expose(replace(endpoints["velocity"], stop_message="zero"))
    sent = bench.play(drive, ask(drive.endpoint, FORWARD))
    assert (sent.messages, sent.stopped) == (2, True)


def test_joints_of_a_motion_that_is_cancelled_hold_where_they_are(
    bench: Any, move: ExposedEndpoint, ask: Ask, here: JointSample
) -> None:
    request = ask(move.endpoint, {"name": ["j1", "j2"], "position": [0.11, 0.2]}, joints=here)
    halt = threading.Event()

    def commands() -> Any:
        yield TimedCommand(message=request.messages[0], due_s=0.0)
        bench.traffic.now_joints = replace(here, position=np.array([0.105, 0.2, 0.0]))
        halt.set()
        yield TimedCommand(message=request.messages[0], due_s=0.0)

    with pytest.raises(StateError, match=r"s; the joints were told to hold: The call was"):
        bench.play(move, request, commands=commands(), halt=halt)
    assert list(bench.sent[-1].position) == [0.105, 0.2]


def test_what_a_motion_did_not_send_does_not_count_against_the_rate(
    bench: Any, drive: ExposedEndpoint, ask: Ask
) -> None:
    released: list[GateRequest] = []
    bench.gate.release = released.append  # type: ignore[method-assign]
    request = ask(drive.endpoint, FORWARD)
    bench.play(drive, request)
    assert [one.messages for one in released] == [request.messages]

    def fail() -> Any:
        raise StateError("a test")
        yield

    with pytest.raises(StateError, match="a test"):
        bench.play(drive, request, commands=fail())
    assert len(released) == 2


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
        "Ended early, after 1.23 s of the planned 5.68 s; the joints were told to hold (at home): "
        "The emergency stop is latched."
    )
    assert caught.value.hint == "Ask a person."
    assert caught.value.__cause__ is cause
    with pytest.raises(
        RefusedError, match=r"^Ended early, after 1\.00 s; nothing could be sent to end"
    ):
        MotionEnd(after_s=1.0, cause=cause).check()


# The emergency stop


def test_the_emergency_stop_sends_what_ends_each_motion_and_wakes_its_thread(
    bench: Any,
    drive: ExposedEndpoint,
    endpoints: dict[str, Endpoint],
    expose: Callable[..., ExposedEndpoint],
) -> None:
    sent: list[str] = []
    other = expose(endpoints["scan"], moves=False)
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


@pytest.mark.parametrize(
    ("total_s", "details", "text"),
    [
        (
            None,
            "",
            "Ended early, after 1.50 s; nothing could be sent to end it: The call was cancelled.",
        ),
        (
            2.0,
            "at home",
            "Ended early, after 1.50 s of the planned 2.00 s; nothing could be sent to end it "
            "(at home): The call was cancelled.",
        ),
    ],
)
def test_a_motion_that_ended_early_tells_when_and_how(
    total_s: float | None, details: str, text: str
) -> None:
    cause = StateError("The call was cancelled.", hint="Ask again.")
    end = MotionEnd(after_s=1.5, total_s=total_s, details=details, cause=cause)
    with pytest.raises(StateError) as caught:
        end.check()
    assert (caught.value.message, caught.value.hint) == (text, "Ask again.")
    assert end.sent == 0

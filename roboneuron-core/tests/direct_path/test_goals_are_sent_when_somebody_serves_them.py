"""How a goal is sent to its action, and what keeps it from being sent."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from roboneuron.contract import Endpoint, JointSample
from roboneuron.direct_path.fields import load_type
from roboneuron.direct_path.gate import Gate
from roboneuron.errors import NotReadyError, RefusedError, StateError
from roboneuron.feature import ExposedEndpoint, GateRequest

Ask = Callable[..., GateRequest]
FORWARD = {"linear": {"x": 0.25}}


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

    def __init__(self, bench: Any, ask: Ask, place: ExposedEndpoint) -> None:
        self.bench = bench
        self.place = place
        goal = load_type(place.endpoint.type).Goal(order=3)
        self.request = replace(ask(place.endpoint), messages=(goal,))
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
def goals(
    make_gate: Callable[..., Gate],
    ask: Ask,
    expose: Callable[..., ExposedEndpoint],
    make_bench: Callable[..., Any],
) -> Goals:
    return Goals(make_bench(make_gate(GO)), ask, expose(GO))


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


def test_a_goal_is_sent_on_the_thread_that_takes_its_answer(goals: Goals) -> None:
    """On another, rclpy loses an answer that comes before it has noted what it waits for."""
    goals.send()
    assert goals.bench.traffic.sent_on_executor == [True]


def test_a_goal_that_is_refused_waits_for_nobody(goals: Goals) -> None:
    goals.bench.traffic.served = [False]
    goals.request = replace(goals.request, role="viewer")
    with pytest.raises(RefusedError, match="role"):
        goals.send()
    assert (goals.sent, goals.slept_s) == ([], [])


def test_a_simulated_request_of_a_goal_sends_none(goals: Goals) -> None:
    goals.request = replace(goals.request, simulated=True)
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
    goals: Goals, expose: Callable[..., ExposedEndpoint], here: JointSample
) -> None:
    checked: list[GateRequest] = []

    def check(request: GateRequest) -> Any:
        checked.append(request)
        return SimpleNamespace(may_send=True)

    goals.bench.gate.check = check  # type: ignore[method-assign]
    goals.place = expose(replace(GO, joint_limited=True))
    goals.bench.traffic.served = [False, True]
    goals.send()
    assert [request.joints is here for request in checked] == [False, True]

"""All steps of a gesture, and a straight motion, are judged before the first one moves the arm."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import anyio
import numpy as np
import pytest

from rn_standard.tasks import moving
from rn_standard.tasks.moving import Mover, MoveToArguments
from rn_standard.tasks.named_targets import Places
from rn_standard.tasks.options import GestureOptions, PlaceOptions, PostureOptions, TasksSections
from roboneuron import RefusedError
from roboneuron.tools.arm import bounds
from roboneuron.tools.arm.end_effector import EndEffectorMover

OPTIONS = TasksSections(
    gestures={"nod": GestureOptions(steps=({"b": 0.3}, {"b": -0.3}), times=2)},
    postures={"rest": PostureOptions(joints={"b": 0.0})},
    places={"shelf": PlaceOptions(position_m=(0.9, 0.0, 0.3))},
)
STEPS = [{"b": 0.3}, {"b": -0.3}, {"b": 0.3}, {"b": -0.3}]


class Judge:
    """Keeps what it judges, and refuses it if told to."""

    def __init__(self, *, refuses: bool) -> None:
        self.refuses = refuses
        self.judged: list[list[Mapping[str, float]]] = []

    def check_path(
        self, steps: Sequence[Mapping[str, float]], context: Any, rehearsal: Any = None
    ) -> None:
        self.judged.append(list(steps))
        if self.refuses:
            raise RefusedError("steps[3]: The TCP would enter the pane.", rule="zone")


class Calls:
    """Moves everything, until the call with this number is refused; keeps the calls."""

    def __init__(self, refused_at: int = 99) -> None:
        self.made: list[Mapping[str, object]] = []
        self._refused_at = refused_at

    async def __call__(self, name: str, order: Mapping[str, object], _: Any) -> dict[str, Any]:
        if len(self.made) == self._refused_at:
            raise RefusedError("The limits have changed.", hint="Look.", rule="zone")
        self.made.append(order)
        return {"duration_s": 0.5, "error": 0.0}


@pytest.fixture
def move() -> Callable[..., Any]:
    def move(name: str, calls: Calls, judge: Judge | None, tool: Any = None) -> Any:
        host: Any = SimpleNamespace(
            tools=SimpleNamespace(get=lambda _: SimpleNamespace(handler=tool)),
            loop=SimpleNamespace(starts=SimpleNamespace(arm_stops=0, reason="")),
            config=SimpleNamespace(robot=SimpleNamespace(name="none")),
            gate=SimpleNamespace(exposed=()),
        )

        async def run(work: Callable[[Any], Any]) -> Any:
            return work(lambda _: None)

        places = Places(host, OPTIONS)
        mover = Mover(host, places, lambda arm: pytest.fail(arm), calls, judge)
        context: Any = SimpleNamespace(run=run, ask=None, who="a", role="operator", simulated=False)
        return anyio.run(mover._through, name, *places.motions()[name], 1.0, context)

    return move


@pytest.mark.parametrize("by_tool", [True, False])
def test_a_gesture_with_a_step_that_is_refused_moves_nothing(
    move: Callable[..., Any], by_tool: bool
) -> None:
    judge, calls = Judge(refuses=True), Calls()
    with pytest.raises(RefusedError) as caught:
        move("nod", calls, None if by_tool else judge, judge)
    assert (caught.value.rule, calls.made, judge.judged) == ("zone", [], [STEPS])


def test_a_gesture_that_is_allowed_is_judged_once_and_made(move: Callable[..., Any]) -> None:
    judge, calls = Judge(refuses=False), Calls()
    assert move("nod", calls, judge).took_s == 2.0
    assert ([one["positions"] for one in calls.made], judge.judged) == (STEPS, [STEPS])


def test_a_posture_is_judged_by_its_call(move: Callable[..., Any]) -> None:
    judge, calls = Judge(refuses=True), Calls()
    move("rest", calls, judge)
    assert (len(calls.made), judge.judged) == (1, [])


def test_a_step_that_is_refused_later_tells_after_which_the_arm_stands(
    move: Callable[..., Any],
) -> None:
    calls = Calls(refused_at=2)
    with pytest.raises(RefusedError, match=r"steps\[1\]") as caught:
        move("nod", calls, Judge(refuses=False))
    assert (caught.value.rule, caught.value.hint, len(calls.made)) == ("zone", "Look.", 2)


@pytest.mark.parametrize(
    "arguments",
    [
        {"position_m": [0.9, 0.0, 0.3]},
        {"position_m": [0.5, 0.0, 0.1], "above_m": 0.2},
        {"name": "shelf"},
    ],
)
def test_a_straight_motion_that_would_not_end_moves_nothing(
    monkeypatch: pytest.MonkeyPatch, arguments: dict[str, Any]
) -> None:
    routes: list[Any] = []

    def check_route(host: Any, mover: Any, subject: str, route: Any, speed: float) -> None:
        routes.append(route)
        raise RefusedError("It is out of reach.", rule="out_of_reach")

    monkeypatch.setattr(bounds, "check_route", check_route)
    monkeypatch.setattr(moving, "profile_of", lambda host: None)
    handler = object.__new__(EndEffectorMover)
    host: Any = SimpleNamespace(
        tools=SimpleNamespace(get=lambda _: SimpleNamespace(handler=handler)),
        config=SimpleNamespace(robot=SimpleNamespace(name="none")),
        gate=SimpleNamespace(exposed=()),
    )

    async def run(work: Callable[[Any], Any]) -> Any:
        return work(lambda _: None)

    calls = Calls()
    here = (np.array([0.4, 0.0, 0.3]), np.eye(3))
    mover = Mover(host, Places(host, OPTIONS), lambda arm: here, calls)
    context: Any = SimpleNamespace(run=run, ask=None, who="a", role="operator", simulated=False)
    with pytest.raises(RefusedError):
        anyio.run(mover.go, MoveToArguments(**arguments), context)
    assert calls.made == []
    assert [len(route) for route in routes] == [1 + ("above_m" in arguments)]

"""Every call passes the interceptors in the order of their phases, whoever added them when."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import anyio
import pytest
from mcp import types

from roboneuron.errors import InternalError, NotReadyError, RefusedError, UnsafeError
from roboneuron.server.interception import (
    CallPhase,
    EndedCall,
    IncomingCall,
    Interceptor,
    Proceed,
    Simulator,
)
from roboneuron.server.registry import ERROR_META, ToolRegistry
from roboneuron.server.tool import Answer, Arguments, CallContext, Result, Tool

OF_FEATURES = [phase for phase in CallPhase if phase >= CallPhase.READINESS]


class Distance(Arguments):
    """How far to go."""

    far_m: float = 0.0
    preview: bool = False


class Asked(Arguments):
    """What is simulated."""

    tool: str
    arguments: dict[str, object]


class Said(Result):
    """What was done."""

    said: str


class Robot:
    """Tools that note that they were called, and a registry of them."""

    def __init__(self, **more: Any) -> None:
        self.done: list[str] = []
        self.ended: list[EndedCall] = []
        self.registry = ToolRegistry(
            [
                self.tool("drive"),
                self.tool("look", read_only=True),
                self.tool("emergency_stop", always=True, role="viewer"),
                self.tool("rehearse", arguments=Asked, read_only=True),
            ],
            on_end=self.ended.append,
            **more,
        )

    def tool(self, name: str, arguments: type[Arguments] = Distance, **more: Any) -> Tool[Any]:
        """A tool that notes its call."""

        async def handler(given: Arguments, context: CallContext) -> Said:
            self.done.append(name)
            return Said(said=f"{name} {given.given()}")

        return Tool(
            name=name,
            title=name,
            description=f"Does {name}.",
            arguments=arguments,
            result=Said,
            handler=handler,
            **more,
        )

    def add(self, *phases: CallPhase, **more: Any) -> None:
        """Add an interceptor to each phase that notes its name."""
        self.registry.chain.intercept(self.noting(phase, **more) for phase in phases)

    def noting(self, phase: CallPhase, **more: Any) -> Interceptor:
        """An interceptor that notes its phase."""

        async def around(call: IncomingCall, proceed: Proceed) -> Answer:
            self.done.append(phase.name)
            return await proceed(call)

        return Interceptor(name=phase.name, phase=phase, around=around, **more)

    def call(
        self, name: str, arguments: Mapping[str, Any] | None = None, role: str = "operator"
    ) -> types.CallToolResult:
        """Call a tool."""
        context: Any = SimpleNamespace(who="agent", role=role)
        return anyio.run(self.registry.call, name, arguments or {}, context)


def code_of(answer: types.CallToolResult) -> str:
    assert answer.is_error
    return str((answer.meta or {})[ERROR_META]["code"])


def refuse(tool: Tool[Any], context: CallContext) -> None:
    raise RefusedError("It is Monday.", rule="monday")


def test_phases_come_in_their_order_whatever_the_order_of_addition() -> None:
    robot = Robot()
    for phase in reversed(OF_FEATURES):
        robot.add(phase)
    assert not robot.call("drive").is_error
    assert robot.done == [*(phase.name for phase in OF_FEATURES), "drive"]


def test_within_a_phase_who_was_added_first_comes_first() -> None:
    robot = Robot()
    seen: list[str] = []
    robot.registry.chain.intercept(
        Interceptor(
            name=name, phase=CallPhase.PERMISSION, check=lambda *_, name=name: seen.append(name)
        )
        for name in "abc"
    )
    robot.call("drive")
    assert seen == ["a", "b", "c"]


def test_arguments_are_checked_before_a_person_is_asked_and_after_permission() -> None:
    robot = Robot()
    robot.add(CallPhase.ARBITRATION, CallPhase.CONFIRMATION)
    assert code_of(robot.call("drive", {"far_m": "far"})) == "invalid_input"
    assert robot.done == ["ARBITRATION"]


def test_what_an_interceptor_hands_on_is_what_the_rest_gets() -> None:
    robot = Robot()

    async def shorter(call: IncomingCall, proceed: Proceed) -> Answer:
        assert call.parsed is None
        answer = await proceed(replace(call, arguments={"far_m": 1.0}))
        return replace(answer, pictures=())

    step = Interceptor(name="shorter", phase=CallPhase.PERMISSION, around=shorter)
    robot.registry.chain.intercept([step])
    answer = robot.call("drive", {"far_m": 9.0})
    assert answer.structured_content == {"said": "drive {'far_m': 1.0}"}


def test_an_interceptor_of_some_tools_stands_before_those_alone_and_describes_itself() -> None:
    robot = Robot()
    robot.add(CallPhase.HANDLER, tools=frozenset({"drive"}), told="Somebody looks.")
    robot.call("look")
    robot.call("drive")
    assert robot.done == ["look", "HANDLER", "drive"]
    listed = {tool.name: tool.description for tool in robot.registry.listing()}
    assert listed["drive"] == "Does drive. Somebody looks."
    assert listed["look"] == "Does look."


@pytest.mark.parametrize("phase", OF_FEATURES, ids=lambda phase: phase.name)
def test_a_broken_interceptor_refuses(phase: CallPhase) -> None:
    robot = Robot()

    def broken(tool: Tool[Any], context: CallContext) -> None:
        raise KeyError("a mistake")

    robot.registry.chain.intercept([Interceptor(name="broken", phase=phase, check=broken)])
    assert code_of(robot.call("drive")) == "internal"
    assert robot.done == []
    assert [ended.code for ended in robot.ended] == ["internal"]


@pytest.mark.parametrize(
    "phase", [phase for phase in CallPhase if phase < CallPhase.READINESS], ids=lambda p: p.name
)
def test_a_feature_has_no_step_before_an_emergency_stop(phase: CallPhase) -> None:
    with pytest.raises(InternalError):
        Robot().add(phase)


@pytest.mark.parametrize(
    "more", [{}, {"check": refuse, "around": Robot.noting}], ids=["neither", "both"]
)
def test_an_interceptor_either_checks_or_passes_on(more: Any) -> None:
    with pytest.raises(InternalError):
        Robot().registry.chain.intercept([Interceptor(name="x", phase=CallPhase.LOAD, **more)])


def test_two_interceptors_of_one_name_are_refused() -> None:
    robot = Robot()
    robot.add(CallPhase.LOAD)
    with pytest.raises(InternalError):
        robot.add(CallPhase.LOAD)


@pytest.mark.parametrize("phase", OF_FEATURES, ids=lambda phase: phase.name)
@pytest.mark.parametrize("fails", [False, True])
def test_an_emergency_stop_has_acted_before_any_refusal(phase: CallPhase, fails: bool) -> None:
    robot = Robot(most_calls=0)
    pressed: list[str] = []

    def press(*, who: str, reason: str) -> None:
        pressed.append(f"{who}: {reason}")
        if fails:
            raise UnsafeError("The disk is full.")

    robot.registry.chain.press_first(press)
    robot.registry.chain.intercept([Interceptor(name="monday", phase=phase, check=refuse)])
    assert robot.call("emergency_stop", {"reason": "smoke", "far_m": "x"}, "viewer").is_error
    assert pressed == ["agent: smoke"]
    robot.call("look")
    assert robot.call("emergency_stop", {}, role="").is_error
    assert len(pressed) == 1


def test_a_long_work_asks_permission_and_arbitration_again() -> None:
    robot = Robot()
    asked: list[CallPhase] = []
    robot.registry.chain.intercept(
        Interceptor(name=phase.name, phase=phase, check=lambda *_, phase=phase: asked.append(phase))
        for phase in OF_FEATURES
    )
    tool = robot.registry.get("drive")
    assert tool is not None
    context: Any = SimpleNamespace(who="agent", role="operator")
    robot.registry.chain.check_permitted(tool, context)
    assert asked == [CallPhase.PERMISSION, CallPhase.ARBITRATION]


class TestSimulation:
    """A call with preview=true."""

    @pytest.fixture
    def robot(self) -> Robot:
        robot = Robot()
        robot.registry.chain.simulate_with(
            Simulator(tool="rehearse", can=lambda t: t.name == "drive")
        )
        return robot

    def test_it_becomes_a_call_that_reads_and_needs_no_operator(self, robot: Robot) -> None:
        answer = robot.call("drive", {"far_m": 2.0, "preview": True}, role="viewer")
        said = "rehearse {'tool': 'drive', 'arguments': {'far_m': 2.0}}"
        assert answer.structured_content == {"said": said}
        assert robot.done == ["rehearse"]
        assert [ended.call.name for ended in robot.ended] == ["rehearse"]

    @pytest.mark.parametrize("value", [False, 1, "true", None])
    def test_nothing_but_true_asks_for_it(self, robot: Robot, value: object) -> None:
        robot.call("drive", {"preview": value}, role="viewer")
        assert robot.done == []

    def test_there_is_one_simulator(self, robot: Robot) -> None:
        with pytest.raises(InternalError):
            robot.registry.chain.simulate_with(Simulator(tool="look", can=lambda tool: True))


@pytest.mark.parametrize(
    ("name", "check", "expected"),
    [
        ("drive", None, ("answered", "", True)),
        ("fly", None, ("answered", "invalid_input", False)),
        ("drive", refuse, ("answered", "refused", False)),
    ],
)
def test_every_end_of_a_call_is_reported(
    name: str, check: Callable[..., None] | None, expected: tuple[str, str, bool]
) -> None:
    robot = Robot()
    if check is not None:
        robot.registry.chain.intercept([Interceptor(name="c", phase=CallPhase.LOAD, check=check)])
    robot.call(name)
    (ended,) = robot.ended
    assert (ended.outcome, ended.code, ended.answer is not None) == expected
    assert ended.call.name == name


def test_a_cancelled_call_is_reported_as_such() -> None:
    robot = Robot()

    async def wait(call: IncomingCall, proceed: Proceed) -> Answer:
        await anyio.sleep_forever()
        raise NotReadyError("never")

    robot.registry.chain.intercept([Interceptor(name="wait", phase=CallPhase.HANDLER, around=wait)])

    async def scenario() -> None:
        context: Any = SimpleNamespace(who="agent", role="operator")
        async with anyio.create_task_group() as group:
            group.start_soon(robot.registry.call, "drive", {}, context)
            await anyio.wait_all_tasks_blocked()
            group.cancel_scope.cancel()

    anyio.run(scenario)
    assert [ended.outcome for ended in robot.ended] == ["cancelled"]

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


class Trained(Arguments):
    """A tool's own argument of a former name."""

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
                self.tool("drive", simulated_by=frozenset({"twin", "limits"})),
                self.tool("throw"),
                self.tool("fall", simulated_by=frozenset({"twin"})),
                self.tool("train", arguments=Trained),
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
            how = " simulated" if context.simulated and name != "rehearse" else ""
            return Said(said=f"{name} {given.given()}{how}")

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
        context: Any = SimpleNamespace(who="agent", role=role, simulated=False)
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
    context: Any = SimpleNamespace(who="agent", role="operator", simulated=False)
    robot.registry.chain.check_permitted(tool, context)
    assert asked == [CallPhase.PERMISSION, CallPhase.ARBITRATION]


class TestSimulation:
    """A call with simulate=true: the twin answers it, or the limits do, or it is refused; no tool
    that acts is called.
    """

    @pytest.fixture
    def robot(self) -> Robot:
        return Robot()

    @pytest.fixture
    def twin(self, robot: Robot) -> list[bool]:
        """Whether there is a twin: the last element."""
        there = [True]
        robot.registry.chain.simulate_with(Simulator(tool="rehearse", is_there=lambda: there[-1]))
        return there

    def test_the_twin_answers_and_no_operator_is_needed(
        self, robot: Robot, twin: list[bool]
    ) -> None:
        answer = robot.call("drive", {"far_m": 2.0, "simulate": True}, role="viewer")
        said = "rehearse {'tool': 'drive', 'arguments': {'far_m': 2.0}}"
        assert answer.structured_content == {"said": said}
        assert robot.done == ["rehearse"]
        assert [ended.call.name for ended in robot.ended] == ["rehearse"]

    @pytest.mark.parametrize("old", ["dry_run", "preview"])
    def test_the_old_names_are_accepted_and_said_to_be_old(
        self, robot: Robot, twin: list[bool], old: str
    ) -> None:
        answer = robot.call("drive", {"far_m": 2.0, old: True})
        assert robot.done == ["rehearse"]
        assert old in (answer.structured_content or {})["deprecated"]

    def test_without_a_twin_the_handler_answers_and_is_told_to_send_nothing(
        self, robot: Robot, twin: list[bool]
    ) -> None:
        twin.append(False)
        answer = robot.call("drive", {"far_m": 2.0, "simulate": True}, role="viewer")
        assert answer.structured_content == {"said": "drive {'far_m': 2.0} simulated"}

    @pytest.mark.parametrize("name", ["look", "throw", "fall"])
    def test_a_tool_that_cannot_be_simulated_refuses_and_is_not_called(
        self, robot: Robot, twin: list[bool], name: str
    ) -> None:
        twin.append(False)
        answer = robot.call(name, {"simulate": True})
        assert (answer.meta or {})[ERROR_META]["rule"] == "simulate"
        assert robot.done == []
        assert [ended.code for ended in robot.ended] == ["refused"]

    @pytest.mark.parametrize("key", ["simulate", "dry_run", "preview"])
    @pytest.mark.parametrize("value", [1, "true", None, [True]])
    def test_nothing_but_true_and_false_is_understood(
        self, robot: Robot, twin: list[bool], key: str, value: object
    ) -> None:
        assert code_of(robot.call("drive", {key: value})) == "invalid_input"
        assert robot.done == []

    @pytest.mark.parametrize("key", ["simulate", "dry_run", "preview"])
    def test_false_is_a_call_as_any_other(self, robot: Robot, key: str) -> None:
        assert not robot.call("throw", {key: False}).is_error
        assert robot.done == ["throw"]

    def test_of_two_names_that_disagree_the_careful_one_counts(
        self, robot: Robot, twin: list[bool]
    ) -> None:
        robot.call("drive", {"simulate": False, "dry_run": True})
        assert robot.done == ["rehearse"]

    def test_an_argument_of_the_tool_keeps_its_own_name(self, robot: Robot) -> None:
        assert not robot.call("train", {"preview": True}).is_error
        assert robot.done == ["train"]

    def test_a_stop_is_never_only_simulated(self, robot: Robot) -> None:
        pressed: list[str] = []
        robot.registry.chain.press_first(lambda *, who, reason: pressed.append(who))
        robot.call("emergency_stop", {"simulate": True})
        assert pressed == ["agent"]

    def test_a_tool_called_by_another_one_moves_nothing_either(self, robot: Robot) -> None:
        tool = robot.registry.get("throw")
        assert tool is not None
        context: Any = SimpleNamespace(who="agent", role="operator", simulated=True)
        with pytest.raises(RefusedError) as refused:
            anyio.run(tool.call, {}, context)
        assert refused.value.rule == "simulate"
        assert robot.done == []

    def test_it_is_listed_for_the_tools_that_can(self, robot: Robot) -> None:
        listed = {
            tool.name
            for tool in robot.registry.listing()
            if "simulate" in tool.input_schema["properties"]
        }
        assert listed == {"drive", "fall"}

    def test_there_is_one_simulator(self, robot: Robot, twin: list[bool]) -> None:
        with pytest.raises(InternalError):
            robot.registry.chain.simulate_with(Simulator(tool="look", is_there=lambda: True))


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
        context: Any = SimpleNamespace(who="agent", role="operator", simulated=False)
        async with anyio.create_task_group() as group:
            group.start_soon(robot.registry.call, "drive", {}, context)
            await anyio.wait_all_tasks_blocked()
            group.cancel_scope.cancel()

    anyio.run(scenario)
    assert [ended.outcome for ended in robot.ended] == ["cancelled"]

"""Rarely needed tools are not listed; find_tools finds them, and call_tool calls them through the
chain.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import anyio
import pytest
from mcp import Client, types

from roboneuron.errors import RefusedError
from roboneuron.gate.roles import Role
from roboneuron.server.app import Application
from roboneuron.server.interception import CallPhase, Interceptor
from roboneuron.server.tool import Arguments, CallContext, Result, Tool


class Named(Result):
    """The name of what was called."""

    name: str


def a_tool(name: str, **more: Any) -> Tool[Any]:
    async def answer(arguments: Arguments, context: CallContext) -> Named:
        return Named(name=name)

    return Tool(
        name=name,
        title=name,
        description=f"Does what {name} says.",
        arguments=Arguments,
        result=Named,
        handler=answer,
        **{"read_only": True, "seldom": True} | more,
    )


@pytest.fixture
def served(application: Application) -> Application:
    application.tools.add_all(
        [
            a_tool("list_wheels"),
            a_tool("swap_wheel", read_only=False),
            a_tool("often", seldom=False),
        ]
    )
    return application


def ask(application: Application, work: Callable[[Client], Any]) -> Any:
    async def run() -> Any:
        async with Client(application.server) as client:
            return await work(client)

    return anyio.run(run)


def call(application: Application, name: str, /, **arguments: Any) -> types.CallToolResult:
    return ask(application, lambda client: client.call_tool(name, arguments))  # type: ignore[no-any-return]


def names(application: Application) -> set[str]:
    return {tool.name for tool in ask(application, lambda client: client.list_tools()).tools}


def test_rare_tools_are_left_out_of_the_list(served: Application) -> None:
    listed = names(served)
    assert {"often", "find_tools", "call_tool"} <= listed
    assert not {"list_wheels", "swap_wheel"} & listed


def test_without_rare_tools_nothing_is_to_be_found(application: Application) -> None:
    assert not {"find_tools", "call_tool"} & names(application)


def test_they_are_found_by_words_with_their_schemas(served: Application) -> None:
    answer = call(served, "find_tools", query="wheels").structured_content
    assert answer is not None
    assert answer["tools"][0]["name"] == "list_wheels"
    assert answer["tools"][0]["input_schema"] == a_tool("x").input_schema()
    assert answer["total"] == 2


@pytest.mark.parametrize(
    ("tool", "arguments"), [("call_tool", {"tool": "list_wheels"}), ("list_wheels", {})]
)
def test_they_are_called_by_either_way(
    served: Application, tool: str, arguments: dict[str, Any]
) -> None:
    answer = call(served, tool, **arguments)
    assert answer.structured_content == {"name": "list_wheels"}


def test_the_chain_judges_the_tool_that_is_meant(served: Application) -> None:
    def check(tool: Tool[Any], context: CallContext) -> None:
        raise RefusedError(f"{tool.name} is refused.", rule="a test")

    barred = frozenset({"swap_wheel"})
    served.tools.chain.intercept(
        [Interceptor(name="bar", phase=CallPhase.PERMISSION, check=check, tools=barred)]
    )
    seen: list[str] = []
    served.events.call_begun.listen(lambda begun: seen.append(begun.name))
    answer = call(served, "call_tool", tool="swap_wheel")
    assert answer.is_error
    assert answer.meta is not None
    assert answer.meta["roboneuron/error"]["rule"] == "a test"
    assert seen == ["swap_wheel"], "events and the audit name it"


def test_a_stop_is_not_refused_for_the_way_it_is_called(served: Application) -> None:
    answer = call(served, "call_tool", tool="emergency_stop", arguments={"reason": "smoke"})
    assert not answer.is_error
    assert served.loop.emergency_stop.is_latched()


def test_a_viewer_finds_only_what_a_viewer_may_call(served: Application) -> None:
    assert {tool.name for tool in served.tools.hidden(Role.VIEWER)} == {"list_wheels"}
    assert {tool.name for tool in served.tools.hidden(Role.OPERATOR)} == {
        "list_wheels",
        "swap_wheel",
    }


@pytest.mark.parametrize("tool", ["often", "call_tool", "list_wheel"])
def test_what_is_listed_or_unknown_is_not_called_by_it(served: Application, tool: str) -> None:
    answer = call(served, "call_tool", tool=tool)
    assert answer.is_error
    assert answer.meta is not None
    assert answer.meta["roboneuron/error"]["code"] == "invalid_input"

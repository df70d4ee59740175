"""What a call costs does not grow with what is exposed."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import anyio
import pytest

from rn_standard.tools_ros.directory import CallEndpoint, directory_tools
from roboneuron import Arguments, CallContext, InvalidInputError, Result, Tool

CONTEXT = cast("CallContext", SimpleNamespace(who="test", role="admin", simulated=False))


class Named(Result):
    """The name of what was called."""

    name: str


def a_tool(name: str) -> Tool[Any]:
    async def answer(arguments: Arguments, context: CallContext) -> Named:
        return Named(name=name)

    return Tool(
        name=name,
        title=name,
        description=name,
        arguments=Arguments,
        result=Named,
        handler=answer,
        read_only=True,
    )


def test_a_known_name_is_looked_up_and_nothing_is_listed() -> None:
    def every() -> list[Tool[Any]]:
        raise AssertionError("all tools were looked at")

    tools = {name: a_tool(name) for name in ("read_odometry", "read_scan")}
    call = directory_tools(every, tools.get)[1]

    async def ask() -> object:
        return (await call.call({"tool": "read_scan"}, CONTEXT)).structured

    assert anyio.run(ask) == {"tool": "read_scan", "result": {"name": "read_scan"}}


def test_an_unknown_name_is_answered_with_the_nearest_ones() -> None:
    tools = [a_tool("read_odometry"), a_tool("read_scan")]
    call = directory_tools(lambda: tools, lambda name: None)[1]

    async def ask() -> None:
        await call.handler(CallEndpoint(tool="scan"), CONTEXT)

    with pytest.raises(InvalidInputError, match="read_scan"):
        anyio.run(ask)

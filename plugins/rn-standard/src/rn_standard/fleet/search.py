"""Rarely needed tools: found by search and called by name, so that the list of several robots stays
short.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from mcp import types
from pydantic import Field

from roboneuron import Arguments, CallContext, InternalError, Result, Tool
from roboneuron.feature import Role

FIND, CALL = "find_robot_tools", "call_robot_tool"
_MOST = 5


class FindRobotTools(Arguments):
    """Arguments of find_robot_tools."""

    query: str = Field(
        default="",
        max_length=200,
        description='Words, such as "list backends" or "switch camera"; all names when empty.',
    )


class FoundRobotTool(Result):
    """A tool for call_robot_tool; its arguments are left out when all are listed."""

    sparse = True

    name: str
    description: str
    robots: list[str] = Field(description="robots that have it")
    input_schema: dict[str, object] = Field(
        default_factory=dict, description="of `arguments` of call_robot_tool"
    )


class FoundRobotTools(Result):
    """Matching tools, best first."""

    sparse = True

    tools: list[FoundRobotTool]
    more: int = Field(description="further tools that fit; use other words")


class CallRobotTool(Arguments):
    """Arguments of call_robot_tool."""

    robot: str = Field(max_length=80, description="Which robot.")
    tool: str = Field(max_length=80, description="Name of a tool of find_robot_tools.")
    arguments: dict[str, object] = Field(
        default_factory=dict, description="As its input schema says, without `robot`."
    )


def search_tools(seldom: Callable[[str], Sequence[types.Tool]]) -> list[Tool]:
    """Create find_robot_tools and call_robot_tool for the tools that `seldom` returns for clients
    of a role.
    """

    async def find(arguments: FindRobotTools, context: CallContext) -> FoundRobotTools:
        words = re.findall(r"[a-z0-9]+", arguments.query.lower())
        tools = seldom(context.role)
        if not words:
            return FoundRobotTools(tools=[_found(tool, whole=False) for tool in tools], more=0)
        scored = [
            (sum(2 * (w in t.name) + (w in str(t.description).lower()) for w in words), t)
            for t in tools
        ]
        fitting = [tool for score, tool in sorted(scored, key=lambda pair: -pair[0]) if score]
        return FoundRobotTools(
            tools=[_found(tool, whole=True) for tool in fitting[:_MOST]],
            more=max(0, len(fitting) - _MOST),
        )

    async def call(arguments: CallRobotTool, context: CallContext) -> Result:
        raise InternalError(f"{CALL} is answered by the robot that it names.")

    return [
        Tool(
            name=FIND,
            title="Find further tools of the robots",
            description="Find tools that are not in this list, by words: what is installed and "
            "can be chosen (list_*), "
            "ROS interfaces, topics and nodes, replacing a running policy, camera or controller "
            "(switch_*), sequences "
            "of messages. Call what you find with call_robot_tool.",
            arguments=FindRobotTools,
            result=FoundRobotTools,
            handler=find,
            read_only=True,
            idempotent=True,
        ),
        Tool(
            name=CALL,
            title="Call a tool that find_robot_tools found",
            description="Call a tool of find_robot_tools for one robot; the robot checks the "
            "arguments as in a direct "
            "call.",
            arguments=CallRobotTool,
            result=Result,
            handler=call,
            destructive=True,
            open_world=True,
            role=Role.VIEWER,  # the called tool has its own role
        ),
    ]


def _found(tool: types.Tool, *, whole: bool) -> FoundRobotTool:
    properties: Mapping[str, Any] = tool.input_schema["properties"]
    facts = {
        "name": tool.name,
        "description": tool.description or "",
        "robots": properties["robot"]["enum"],
    }
    if not whole:
        return FoundRobotTool(**facts)
    rest = {name: entry for name, entry in properties.items() if name != "robot"}
    required = [name for name in tool.input_schema.get("required", ()) if name != "robot"]
    schema = {**tool.input_schema, "properties": rest, "required": required}
    return FoundRobotTool(**facts, input_schema=schema)

"""Tools find_tools and call_endpoint: access to derived tools that are too many to be listed."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from pydantic import Field
from pydantic.json_schema import JsonSchemaValue

from roboneuron import Arguments, CallContext, InvalidInputError, Reply, Result, Tool
from roboneuron.feature import Role


class FindTools(Arguments):
    """Arguments of find_tools."""

    query: str = Field(
        default="", max_length=200, description="Search words; all tools without any."
    )
    schemas: bool = Field(default=False, description="Give the input schemas too.")
    limit: int = Field(default=10, ge=1, le=50, description="Maximum number of tools.")


class FoundTool(Result):
    """A tool that call_endpoint can call."""

    name: str
    title: str
    description: str
    read_only: bool
    arguments: list[str]
    input_schema: JsonSchemaValue | None = None


class FoundTools(Result):
    """Tools found, best matches first."""

    tools: list[FoundTool]
    matching: int
    total: int


class CallEndpoint(Arguments):
    """Arguments of call_endpoint."""

    tool: str = Field(min_length=1, max_length=200, description="Name, as find_tools gives it.")
    arguments: dict[str, object] = Field(
        default_factory=dict, description="As in its input schema."
    )


class EndpointResult(Result):
    """Answer of the called tool."""

    tool: str
    result: dict[str, object]


def directory_tools(
    tools: Callable[[], Sequence[Tool]], tool_of: Callable[[str], Tool | None]
) -> list[Tool]:
    """Create both tools; they use the tools present at the time of the call.

    Args:
        tools: returns all of them.
        tool_of: returns one by name, so that a call need not search a thousand.
    """

    async def find(arguments: FindTools, context: CallContext) -> FoundTools:
        mine = [tool for tool in tools() if tool.least_role.is_held_by(context.role)]
        ranked = _rank(mine, _words(arguments.query))
        found = [_found(tool, arguments.schemas) for tool in ranked[: arguments.limit]]
        return FoundTools(tools=found, matching=len(ranked), total=len(mine))

    async def call(arguments: CallEndpoint, context: CallContext) -> Reply:
        name = arguments.tool
        found = tool_of(name)
        if found is None:
            near = [tool.name for tool in _rank(tools(), _words(name))[:3]]
            hint = f"Nearest: {', '.join(near)}." if near else "See find_tools."
            raise InvalidInputError(f"There is no endpoint tool {name!r}.", hint=hint, path="tool")
        found.check_caller(context)
        answer = await found.call(arguments.arguments, context)
        return Reply(
            result=EndpointResult(tool=name, result=dict(answer.structured)),
            pictures=answer.pictures,
        )

    return [
        Tool(
            name="find_tools",
            title="Find tools of the robot's interfaces",
            description=(
                "Search the tools for topics, services and actions by words (robot, noun, verb, "
                "type); they are too "
                "many to be listed. Call what you find with call_endpoint."
            ),
            arguments=FindTools,
            result=FoundTools,
            handler=find,
            read_only=True,
            idempotent=True,
        ),
        Tool(
            name="call_endpoint",
            title="Call a tool that find_tools found",
            description="Call a tool of find_tools by name, with the arguments of its input "
            "schema.",
            arguments=CallEndpoint,
            result=EndpointResult,
            handler=call,
            open_world=True,
            role=Role.VIEWER,  # the called tool has its own role
        ),
    ]


def _words(text: str) -> list[str]:
    return [word for word in re.split(r"[^a-z0-9]+", text.lower()) if word]


def _rank(tools: Sequence[Tool], words: Sequence[str]) -> list[Tool]:
    """Sort tools by the number of matching words, in the name before the description; all of them
    without words.
    """
    if not words:
        return list(tools)
    scored = []
    for index, tool in enumerate(tools):
        name, text = tool.name, f"{tool.title} {tool.description}".lower()
        score = sum(
            3 * (word in name.split("_")) + 2 * (word in name) + (word in text) for word in words
        )
        if score:
            scored.append((-score, len(name), index, tool))
    return [tool for *_, tool in sorted(scored, key=lambda entry: entry[:3])]


def _found(tool: Tool, with_schema: bool) -> FoundTool:
    schema = tool.input_schema()
    return FoundTool(
        name=tool.name,
        title=tool.title,
        description=tool.description,
        read_only=tool.read_only,
        arguments=list(schema["properties"]),
        input_schema=schema if with_schema else None,
    )

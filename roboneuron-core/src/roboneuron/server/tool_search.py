"""Tools find_tools and call_tool: access to tools that are left out of `tools/list`, because they
are rarely needed or too many.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Sequence
from typing import Any

from pydantic import Field
from pydantic.json_schema import JsonSchemaValue

from roboneuron.errors import InvalidInputError
from roboneuron.gate.roles import Role
from roboneuron.server.tool import Arguments, CallContext, Result, Tool

FIND_TOOLS, CALL_TOOL = "find_tools", "call_tool"


class FindTools(Arguments):
    """Arguments of find_tools."""

    query: str = Field(
        default="", max_length=200, description="Search words; all tools without any."
    )
    schemas: bool = Field(default=True, description="Give the input schemas too.")
    limit: int = Field(default=5, ge=1, le=50, description="Maximum number of tools.")


class FoundTool(Result):
    """A tool that call_tool can call."""

    name: str
    description: str
    read_only: bool
    input_schema: JsonSchemaValue | None = Field(
        default=None, description="of `arguments` of call_tool"
    )


class FoundTools(Result):
    """Tools found, best matches first."""

    tools: list[FoundTool]
    matching: int
    total: int


class CallTool(Arguments):
    """Arguments of call_tool."""

    tool: str = Field(min_length=1, max_length=200, description="Name, as find_tools gives it.")
    arguments: dict[str, object] = Field(
        default_factory=dict, description="As in its input schema."
    )


def search_tools(hidden: Callable[[str], Sequence[Tool[Any]]]) -> list[Tool[Any]]:
    """Create find_tools, and call_tool, whose calls the registry passes on as calls of the tool
    that they name.

    Args:
        hidden: returns the tools that are not listed to clients of a role, as they are now.
    """

    async def find(arguments: FindTools, context: CallContext) -> FoundTools:
        mine = hidden(context.role)
        ranked = _rank(mine, _words(arguments.query))
        found = [_found(tool, arguments.schemas) for tool in ranked[: arguments.limit]]
        return FoundTools(tools=found, matching=len(ranked), total=len(mine))

    async def call(arguments: CallTool, context: CallContext) -> Result:
        raise InvalidInputError(f"{CALL_TOOL} does not call itself.", path="tool")

    def is_offered() -> bool:
        return bool(hidden(Role.ADMIN))

    return [
        Tool(
            name=FIND_TOOLS,
            title="Find further tools",
            description="Find tools that are not in this list, by words: what is installed "
            "(list_*), logs, topics, nodes and interfaces, replacing a running policy, camera or "
            "controller (switch_*), sequences. Call what you find with call_tool.",
            arguments=FindTools,
            result=FoundTools,
            handler=find,
            read_only=True,
            idempotent=True,
            offered=is_offered,
        ),
        Tool(
            name=CALL_TOOL,
            title="Call a tool that find_tools found",
            description="Call a tool of find_tools, with the arguments of its input schema; its "
            "answer is that tool's own.",
            arguments=CallTool,
            result=Result,
            handler=call,
            destructive=True,
            open_world=True,
            role=Role.VIEWER,  # the called tool has its own role
            offered=is_offered,
        ),
    ]


def nearest_tools(tools: Sequence[Tool[Any]], name: str) -> str:
    """Hint with the names of the tools that fit best."""
    near = [tool.name for tool in _rank(tools, _words(name))[:3]]
    return f"Nearest: {', '.join(near)}." if near else f"See {FIND_TOOLS}."


def _words(text: str) -> set[str]:
    """Words of three letters or more, each as it is and in the singular."""
    found = re.findall(r"[a-z0-9]{3,}", text.lower())
    return {form for word in found for form in (word, word.removesuffix("s"))}


def _rank(tools: Sequence[Tool[Any]], words: Collection[str]) -> list[Tool[Any]]:
    """Sort tools by the words that they share with the query, in the name before the description;
    a word that few tools have counts more. All of them without words.
    """
    if not words:
        return list(tools)
    named = [_words(tool.name) for tool in tools]
    told = [_words(f"{tool.title} {tool.description}") for tool in tools]
    shares = [name | text for name, text in zip(named, told, strict=True)]
    weights = {
        word: math.log(1.0 + len(tools) / count)
        for word in words
        if (count := sum(word in share for share in shares))
    }
    scored = []
    for index, (tool, name, text) in enumerate(zip(tools, named, told, strict=True)):
        score = sum(
            weight * (3 * (word in name) + (word in text)) for word, weight in weights.items()
        )
        if score:
            scored.append((-score, len(tool.name), index, tool))
    return [tool for *_, tool in sorted(scored, key=lambda entry: entry[:3])]


def _found(tool: Tool[Any], with_schema: bool) -> FoundTool:
    return FoundTool(
        name=tool.name,
        description=tool.description,
        read_only=tool.read_only,
        input_schema=tool.input_schema() if with_schema else None,
    )

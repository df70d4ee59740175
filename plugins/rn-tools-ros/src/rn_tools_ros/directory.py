"""find_tools and call_endpoint: the way to derived tools when there are too many of them to be listed."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from rn_tools_ros.arguments import (
    Number,
    check_names,
    object_schema,
    take_flag,
    take_object,
    take_text,
)
from roboneuron.errors import InvalidInputError
from roboneuron.gate.request import VIEWER
from roboneuron.server.access import check_role, may_call
from roboneuron.server.tool import Answer, CallContext, DerivedTool

LIMIT = Number(text="Most tools to return.", low=1, high=50, default=10, integer=True)


def directory_tools(tools: Callable[[], Mapping[str, DerivedTool]]) -> list[DerivedTool]:
    """The pair, over whatever `tools` returns, by name, at the time of the call."""

    async def find(arguments: Mapping[str, Any], context: CallContext) -> Answer:
        check_names(arguments, ["query", "schemas", "limit"])
        limit = int(LIMIT.take("limit", arguments))
        with_schemas = take_flag(arguments, "schemas")
        query = arguments.get("query")
        words = _words(take_text(arguments, "query")) if query not in (None, "") else []
        mine = [tool for tool in tools().values() if may_call(context.role, tool)]
        ranked = _rank(mine, words)
        found = [_entry(tool, with_schemas) for tool in ranked[:limit]]
        return Answer(structured={"tools": found, "matching": len(ranked), "total": len(mine)})

    async def call(arguments: Mapping[str, Any], context: CallContext) -> Answer:
        check_names(arguments, ["tool", "arguments"])
        name = take_text(arguments, "tool")
        found = tools().get(name)
        if found is None:
            near = [tool.name for tool in _rank(list(tools().values()), _words(name))[:3]]
            hint = f"Nearest: {', '.join(near)}." if near else "See find_tools."
            raise InvalidInputError(f"There is no endpoint tool {name!r}.", hint=hint, path="tool")
        check_role(found, context)
        answer = await found.handler(take_object(arguments, "arguments", required=False), context)
        return Answer(structured={"tool": name, "result": dict(answer.structured)}, pictures=answer.pictures)

    entry = object_schema(
        {
            "name": {"type": "string"},
            "title": {"type": "string"},
            "description": {"type": "string"},
            "read_only": {"type": "boolean"},
            "arguments": {"type": "array", "items": {"type": "string"}},
            "input_schema": {"type": "object"},
        },
        ["name", "title", "description", "read_only", "arguments"],
    )
    return [
        DerivedTool(
            name="find_tools",
            title="Find tools of the robot's interfaces",
            description=(
                "Search the tools for topics, services and actions by words (robot, noun, verb, type); they are too "
                "many to be listed. Call what you find with call_endpoint."
            ),
            input_schema=object_schema(
                {
                    "query": {"type": "string", "maxLength": 200, "description": "Words; all of them without any."},
                    "schemas": {"type": "boolean", "default": False, "description": "Give the input schemas too."},
                    "limit": LIMIT.schema(),
                }
            ),
            output_schema=object_schema(
                {
                    "tools": {"type": "array", "items": entry},
                    "matching": {"type": "integer"},
                    "total": {"type": "integer"},
                },
                ["tools", "matching", "total"],
            ),
            handler=find,
            read_only=True,
            idempotent=True,
            open_world=False,
        ),
        DerivedTool(
            name="call_endpoint",
            title="Call a tool that find_tools found",
            description="Call a tool of find_tools by name, with the arguments of its input schema.",
            input_schema=object_schema(
                {
                    "tool": {"type": "string", "maxLength": 200, "description": "Name, as find_tools gives it."},
                    "arguments": {"type": "object", "description": "As in its input schema."},
                },
                ["tool"],
            ),
            output_schema=object_schema({"tool": {"type": "string"}, "result": {"type": "object"}}, ["tool", "result"]),
            handler=call,
            role=VIEWER,  # what it calls has a role of its own
        ),
    ]


def _words(text: str) -> list[str]:
    return [word for word in re.split(r"[^a-z0-9]+", text.lower()) if word]


def _rank(tools: Sequence[DerivedTool], words: Sequence[str]) -> list[DerivedTool]:
    """Tools by how many words they hold, in the name before the description; all of them without words."""
    if not words:
        return list(tools)
    scored = []
    for index, tool in enumerate(tools):
        name, text = tool.name, f"{tool.title} {tool.description}".lower()
        score = sum(3 * (word in name.split("_")) + 2 * (word in name) + (word in text) for word in words)
        if score:
            scored.append((-score, len(name), index, tool))
    return [tool for *_, tool in sorted(scored, key=lambda entry: entry[:3])]


def _entry(tool: DerivedTool, with_schema: bool) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "name": tool.name,
        "title": tool.title,
        "description": tool.description,
        "read_only": tool.read_only,
        "arguments": list(tool.input_schema["properties"]),
    }
    return {**entry, "input_schema": tool.input_schema} if with_schema else entry

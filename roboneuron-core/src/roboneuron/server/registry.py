"""All tools by name: listing them with today's choices, and calling one with checked arguments."""

from __future__ import annotations

import json
import logging
import uuid
from base64 import b64encode
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable, Mapping
from typing import Any

from mcp import types
from pydantic import ValidationError

from roboneuron.errors import InternalError, InvalidInputError, NotReadyError, RoboNeuronError
from roboneuron.gate.request import ADMIN
from roboneuron.server.access import check_role, may_call
from roboneuron.server.asking import QuestionError
from roboneuron.server.schema import Schema, check_arguments, input_schema, output_schema
from roboneuron.server.tool import Answer, CallContext, DerivedTool, Reply, Tool

log = logging.getLogger(__name__)
Admission = Callable[[Tool[Any] | DerivedTool, CallContext], None]
"""Raises RoboNeuronError for a call that is not to be made now; called on the event loop, must not block."""
_MOST_TEXT = 2000
"""Characters of an error's text."""
ERROR_META = "roboneuron/error"
"""Key in a failed call's `_meta`: code, message and hint (clients check `structuredContent` by the output schema)."""


class ToolRegistry:
    """Tools in the order they were added; the one border between MCP and everything that is called.

    Args:
        tools: the first ones.
        most_calls: more calls at once of clients of one role are refused, so that those who look on cannot hold up
            those who act; what stops something is never refused.
        ready: awaited before a tool that is known and permitted is called; what is urgent is done before.
    """

    def __init__(
        self,
        tools: Iterable[Tool[Any]] = (),
        *,
        most_calls: int = 64,
        ready: Callable[[], Awaitable[None]] | None = None,
    ) -> None:
        self._admissions: list[Admission] = []
        self._ready = ready
        self._most_calls = most_calls
        self._calls: Counter[str] = Counter()
        self._tools: dict[str, Tool[Any]] = {}
        self._output_schemas: dict[str, Schema] = {}
        self._derived: dict[str, tuple[DerivedTool, types.Tool]] = {}
        for tool in tools:
            self.add(tool)

    def add_admission(self, admit: Admission) -> None:
        """Ask this one too before each call; those of features ask who may act now."""
        self._admissions.append(admit)

    def add(self, tool: Tool[Any]) -> None:
        """Add a tool.

        Raises:
            InternalError: there is one of that name.
        """
        if tool.name in self._tools or tool.name in self._derived:
            raise InternalError(f"There are two tools called {tool.name!r}.")
        self._tools[tool.name] = tool
        self._output_schemas[tool.name] = output_schema(tool.result)

    def add_all(self, tools: Iterable[Tool[Any] | DerivedTool]) -> None:
        """Add all of them, or none.

        Raises:
            InternalError: there is one of a name already.
        """
        added: list[str] = []
        try:
            for tool in tools:
                if isinstance(tool, DerivedTool):
                    raise InternalError(f"{tool.name!r} is a derived tool; those are added by `replace_derived`.")
                self.add(tool)
                added.append(tool.name)
        except Exception:
            for name in added:
                self.remove(name)
            raise

    def remove(self, name: str) -> None:
        """Remove a tool; nothing happens when there is none."""
        self._tools.pop(name, None)
        self._output_schemas.pop(name, None)

    def names(self) -> frozenset[str]:
        """Names of the tools that are not derived."""
        return frozenset(self._tools)

    def derived(self) -> list[DerivedTool]:
        """All derived tools, listed or not."""
        return [tool for tool, _ in self._derived.values()]

    def replace_derived(self, tools: Iterable[DerivedTool]) -> bool:
        """Have these derived tools and no others; returns whether the listing changed. Callable from any thread.

        Raises:
            InternalError: a name comes twice.
        """
        made: dict[str, tuple[DerivedTool, types.Tool]] = {}
        for tool in tools:
            if tool.name in self._tools or tool.name in made:
                raise InternalError(f"There are two tools called {tool.name!r}.")
            made[tool.name] = (tool, _described(tool, tool.input_schema, tool.output_schema))
        before = {name: shown for name, (tool, shown) in self._derived.items() if tool.listed}
        self._derived = made
        return before != {name: shown for name, (tool, shown) in made.items() if tool.listed}

    def listing(self, role: str = ADMIN) -> list[types.Tool]:
        """What `tools/list` answers to clients of a role: what they may call."""
        listed = [shown for tool, shown in self._derived.values() if tool.listed and may_call(role, tool)]
        return [
            *(
                _described(tool, self._input_schema(tool), self._output_schemas[tool.name])
                for tool in self._tools.values()
                if may_call(role, tool)
            ),
            *listed,
        ]

    async def call(self, name: str, arguments: Mapping[str, Any], context: CallContext) -> types.CallToolResult:
        """Validate, run, and answer; every failure is an MCP error result. Raises QuestionError, which is none."""
        try:
            tool = self._find(name)
            check_role(tool, context)
            if isinstance(tool, Tool) and tool.urgent is not None:
                tool.urgent(arguments, context)
            if self._ready is not None:
                await self._ready()
            answer = await self._carry_out(tool, arguments, context)
        except RoboNeuronError as error:
            log.info("%s was refused: %s: %s", _short(name), error.code, _clipped(str(error)))
            return _failure(error)
        except QuestionError:
            raise
        except Exception:  # the tool-call border: the agent is told, the log keeps the traceback
            incident = uuid.uuid4().hex[:8]
            log.exception("%s failed (incident %s)", name, incident)
            return _failure(
                InternalError(
                    f"{name} failed unexpectedly (incident {incident}).",
                    hint="The server's log has the details; get_status tells what is running.",
                )
            )
        structured = dict(answer.structured)
        content: list[types.ContentBlock] = [types.TextContent(type="text", text=json.dumps(structured))]
        content += [
            types.ImageContent(type="image", data=b64encode(p.data).decode(), mime_type=p.mime_type)
            for p in answer.pictures
        ]
        return types.CallToolResult(content=content, structured_content=structured)

    async def _carry_out(
        self, tool: Tool[Any] | DerivedTool, arguments: Mapping[str, Any], context: CallContext
    ) -> Answer:
        self._calls[context.role] += 1
        try:
            if self._calls[context.role] > self._most_calls and not tool.always:
                raise NotReadyError(
                    f"{self._most_calls} calls are at work already for the role {context.role!r}, no more are taken.",
                    hint="Wait for one to end; max_concurrent_calls in [server] sets how many there may be.",
                )
            for admit in self._admissions:
                admit(tool, context)
            if isinstance(tool, DerivedTool):
                return await tool.handler(arguments, context)
            return await self._call_typed(tool, arguments, context)
        finally:
            self._calls[context.role] -= 1

    def _find(self, name: str) -> Tool[Any] | DerivedTool:
        derived = self._derived.get(name)
        tool = derived[0] if derived is not None else self._tools.get(name)
        if tool is None:
            raise InvalidInputError(f"There is no tool {_short(name)}.", hint="See tools/list.", path="tool")
        return tool

    async def _call_typed(self, tool: Tool[Any], arguments: Mapping[str, Any], context: CallContext) -> Answer:
        checked = check_arguments(self._input_schema(tool), arguments)
        try:
            typed = tool.arguments.model_validate(checked)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            path = ".".join(str(part) for part in first["loc"])
            raise InvalidInputError(f"Argument {path!r}: {first['msg']}.", path=path) from error
        outcome = await tool.handler(typed, context)
        reply = outcome if isinstance(outcome, Reply) else Reply(result=outcome)
        return Answer(structured=reply.result.model_dump(mode="json"), pictures=reply.pictures)

    def _input_schema(self, tool: Tool[Any]) -> Schema:
        return input_schema(tool.arguments, {name: ask() for name, ask in tool.choices.items()})


def _described(tool: Tool[Any] | DerivedTool, input_schema: Schema, output_schema: Schema) -> types.Tool:
    return types.Tool(
        name=tool.name,
        title=tool.title,
        description=tool.description,
        input_schema=input_schema,
        output_schema=output_schema,
        annotations=types.ToolAnnotations(
            title=tool.title,
            read_only_hint=tool.read_only,
            destructive_hint=tool.destructive,
            idempotent_hint=tool.idempotent,
            open_world_hint=tool.open_world,
        ),
    )


def _short(name: str) -> str:
    return repr(name) if len(name) <= 80 else f"{name[:77]!r}..."


def _clipped(text: str) -> str:
    """An error may quote what the caller sent, which may be long."""
    return text if len(text) <= _MOST_TEXT else f"{text[: _MOST_TEXT - 100]} ... {text[-80:]}"


def _failure(error: RoboNeuronError) -> types.CallToolResult:
    details = {"code": error.code, "message": _clipped(error.message), "hint": _clipped(error.hint)}
    if isinstance(error, InvalidInputError) and error.path:
        details["path"] = error.path[:_MOST_TEXT]
    return types.CallToolResult(
        content=[types.TextContent(type="text", text=_clipped(str(error)))],
        _meta={ERROR_META: details},
        is_error=True,
    )

"""All tools by name: lists them with their current choices, and calls one with checked
arguments.
"""

from __future__ import annotations

import json
import logging
import threading
import time
import uuid
from base64 import b64encode
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable, Mapping
from itertools import chain
from typing import Any

from mcp import types

from roboneuron.errors import (
    InternalError,
    InvalidInputError,
    NotReadyError,
    RefusedError,
    RoboNeuronError,
    nearest,
    shortened,
)
from roboneuron.gate.roles import Role
from roboneuron.server.schema import listed_output
from roboneuron.server.tool import Answer, CallContext, Tool

log = logging.getLogger(__name__)
Admission = Callable[[Tool[Any], CallContext], None]
"""Raises RoboNeuronError for a call that is not permitted now; called on the event loop, must not
block.
"""
_MOST_TEXT = 2000
"""Maximum length of an error's text [characters]."""
_MOST_ANSWER = 100_000
"""Maximum length of a read-only tool's answer [characters], for tools without their own bound."""
_LISTED = "tools/list (`roboneuron tools`) names those that this robot has."
_FIXED = ""
"""Owner of the tools that were added; the others are derived."""
ERROR_META = "roboneuron/error"
"""Key in a failed call's `_meta`: code, message, hint, and the rule of a refusal (clients check
`structuredContent` by the output schema).
"""


class UnfinishedCallError(Exception):
    """Ends a call with a question to the client's user, whose answer comes with the next call; not
    a failure.
    """

    def __init__(self, result: types.InputRequiredResult) -> None:
        super().__init__("a person is asked")
        self.result = result


class ToolRegistry:
    """Tools in the order of their addition; the one border between MCP and all handlers.

    Args:
        tools: the initial tools.
        most_calls: maximum number of concurrent calls by clients of one role, so that viewers
            cannot block operators; a stop is never refused.
        on_change: called, from any thread, when the listed derived tools changed.
        on_call: called after each answered call, as `Events.call`.
        acts_on: the robot in words; part of every answer of a tool that acts on it.

    Attributes:
        admissions: called in this order before each call; features add checks of who may act.
        ready: awaited before a known and permitted tool is called; urgent work is done before. None
            when there is nothing to wait for.
    """

    def __init__(
        self,
        tools: Iterable[Tool[Any]] = (),
        *,
        most_calls: int = 64,
        on_change: Callable[[], object] = lambda: None,
        on_call: Callable[[str, Mapping[str, Any], str, str, float], object] = lambda *_: None,
        acts_on: Callable[[], str] | None = None,
    ) -> None:
        self._acts_on = acts_on
        self._on_call = on_call
        self.admissions: list[Admission] = []
        self.ready: Callable[[], Awaitable[None]] | None = None
        self._on_change = on_change
        self._lock = threading.Lock()
        self._most_calls = most_calls
        self._calls: Counter[str] = Counter()
        self._owned: dict[str, dict[str, _ListedTool]] = {_FIXED: {}}
        self.add_all(tools)

    def add_all(self, tools: Iterable[Tool[Any]]) -> None:
        """Add all tools, or none.

        Raises:
            InternalError: a name already exists.
        """
        self._replace(_FIXED, [*(entry.tool for entry in self._owned[_FIXED].values()), *tools])

    def replace(self, tool: Tool[Any]) -> None:
        """Replace the added tool of the same name."""
        self._replace(
            _FIXED,
            [
                tool if name == tool.name else entry.tool
                for name, entry in self._owned[_FIXED].items()
            ],
        )

    def names(self, besides: str = "") -> frozenset[str]:
        """Names of all tools except the derived ones of the owner `besides`."""
        return frozenset(
            name
            for owner, entries in self._owned.items()
            if owner == _FIXED or owner != besides
            for name in entries
        )

    def derived(self, owner: str = "") -> list[Tool[Any]]:
        """Derived tools of an owner, or all of them; listed or not."""
        return [
            entry.tool
            for name, entries in self._owned.items()
            if name != _FIXED and owner in ("", name)
            for entry in entries.values()
        ]

    def replace_derived(self, owner: str, tools: Iterable[Tool[Any]]) -> None:
        """Replace all derived tools of an owner; callable from any thread.

        Raises:
            InternalError: a tool of that name exists elsewhere.
        """
        before = self._shown(owner)
        self._replace(owner, tools)
        if before != self._shown(owner):
            self._on_change()

    def listing(self, role: str = Role.ADMIN) -> list[types.Tool]:
        """Tools in the answer to `tools/list` for clients of a role: those that the role
        may call.
        """
        return [
            entry.shown()
            for entries in self._owned.values()
            for entry in entries.values()
            if entry.tool.listed and entry.tool.offered() and entry.tool.least_role.is_held_by(role)
        ]

    def get(self, name: str, *, is_derived: bool = False) -> Tool[Any] | None:
        """Return the tool of that name, listed or not, or only a derived one. Constant time in the
        number of tools.
        """
        for owner, entries in self._owned.items():
            if name in entries and not (is_derived and owner == _FIXED):
                return entries[name].tool
        return None

    def _shown(self, owner: str) -> list[types.Tool]:
        return [entry.shown() for entry in self._owned.get(owner, {}).values() if entry.tool.listed]

    def _replace(self, owner: str, tools: Iterable[Tool[Any]]) -> None:
        with self._lock:
            others = [entries for other, entries in self._owned.items() if other != owner]
            own: dict[str, _ListedTool] = {}
            for tool in tools:
                if any(tool.name in entries for entries in (own, *others)):
                    raise InternalError(f"There are two tools called {tool.name!r}.")
                own[tool.name] = _ListedTool(tool)
            self._owned = {**self._owned, owner: own}  # another thread may read those before

    async def call(
        self, name: str, arguments: Mapping[str, Any], context: CallContext
    ) -> types.CallToolResult:
        """Validate, run, and answer; every failure becomes an MCP error result, except
        UnfinishedCallError.
        """
        begun_s, code = time.monotonic(), ""
        try:
            tool, answer = await self._carry_out(name, arguments, context)
            result = self._success(tool, answer)
        except RoboNeuronError as error:
            log.info("%s was refused: %s: %s", shortened(name), error.code, _clipped(str(error)))
            code, result = error.code, self.failure(error)
        except UnfinishedCallError:
            raise
        except Exception:  # tool-call border: the agent gets an error, the log the traceback
            incident = uuid.uuid4().hex[:8]
            log.exception("%s failed (incident %s)", name, incident)
            unexpected = InternalError(
                f"{name} failed unexpectedly (incident {incident}).",
                hint="The server's log has the details; get_status tells what is running.",
            )
            code, result = unexpected.code, self.failure(unexpected)
        self._on_call(name, arguments, context.who, code, time.monotonic() - begun_s)
        return result

    def _success(self, tool: Tool[Any], answer: Answer) -> types.CallToolResult:
        """Return the answer to a call that succeeded. Raises InvalidInputError: it is too long."""
        structured = dict(answer.structured)
        if tool.open_world and not tool.read_only and self._acts_on is not None:
            structured["acts_on"] = self._acts_on()
        text = json.dumps(structured)
        if tool.read_only and len(text) > _MOST_ANSWER:
            raise InvalidInputError(
                f"The answer of {tool.name} has {len(text)} characters: too many.",
                hint="Ask for less: its arguments narrow what it answers.",
            )
        content: list[types.ContentBlock] = [
            types.TextContent(type="text", text=text),
            *(
                types.ImageContent(
                    type="image", data=b64encode(p.data).decode(), mime_type=p.mime_type
                )
                for p in answer.pictures
            ),
        ]
        return types.CallToolResult(content=content, structured_content=structured)

    @staticmethod
    def failure(error: RoboNeuronError) -> types.CallToolResult:
        """Return the answer to a failed call."""
        details = {
            "code": error.code,
            "message": _clipped(error.message),
            "hint": _clipped(error.hint),
        }
        if isinstance(error, InvalidInputError) and error.path:
            details["path"] = error.path[:_MOST_TEXT]
        if isinstance(error, RefusedError) and error.rule:
            details["rule"] = error.rule
        return types.CallToolResult(
            content=[types.TextContent(type="text", text=_clipped(str(error)))],
            _meta={ERROR_META: details},
            is_error=True,
        )

    async def _carry_out(
        self, name: str, arguments: Mapping[str, Any], context: CallContext
    ) -> tuple[Tool[Any], Answer]:
        tool = self.get(name)
        if tool is None:
            raise InvalidInputError(
                f"There is no tool {shortened(name)}.",
                hint=nearest(name, {*chain(*self._owned.values())}, _LISTED),
                path="tool",
            )
        tool.check_caller(context)
        if tool.urgent is not None:
            tool.urgent(arguments, context)
        if self.ready is not None:
            await self.ready()
        self._calls[context.role] += 1
        try:
            if self._calls[context.role] > self._most_calls and not tool.always:
                raise NotReadyError(
                    f"{self._most_calls} calls are already running for the role {context.role!r}; "
                    "no more are accepted.",
                    hint="Wait for one to end; max_concurrent_calls in [server] sets how many "
                    "there may be.",
                )
            for admit in self.admissions:
                admit(tool, context)
            return tool, await tool.call(arguments, context)
        finally:
            self._calls[context.role] -= 1


class _ListedTool:
    """A tool and its listing: built once, unless the tool has choices, which may change at any
    time.
    """

    def __init__(self, tool: Tool[Any]) -> None:
        self.tool = tool
        self._described: types.Tool | None = None

    def shown(self) -> types.Tool:
        """The entry of `tools/list`."""
        if self._described is None or self.tool.choices:
            self._described = _described(self.tool)
        return self._described


def _described(tool: Tool[Any]) -> types.Tool:
    return types.Tool(
        name=tool.name,
        description=tool.description,
        input_schema=tool.input_schema(),
        output_schema=listed_output(tool.result),
        annotations=types.ToolAnnotations(
            read_only_hint=tool.read_only,
            # without meaning for a read-only tool
            destructive_hint=None if tool.read_only else tool.destructive,
            idempotent_hint=None if tool.read_only else tool.idempotent or None,
            open_world_hint=None if tool.open_world else False,  # true by default
        ),
    )


def _clipped(text: str) -> str:
    """Bound the length of an error's text, which may quote the caller's arguments."""
    return text if len(text) <= _MOST_TEXT else f"{text[: _MOST_TEXT - 100]} ... {text[-80:]}"

"""All tools by name: lists them with their current choices, and calls one with checked
arguments.
"""

from __future__ import annotations

import threading
from base64 import b64encode
from collections.abc import Callable, Iterable, Mapping
from itertools import chain
from typing import Any

from mcp import types

from roboneuron.errors import (
    InternalError,
    InvalidInputError,
    RefusedError,
    RoboNeuronError,
)
from roboneuron.gate.roles import Role
from roboneuron.moved import Moved
from roboneuron.server.call_chain import (
    MOST_TEXT,
    CallChain,
    UnfinishedCallError,
    clipped,
    incident,
)
from roboneuron.server.interception import EndedCall, IncomingCall
from roboneuron.server.schema import listed_output
from roboneuron.server.tool import CallContext, Tool
from roboneuron.server.tool_search import CALL_TOOL, nearest_tools

_FIXED = ""
"""Owner of the tools that were added; the others are derived."""
ERROR_META = "roboneuron/error"
"""Key in a failed call's `_meta`: code, message, hint, and the rule of a refusal (clients check
`structuredContent` by the output schema).
"""


class ToolRegistry:
    """Tools in the order of their addition; the one border between MCP and all handlers.

    Args:
        tools: the initial tools.
        on_change: called, from any thread, when the listed derived tools changed.
        most_calls, on_begin, on_end, acts_on: see `CallChain`.

    Attributes:
        chain: what each call passes before its handler.
    """

    admissions = Moved("Feature.interceptors")
    replace = Moved("Feature.interceptors or Feature.start_forms")

    def __init__(
        self,
        tools: Iterable[Tool[Any]] = (),
        *,
        most_calls: int = 64,
        on_change: Callable[[], object] = lambda: None,
        on_begin: Callable[[IncomingCall], object] = lambda call: None,
        on_end: Callable[[EndedCall], object] = lambda ended: None,
        acts_on: Callable[[], str] | None = None,
    ) -> None:
        self.chain = CallChain(
            self.get,
            lambda: {*chain(*self._owned.values())},
            most_calls=most_calls,
            on_begin=on_begin,
            on_end=on_end,
            acts_on=acts_on,
        )
        self._on_change = on_change
        # for writers only: readers take the mapping, which is replaced as a whole and never changed
        self._lock = threading.Lock()
        self._owned: dict[str, dict[str, _ListedTool]] = {_FIXED: {}}
        self.add_all(tools)

    def add_all(self, tools: Iterable[Tool[Any]]) -> None:
        """Add all tools, or none.

        Raises:
            InternalError: a name already exists.
        """
        self._replace(_FIXED, [*(entry.tool for entry in self._owned[_FIXED].values()), *tools])

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
            entry.shown(self.chain.told(entry.tool.name))
            for entries in self._owned.values()
            for entry in entries.values()
            if entry.tool.listed and entry.tool.offered() and entry.tool.least_role.is_held_by(role)
        ]

    def short_listing(self, role: str) -> list[types.Tool]:
        """The listing of a role without rarely needed tools, if they can be found by search."""
        if CALL_TOOL not in self._owned[_FIXED]:
            return self.listing(role)
        seldom = {tool.name for tool in self.hidden(role)}
        return [tool for tool in self.listing(role) if tool.name not in seldom]

    def hidden(self, role: str) -> list[Tool[Any]]:
        """Tools that clients of a role may call and are not in its short listing: rarely needed
        ones, and derived ones that are too many to be listed.
        """
        return [
            entry.tool
            for owner, entries in self._owned.items()
            for entry in entries.values()
            if _is_hidden(entry.tool, is_derived=owner != _FIXED)
            and entry.tool.offered()
            and entry.tool.least_role.is_held_by(role)
        ]

    def _is_searched(self, tool: Tool[Any]) -> bool:
        """Whether it is one of `hidden`, in constant time: every call of call_tool asks."""
        is_derived = tool.name not in self._owned[_FIXED]
        return _is_hidden(tool, is_derived=is_derived) and tool.offered()

    def get(self, name: str, *, is_derived: bool = False) -> Tool[Any] | None:
        """Return the tool of that name, listed or not, or only a derived one. Constant time in the
        number of tools.
        """
        for owner, entries in self._owned.items():
            if name in entries and not (is_derived and owner == _FIXED):
                return entries[name].tool
        return None

    def _shown(self, owner: str) -> list[types.Tool]:
        entries = self._owned.get(owner, {})
        return [
            entry.shown(self.chain.told(name))
            for name, entry in entries.items()
            if entry.tool.listed
        ]

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
        """Pass a call through the chain and answer it; every failure becomes an MCP error result,
        except UnfinishedCallError.
        """
        try:
            if name == CALL_TOOL:
                name, arguments = self._named(arguments, context.role)
        except RoboNeuronError as error:
            return self.failure(error)
        call = IncomingCall(name=name, arguments=arguments, context=context, found=self.get(name))
        try:
            answer = await self.chain.run(call)
        except RoboNeuronError as error:
            return self.failure(error)
        except UnfinishedCallError:
            raise
        except Exception:  # of an interceptor before RECORD
            return self.failure(incident(name))
        content: list[types.ContentBlock] = [
            types.TextContent(type="text", text=answer.text),
            *(
                types.ImageContent(
                    type="image", data=b64encode(p.data).decode(), mime_type=p.mime_type
                )
                for p in answer.pictures
            ),
        ]
        return types.CallToolResult(content=content, structured_content=dict(answer.structured))

    def _named(self, arguments: Mapping[str, Any], role: str) -> tuple[str, Mapping[str, Any]]:
        """The tool that a call of call_tool names, and its arguments, so that the chain judges that
        tool. Raises InvalidInputError for one that is listed: a client's person may have agreed to
        call_tool, and not to that one. What stops something is passed on all the same.
        """
        caller = self.get(CALL_TOOL)
        if caller is None:  # the chain says that there is no such tool
            return CALL_TOOL, arguments
        asked = caller.parsed(arguments)
        found = self.get(asked.tool)
        if found is not None and (found.always or self._is_searched(found)):
            return asked.tool, asked.arguments
        if asked.tool != CALL_TOOL and found is not None:
            raise InvalidInputError(
                f"{asked.tool} is in the list of tools.", hint="Call it directly.", path="tool"
            )
        raise InvalidInputError(
            f"There is no such tool {asked.tool[:80]!r} to be found.",
            hint=nearest_tools(self.hidden(Role.ADMIN), asked.tool),
            path="tool",
        )

    @staticmethod
    def failure(error: RoboNeuronError) -> types.CallToolResult:
        """Return the answer to a failed call."""
        details = {
            "code": error.code,
            "message": clipped(error.message),
            "hint": clipped(error.hint),
        }
        if isinstance(error, InvalidInputError) and error.path:
            details["path"] = error.path[:MOST_TEXT]
        if isinstance(error, RefusedError) and error.rule:
            details["rule"] = error.rule
        return types.CallToolResult(
            content=[types.TextContent(type="text", text=clipped(str(error)))],
            _meta={ERROR_META: details},
            is_error=True,
        )


def _is_hidden(tool: Tool[Any], *, is_derived: bool) -> bool:
    return tool.seldom if tool.listed else is_derived


class _ListedTool:
    """A tool and its listing: built once, unless the tool has choices, which may change at any
    time.
    """

    def __init__(self, tool: Tool[Any]) -> None:
        self.tool = tool
        self._described: types.Tool | None = None

    def shown(self, told: str) -> types.Tool:
        """The entry of `tools/list`, with `told` at the end of the description."""
        if self._described is None or self.tool.choices:
            self._described = _described(self.tool, told)
        return self._described


def _described(tool: Tool[Any], told: str) -> types.Tool:
    return types.Tool(
        name=tool.name,
        description=f"{tool.description}{told}",
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

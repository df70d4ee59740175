"""MCP Tasks for run_task: the call returns at once with an id, for polling, waiting and cancelling.

For clients of revision 2025-11-25 over stdio, where the server ends with its client; over HTTP a
task could outlive the connection that it must end with. The SDK contains only the types of MCP
Tasks. All other clients make the plain call.

Source: Model Context Protocol, revision 2025-11-25, basic/utilities/tasks.
"""

from __future__ import annotations

import asyncio
import time
import uuid
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any, cast

from mcp import types
from mcp.server.context import CallNext, HandlerResult, ServerRequestContext
from mcp.server.session import ServerSession
from mcp.shared.exceptions import MCPError

VERSION = "2025-11-25"
TOOLS = frozenset({"run_task"})
RELATED = "io.modelcontextprotocol/related-task"
_CAPABILITY: dict[str, object] = {"list": {}, "cancel": {}, "requests": {"tools": {"call": {}}}}
_POLL_MS = 500
_TTL_MS, _LONGEST_TTL_MS = 3_600_000, 86_400_000
_MOST = 64
_CANCEL_S = 2.0
"""Longest wait of a cancellation's answer for the task's end; the arm is stopped before."""


class _AnsweredSession:
    """Session of a request after its answer: progress is sent to the connection and stored in the
    status.
    """

    def __init__(
        self, session: ServerSession, token: str | int | None, note: Callable[[str], object]
    ) -> None:
        self._session = session
        self._token = token
        self._note = note

    def __getattr__(self, name: str) -> object:
        return getattr(self._session, name)

    async def report_progress(
        self, progress: float, total: float | None = None, message: str | None = None
    ) -> None:
        self._note(message or "")
        if self._token is not None:
            await self._session.send_progress_notification(self._token, progress, total, message)


@dataclass(kw_only=True)
class _TaskCall:
    """A call that was answered with an id."""

    number: str
    ttl_ms: int
    began_s: float
    work: asyncio.Task[dict[str, Any]]
    created: str
    updated: str
    status: types.TaskStatus = "working"
    message: str = ""

    @property
    def is_over(self) -> bool:
        return self.status != "working"

    def note(self, message: str) -> None:
        """Store the progress."""
        self.message, self.updated = message, _now()

    def settle(self, status: types.TaskStatus, message: str) -> None:
        """Store the end; later calls change nothing."""
        if not self.is_over:
            self.note(message)
            self.status = status

    def told(self) -> dict[str, object]:
        """Format for the client."""
        task = types.Task(
            task_id=self.number,
            status=self.status,
            status_message=self.message or None,
            created_at=self.created,
            last_updated_at=self.updated,
            ttl=self.ttl_ms,
            poll_interval=_POLL_MS,
        )
        return task.model_dump(by_alias=True, mode="json", exclude_none=True)


class TaskCalls:
    """Middleware of the server (`mcp.server.context.ServerMiddleware`); used on the event loop
    only.

    Args:
        clock: monotonic time [s].
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._calls: dict[str, _TaskCall] = {}
        self._methods: dict[str, Callable[[Mapping[str, object]], Awaitable[dict[str, object]]]] = {
            "tasks/get": self._get,
            "tasks/result": self._result,
            "tasks/cancel": self._cancel,
            "tasks/list": self._list,
        }

    async def __call__(self, ctx: ServerRequestContext, call_next: CallNext) -> HandlerResult:
        """Handle requests about tasks; pass on all others."""
        if ctx.request is not None or ctx.request_id is None:
            return await call_next(ctx)
        if ctx.method == "initialize":
            result = _as_sent(await call_next(ctx))
            if result.get("protocolVersion") != VERSION:
                return result
            return {
                **result,
                "capabilities": {**result.get("capabilities", {}), "tasks": _CAPABILITY},
            }
        if ctx.protocol_version != VERSION or ctx.session.client_params is None:
            return await call_next(ctx)
        params: Mapping[str, Any] = ctx.params or {}
        if ctx.method in self._methods:
            self._forget()
            return await self._methods[ctx.method](params)
        if ctx.method == "tools/call" and params.get("task") is not None:
            return self._begin(ctx, params, call_next)
        if ctx.method == "tools/list":
            result = _as_sent(await call_next(ctx))
            optional = {"execution": {"taskSupport": "optional"}}
            tools = [
                {**tool, **optional} if tool["name"] in TOOLS else tool for tool in result["tools"]
            ]
            return {**result, "tools": tools}
        return await call_next(ctx)

    def _begin(
        self, ctx: ServerRequestContext, params: Mapping[str, Any], call_next: CallNext
    ) -> dict[str, object]:
        if params.get("name") not in TOOLS:
            raise MCPError(
                types.METHOD_NOT_FOUND, f"{str(params.get('name'))[:80]} does not run as a task."
            )
        asked = types.CallToolRequestParams.model_validate(params, by_name=False).task
        assert asked is not None
        ttl_ms = min(max(asked.ttl if asked.ttl is not None else _TTL_MS, 0), _LONGEST_TTL_MS)
        plain = {key: value for key, value in params.items() if key != "task"}

        async def work() -> dict[str, Any]:
            token = (params.get("_meta") or {}).get("progressToken")
            session = _AnsweredSession(ctx.session, token, lambda message: call.note(message))
            try:
                asked_now = replace(ctx, params=plain, session=cast("ServerSession", session))
                result = _as_sent(await call_next(asked_now))
            except asyncio.CancelledError:
                call.settle("cancelled", "cancelled")
                raise
            except Exception as error:
                call.settle("failed", str(error)[:500])
                raise
            call.settle("failed" if result.get("isError") else "completed", "ended")
            return result

        now = _now()
        call = _TaskCall(
            number=uuid.uuid4().hex,
            ttl_ms=ttl_ms,
            began_s=self._clock(),
            work=asyncio.create_task(work()),
            created=now,
            updated=now,
        )
        # taken by `tasks/result`
        call.work.add_done_callback(lambda done: done.cancelled() or done.exception())
        self._calls[call.number] = call
        return {"task": call.told()}

    async def _get(self, params: Mapping[str, object]) -> dict[str, object]:
        return self._find(params).told()

    async def _result(self, params: Mapping[str, object]) -> dict[str, object]:
        """Return or raise the result of the plain call; waits for it."""
        call = self._find(params)
        await asyncio.wait([call.work])
        if call.work.cancelled():
            raise MCPError(types.INVALID_REQUEST, "The task was cancelled; it has no result.")
        result = call.work.result()
        return {**result, "_meta": {**result.get("_meta", {}), RELATED: {"taskId": call.number}}}

    async def _cancel(self, params: Mapping[str, object]) -> dict[str, object]:
        call = self._find(params)
        if call.is_over:
            raise MCPError(types.INVALID_PARAMS, f"The task has ended already: {call.status}.")
        call.work.cancel()
        call.settle("cancelled", "cancelled by the client")
        await asyncio.wait([call.work], timeout=_CANCEL_S)
        return call.told()

    async def _list(self, params: Mapping[str, object]) -> dict[str, object]:
        if params.get("cursor") is not None:
            raise MCPError(types.INVALID_PARAMS, "There is one page only.")
        return {"tasks": [call.told() for call in self._calls.values()]}

    def _find(self, params: Mapping[str, object]) -> _TaskCall:
        call = self._calls.get(str(params.get("taskId")))
        if call is None:
            raise MCPError(types.INVALID_PARAMS, "There is no such task, or it was too long ago.")
        return call

    def _forget(self) -> None:
        """Discard results after their announced lifetime, and beyond a maximum number; running
        tasks are always kept.
        """
        over = [call for call in self._calls.values() if call.is_over]
        for index, call in enumerate(over):
            if self._clock() - call.began_s > call.ttl_ms / 1e3 or index < len(over) - _MOST:
                del self._calls[call.number]


def _as_sent(result: HandlerResult) -> dict[str, Any]:
    """Convert a result to its wire format."""
    assert isinstance(result, dict)
    return result


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")

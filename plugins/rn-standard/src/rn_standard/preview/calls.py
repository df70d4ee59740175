"""Calls with preview=true, handed to the tool `preview` instead of the tool that they name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from mcp.server.context import CallNext, HandlerResult, ServerRequestContext

NAME = "preview"


class PreviewCalls:
    """Middleware of the server (`mcp.server.context.ServerMiddleware`).

    The tool that acts is not called, and neither role, operator nor lease are asked for it: a
    preview is a call of a tool that only reads.

    Args:
        can: whether the tool of that name can be previewed.
    """

    def __init__(self, can: Callable[[str], bool]) -> None:
        self._can = can

    async def __call__(self, ctx: ServerRequestContext, call_next: CallNext) -> HandlerResult:
        """Hand the call on, as another one if it is a preview."""
        params: Mapping[str, Any] = ctx.params or {}
        arguments = params.get("arguments") if ctx.method == "tools/call" else None
        if not isinstance(arguments, Mapping) or arguments.get(NAME) is not True:
            return await call_next(ctx)
        name = str(params.get("name"))
        if not self._can(name):
            return await call_next(ctx)
        own = {key: value for key, value in arguments.items() if key != NAME}
        asked = {"tool": name, "arguments": own}
        return await call_next(replace(ctx, params={**params, "name": NAME, "arguments": asked}))

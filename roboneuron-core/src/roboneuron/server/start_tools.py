"""The tools that start the modules of the closed loop, made from the table of module kinds."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

from roboneuron.server.loop import ClosedLoop
from roboneuron.server.module_kinds import KINDS, KindEntry
from roboneuron.server.results import StartResult, module_summary
from roboneuron.server.tool import Arguments, CallContext, Tool


def start_tools(loop: ClosedLoop) -> list[Tool[Any]]:
    """One for each kind of module, in their usual order."""
    return [_start_tool(loop, entry) for entry in KINDS.values()]


def plugin_choices(loop: ClosedLoop, entry: KindEntry) -> dict[str, Callable[[], dict[str, str]]]:
    """The plugins that the arguments of a kind's tools can name."""
    return {argument: partial(loop.plugins.choices, kind) for argument, kind in entry.choices.items()}


def _start_tool(loop: ClosedLoop, entry: KindEntry) -> Tool[Any]:
    async def handler(request: Arguments, context: CallContext) -> StartResult:
        started_s = time.monotonic()
        view = await context.run(
            lambda stage: loop.start(entry.kind, request, stage, context.role),
            on_cancel=lambda: loop.cancel(entry.kind),
        )
        return StartResult(**module_summary(view), took_s=round(time.monotonic() - started_s, 3))

    return Tool(
        name=f"start_{entry.kind}",
        title=entry.title,
        description=f"{entry.start_text} Returns when it works ({entry.proof}); on any failure nothing is left "
        "running. An error if it already runs.",
        arguments=entry.request,
        result=StartResult,
        handler=handler,
        open_world=True,
        choices=plugin_choices(loop, entry),
    )

"""Calls of viewers never use the slots of acting clients."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import anyio

from roboneuron.server.registry import ToolRegistry
from roboneuron.server.tool import CallContext, NoArguments, Result, Tool


def context(role: str) -> Any:
    return SimpleNamespace(who=role, role=role, simulated=False)


def test_a_viewer_with_all_its_slots_taken_leaves_those_of_the_others() -> None:
    async def scenario() -> None:
        release = anyio.Event()

        async def wait(_: NoArguments, context: CallContext) -> Result:
            await release.wait()
            return Result()

        async def act(_: NoArguments, context: CallContext) -> Result:
            return Result()

        def tool(name: str, handler: Any, **more: Any) -> Tool[Any]:
            return Tool(
                name=name,
                title=name,
                description=name,
                arguments=NoArguments,
                result=Result,
                handler=handler,
                **more,
            )

        stop = tool("stop", act, always=True, role="viewer")
        registry = ToolRegistry(
            [tool("look", wait, read_only=True), tool("act", act), stop], most_calls=3
        )
        async with anyio.create_task_group() as group:
            for _ in range(3):
                group.start_soon(registry.call, "look", {}, context("viewer"))
            await anyio.wait_all_tasks_blocked()
            refused = await registry.call("look", {}, context("viewer"))
            assert "3 calls are already running for the role 'viewer'" in refused.content[0].text  # type: ignore[union-attr]
            for role in ("operator", "admin"):
                assert not (await registry.call("act", {}, context(role))).is_error
            assert not (await registry.call("stop", {}, context("viewer"))).is_error
            release.set()

    anyio.run(scenario)

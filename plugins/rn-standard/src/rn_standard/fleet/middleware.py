"""Middleware of each robot's features, applied to the calls of that robot."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from mcp.server.context import CallNext, HandlerResult, ServerMiddleware, ServerRequestContext

if TYPE_CHECKING:
    from rn_standard.fleet.tools import FleetTools
    from roboneuron.feature import Application


class RobotMiddleware:
    """Middleware of the fleet's server (`mcp.server.context.ServerMiddleware`).

    The features of each robot add their middleware to a separate server that no client reaches. It
    is applied to calls for that robot, which then look as in a server of one robot, without
    `robot`.

    Args:
        tools: determines the robot of a call.
        robots: all of them, before their features have added anything.
    """

    def __init__(self, tools: FleetTools, robots: Iterable[Application]) -> None:
        self._tools = tools
        self._given = {id(robot): len(robot.server.middleware) for robot in robots}

    async def __call__(self, ctx: ServerRequestContext, call_next: CallNext) -> HandlerResult:
        """Pass the request on, through the middleware of its robot."""
        params: Mapping[str, Any] = ctx.params or {} if ctx.method == "tools/call" else {}
        arguments = params.get("arguments") or {}
        robot, name = None, str(params.get("name"))
        if params and isinstance(arguments, Mapping):
            name, arguments = self._tools.meant_call(name, arguments)
            robot = self._tools.meant_robot(name, arguments)
        if robot is None:
            return await call_next(ctx)

        own = {key: value for key, value in arguments.items() if key != "robot"}
        of_robot = replace(ctx, params={**params, "name": name, "arguments": own})
        named = {"robot": arguments["robot"]} if "robot" in arguments else {}

        async def as_sent(sent: ServerRequestContext) -> HandlerResult:
            if sent is of_robot:
                return await call_next(ctx)
            changed: Mapping[str, Any] = sent.params or {}
            with_robot = {**(changed.get("arguments") or {}), **named}
            return await call_next(replace(sent, params={**changed, "arguments": with_robot}))

        chain: CallNext = as_sent
        for middleware in reversed(robot.server.middleware[self._given[id(robot)] :]):
            chain = partial(_through, middleware, chain)
        return await chain(of_robot)


async def _through(
    middleware: ServerMiddleware[Any], call_next: CallNext, ctx: ServerRequestContext
) -> HandlerResult:
    return await middleware(ctx, call_next)

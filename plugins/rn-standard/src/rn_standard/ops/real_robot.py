"""Confirmation by a person before a client first starts a real robot: `[real_robot]` of
roboneuron.toml.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import Literal

from pydantic import Field

from roboneuron import (
    Arguments,
    CallContext,
    Feature,
    Host,
    RefusedError,
    Reply,
    Result,
    Section,
    Tool,
)
from roboneuron.feature import AuditRecord

_STARTS = ("start_robot", "start_all")
_DOWN = ("stopped", "exited")
Handler = Callable[[Arguments, CallContext], Awaitable[Result | Reply]]


class RealRobotOptions(Section):
    """`[real_robot]`: confirmation of the first start of a robot whose driver is not declared as
    simulated.
    """

    confirm: Literal["ask", "require", "never"] = Field(
        default="ask",
        description="ask: the person behind the client, if it can ask one; require: no start "
        "without a person's "
        "agreement; never: no question",
    )


class RealRobotFeature(Feature[RealRobotOptions]):
    """Makes start_robot and start_all ask, once per robot and driver in the server's life."""

    _agreed: frozenset[tuple[str, str]] = frozenset()

    def complete(self, host: Host) -> None:
        """See `Feature.complete`: add the question before the tools that start a robot."""
        for name in _STARTS:
            tool = host.tools.get(name)
            if tool is None or self.options.confirm == "never":
                continue
            text = tool.description
            if host.loop.robot_facts.kind == "real":
                text = f"{text} A person is asked before the first start."
            host.tools.replace(replace(tool, handler=self._asking(host, tool), description=text))

    def _asking(self, host: Host, tool: Tool) -> Handler:
        async def handler(arguments: Arguments, context: CallContext) -> Result | Reply:
            if host.modules.view("robot").phase in _DOWN:
                await self._ask(
                    host, tool.name, arguments if tool.name == _STARTS[0] else None, context
                )
            return await tool.handler(arguments, context)

        return handler

    async def _ask(
        self, host: Host, tool: str, request: Arguments | None, context: CallContext
    ) -> None:
        """Raise RefusedError unless the robot is simulated, or a person agrees or has agreed
        before.
        """
        plan = await context.run(lambda _: host.loop.select("robot", request, context.role))
        driver = plan.driver
        which = plan.config.robot.name, driver.name
        if driver.simulated or which in self._agreed:
            return
        answer = await context.ask(
            f"Start the real robot {which[0]} (driver {which[1]})? It can move afterwards: look "
            "whether its "
            "workspace is free and the stop button is at hand."
        )
        refused = answer == "" or (answer is None and self.options.confirm == "require")
        said = {"": "a person did not agree", None: "this client cannot ask a person"}.get(
            answer, "a person agreed"
        )
        host.audit.write(
            AuditRecord(
                who=context.who,
                role=context.role,
                tool=tool,
                verdict="refused" if refused else "allowed",
                robot=which[0],
                reason=f"first start of the real robot by {which[1]}: {said}",
            )
        )
        if refused:
            raise RefusedError(
                f"The real robot {which[0]} (driver {which[1]}) is not started: {said}.",
                hint="Ask the person at the robot."
                if answer == ""
                else 'Use a client that supports elicitation, or let a person set confirm = "ask" '
                "in [real_robot].",
                rule="person",
            )
        self._agreed |= {which}

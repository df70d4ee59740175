"""Confirmation by a person before a client first starts a real robot: `[real_robot]` of
roboneuron.toml.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

from pydantic import Field

from roboneuron import (
    Arguments,
    CallContext,
    Feature,
    Host,
    RefusedError,
    Section,
)
from roboneuron.feature import (
    Answer,
    AuditRecord,
    CallPhase,
    IncomingCall,
    Interceptor,
    Proceed,
    StillReason,
)

_STARTS = ("start_robot", "start_all")
_DOWN = ("stopped", "exited")


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

    _host: Host | None = None
    _agreed: frozenset[tuple[str, str]] = frozenset()

    def interceptors(self, host: Host) -> Sequence[Interceptor]:
        """See `Feature.interceptors`: ask before the tools that start a robot."""
        if self.options.confirm == "never":
            return ()
        self._host = host

        async def ask(call: IncomingCall, proceed: Proceed) -> Answer:
            if host.modules.view("robot").phase in _DOWN:
                request = call.parsed if call.name == _STARTS[0] else None
                await self._ask(host, call.name, request, call.context)
            return await proceed(call)

        is_real = host.loop.robot_facts.kind == "real"
        return [
            Interceptor(
                name="real-robot",
                phase=CallPhase.CONFIRMATION,
                around=ask,
                tools=frozenset(_STARTS),
                told="A person is asked before the first start." if is_real else "",
            )
        ]

    def still_reasons(self, asker: CallContext | None) -> Sequence[StillReason]:
        """See `Feature.still_reasons`: a real robot before its first start."""
        host = self._host
        if host is None or host.modules.view("robot").phase not in _DOWN:
            return ()
        facts = host.loop.robot_facts
        if facts.kind != "real" or (facts.name, facts.driver) in self._agreed:
            return ()
        reason = StillReason(
            rank="person",
            rule="person",
            message=f"A person is asked before the {facts} is first started.",
            hint="Call start_robot by a client that can ask the person at the robot.",
        )
        return (reason,)

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

"""Tools of the whole fleet: list_fleet, and emergency_stop of all robots."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Protocol

import anyio
from pydantic import Field

from roboneuron import (
    Arguments,
    CallContext,
    InvalidInputError,
    NoArguments,
    NotReadyError,
    Result,
    RoboNeuronError,
    Tool,
)
from roboneuron.feature import Role

if TYPE_CHECKING:
    from roboneuron.feature import Application


STOP_MOTION = "stop_motion"


class StoppedTogether(Protocol):
    """Robots with a common emergency stop, in addition to their own.

    Attributes:
        robots: robots by name.
    """

    robots: dict[str, Application]

    def latch(self, who: str, reason: str) -> tuple[list[str], float]:
        """Latch, and return the confirmations and the time they took [s]."""


class FleetRobot(Result):
    """One robot."""

    name: str = Field(description="for the argument `robot`")
    robot: str = Field(description="its kind")
    driver: str
    namespace: str
    emergency_stop: bool
    modules: dict[str, str] = Field(description="health by module that is not stopped")


class FleetList(Result):
    """All robots of the server."""

    robots: list[FleetRobot]


class FleetStop(Arguments):
    """Arguments of emergency_stop."""

    reason: str = Field(
        default="", max_length=500, description="Why; kept in the latch and in the audit."
    )
    robot: str | None = Field(
        default=None, description="Which robot; all of them when omitted or unknown."
    )


class FleetStopResult(Result):
    """State of the latches, as reported by the modules themselves."""

    latched: bool
    confirmed_by: list[str] = Field(description="running modules that report it")
    took_s: float
    note: str = ""


def list_fleet_tool(robots: Mapping[str, Application]) -> Tool[NoArguments]:
    """list_fleet."""

    async def handler(_: NoArguments, context: CallContext) -> FleetList:
        return await context.run(
            lambda _: FleetList(robots=[_told(name, robot) for name, robot in robots.items()])
        )

    return Tool(
        name="list_fleet",
        title="The robots of this server",
        description="The robots, for the argument `robot` of all other tools; whether their "
        "emergency stop is latched, "
        "and the health of their modules.",
        arguments=NoArguments,
        result=FleetList,
        handler=handler,
        read_only=True,
        idempotent=True,
    )


def emergency_stop_tool(fleet: StoppedTogether) -> Tool[FleetStop]:
    """emergency_stop of all robots; a call for one robot is passed to that robot's own tool."""

    async def latch(arguments: FleetStop, context: CallContext) -> FleetStopResult:
        confirmed, took_s = await context.run(lambda _: fleet.latch(context.who, arguments.reason))
        if arguments.robot is not None:
            raise InvalidInputError(
                f"There is no robot {arguments.robot[:80]!r}: all robots were stopped.",
                hint=f"There are: {', '.join(fleet.robots)}.",
                path="robot",
            )
        note = (
            ""
            if confirmed
            else "No module runs; those that are started later are stopped from the beginning."
        )
        return FleetStopResult(
            latched=True, confirmed_by=confirmed, took_s=round(took_s, 3), note=note
        )

    return Tool(
        name="emergency_stop",
        title="Emergency stop",
        description=(
            "Stop all motion of all robots, or of one, now and keep it stopped until "
            "reset_emergency_stop of each, "
            "across restarts of anything. Modules go on running. Returns when every running "
            "module has confirmed it; "
            "an error names those that have not."
        ),
        arguments=FleetStop,
        result=FleetStopResult,
        handler=latch,
        destructive=True,
        idempotent=True,
        open_world=True,
        role=Role.VIEWER,  # every role that sees a robot may stop it
        always=True,
    )


class FleetMotionStop(Arguments):
    """Arguments of stop_motion."""

    robot: str | None = Field(
        default=None, description="Which robot; all of them when omitted or unknown."
    )


class FleetMotionStopResult(Result):
    """What was stopped, by robot."""

    robots: dict[str, dict[str, object]] = Field(
        description="answers of each robot's own stop_motion"
    )


def stop_motion_tool(robots: Mapping[str, Application]) -> Tool[FleetMotionStop]:
    """stop_motion of all robots; a call for one robot is passed to that robot's own tool."""

    async def stop(arguments: FleetMotionStop, context: CallContext) -> FleetMotionStopResult:
        answers: dict[str, dict[str, object]] = {}
        failures: list[str] = []

        async def stop_one(name: str) -> None:
            tool = robots[name].tools.get(STOP_MOTION)
            if tool is None:
                return
            try:
                answers[name] = dict((await tool.call({}, context)).structured)
            except RoboNeuronError as error:
                failures.append(f"{name}: {error}")

        async with anyio.create_task_group() as group:
            for name in robots:
                group.start_soon(stop_one, name)
        if failures:
            raise NotReadyError(
                "\n".join(failures), hint="Call emergency_stop if one of them moves."
            )
        if arguments.robot is not None:
            raise InvalidInputError(
                f"There is no robot {arguments.robot[:80]!r}: the motions of all robots were "
                "stopped.",
                hint=f"There are: {', '.join(robots)}.",
                path="robot",
            )
        return FleetMotionStopResult(robots={name: answers[name] for name in sorted(answers)})

    return Tool(
        name=STOP_MOTION,
        title="Stop moving",
        description="End whatever moves the robots, or one of them, and say how they stand. "
        "Nothing is latched and no module stops: the next call may move them.",
        arguments=FleetMotionStop,
        result=FleetMotionStopResult,
        handler=stop,
        destructive=True,
        idempotent=True,
        open_world=True,
        role=Role.VIEWER,  # every role that sees a robot may stop it
        always=True,
    )


def _told(name: str, robot: Application) -> FleetRobot:
    config = robot.loop.config
    now_s = time.monotonic()
    return FleetRobot(
        name=name,
        robot=config.robot.name,
        driver=config.robot.driver,
        namespace=config.namespace,
        emergency_stop=robot.loop.emergency_stop.is_latched(),
        modules={
            view.kind: view.health(now_s)
            for view in robot.host.modules.views()
            if view.phase != "stopped"
        },
    )

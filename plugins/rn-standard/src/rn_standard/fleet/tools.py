"""Tools of all robots in one list: a call names the robot, and is passed to that robot's own
registry.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, TypeVar

from mcp import types

from rn_standard.fleet.schemas import merged_tool
from rn_standard.fleet.search import CALL, CallRobotTool, search_tools
from roboneuron import CallContext, InvalidInputError, RoboNeuronError, Tool, nearest
from roboneuron.feature import Role, Stage, ToolRegistry

if TYPE_CHECKING:
    from roboneuron.feature import Application

T = TypeVar("T")
_OF_ONE = frozenset({"find_tools", "call_tool"})
"""Tools of a robot's own list, in whose place are those of all robots."""


class RobotContext:
    """CallContext of a call to one of several robots: questions to the user name the robot.

    Args:
        context: context of the request.
        robot: the robot's name.
    """

    def __init__(self, context: CallContext, robot: str) -> None:
        self._context = context
        self._robot = robot
        self.who = context.who
        self.role = context.role
        self.simulated = context.simulated

    async def run(
        self,
        work: Callable[[Stage], T],
        *,
        on_cancel: Callable[[], object] = lambda: None,
        on_leave: Callable[[], object] | None = None,
    ) -> T:
        """See CallContext."""
        return await self._context.run(work, on_cancel=on_cancel, on_leave=on_leave)

    async def ask(self, question: str, what: str = "") -> str | None:
        """See CallContext."""
        return await self._context.ask(f"Robot {self._robot}: {question}", what)


def unwrapped(call: CallRobotTool) -> tuple[str, dict[str, object]]:
    """Name and arguments of the call inside a call of call_robot_tool."""
    return call.tool, {**call.arguments, "robot": call.robot}


class FleetTools(ToolRegistry):
    """Lists the tools of all robots, and passes each call on.

    Args:
        robots: by name.
        own: tools of the whole fleet. One with the name of a robot's tool is called if no robot is
            named.
        on_client: called with the client of each call.
    """

    def __init__(
        self,
        robots: Mapping[str, Application],
        own: list[Tool],
        on_client: Callable[[str], object],
    ) -> None:
        super().__init__([*own, *(search_tools(self._seldom) if len(robots) > 1 else ())])
        self._robots = robots
        self._on_client = on_client

    def listing(self, role: str = Role.ADMIN) -> list[types.Tool]:
        """Tools in the answer to `tools/list` for clients of a role; for several robots without
        rarely needed ones.
        """
        shared = self._shared(role)
        return [
            *super().listing(role),
            *(tool for tool in shared if not self._is_seldom(tool.name)),
        ]

    def _seldom(self, role: str) -> list[types.Tool]:
        return [tool for tool in self._shared(role) if self._is_seldom(tool.name)]

    def _is_seldom(self, name: str) -> bool:
        tools = [
            tool for robot in self._robots.values() if (tool := robot.tools.get(name)) is not None
        ]
        return len(self._robots) > 1 and all(tool.seldom for tool in tools)

    def _shared(self, role: str) -> list[types.Tool]:
        """The tools of all robots, without duplicates."""
        by_name: dict[str, dict[str, types.Tool]] = {}
        for name, robot in self._robots.items():
            for tool in robot.tools.listing(role):
                by_name.setdefault(tool.name, {})[name] = tool
        namespaces = {name: robot.loop.config.namespace for name, robot in self._robots.items()}
        return [
            merged_tool(shown, namespaces, required=len(self._robots) > 1)
            for name, shown in by_name.items()
            if self.get(name) is None and name not in _OF_ONE
        ]

    async def call(
        self, name: str, arguments: Mapping[str, object], context: CallContext
    ) -> types.CallToolResult:
        """Call the tool of the named robot; every failure is an MCP error result."""
        caller = self.get(CALL)
        if name == CALL and caller is not None:
            try:
                name, arguments = unwrapped(caller.parsed(arguments))
            except RoboNeuronError as error:
                return self.failure(error)
        robot = arguments.get("robot")
        is_known = isinstance(robot, str) and robot in self._robots
        if self.get(name) is not None and not is_known:
            try:
                return await super().call(name, arguments, context)
            finally:  # a stop comes before leases
                self._on_client(context.who)
        self._on_client(context.who)
        try:
            chosen = self._choose(name, robot)
        except RoboNeuronError as error:
            return self.failure(error)
        rest = {key: value for key, value in arguments.items() if key != "robot"}
        return await self._robots[chosen].tools.call(name, rest, RobotContext(context, chosen))

    def _choose(self, tool: str, robot: object) -> str:
        """Choose the robot of a call.

        Raises:
            InvalidInputError: no robot has the tool, or the named one is missing or unknown; lists
                the choices.
        """
        having = [name for name, one in self._robots.items() if one.tools.get(tool) is not None]
        if not having:
            names = sorted({name for one in self._robots.values() for name in one.tools.names()})
            raise InvalidInputError(
                f"There is no tool {tool[:80]!r}.",
                hint=nearest(tool[:80], names, "search_tools finds one by words."),
                path="tool",
            )
        choices = f"Choose one of: {', '.join(having)}."
        if robot is None:
            if len(self._robots) > 1:
                raise InvalidInputError(
                    f"{tool} needs `robot`, which robot is meant.", hint=choices, path="robot"
                )
            return having[0]
        if not isinstance(robot, str) or robot not in self._robots:
            meant = nearest(str(robot)[:80], having, choices)
            raise InvalidInputError(
                f"There is no robot {str(robot)[:80]!r}.", hint=meant, path="robot"
            )
        if robot not in having:
            raise InvalidInputError(
                f"The robot {robot!r} has no tool {tool}.", hint=choices, path="robot"
            )
        return robot

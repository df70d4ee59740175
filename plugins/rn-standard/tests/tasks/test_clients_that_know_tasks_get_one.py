"""MCP Tasks of 2025-11-25 by raw JSON-RPC messages: begin, look, wait, cancel; everybody else makes
the plain call.
"""

from __future__ import annotations

import threading
from collections.abc import Awaitable, Callable
from datetime import datetime
from types import SimpleNamespace
from typing import Any, cast

import anyio
import pytest
from mcp import types
from mcp.shared.memory import create_client_server_memory_streams
from mcp.shared.message import SessionMessage

from rn_standard.tasks.plugin import FEATURE
from rn_standard.tasks.task_calls import RELATED, TaskCalls
from rn_testing.fakes import fake_registry
from roboneuron.config import parse_config
from roboneuron.errors import RefusedError
from roboneuron.selection.plugin import FEATURE as SELECTION
from roboneuron.server.app import Application
from roboneuron.server.registry import ToolRegistry
from roboneuron.server.surface import Served, make_server
from roboneuron.server.tool import CallContext, NoArguments, Result, Stage, Tool

KNOWS, OLD = "2025-11-25", "2025-06-18"


class Done(Result):
    outcome: str


class Robot:
    """What run_task and wave do here: they work until the test lets them end, or the call is
    cancelled.
    """

    def __init__(self) -> None:
        self.may_end, self.halted, self.begun = (
            threading.Event(),
            threading.Event(),
            threading.Event(),
        )

    async def run_task(self, _: NoArguments, context: CallContext) -> Done:
        def work(stage: Stage) -> Done:
            stage("attempt 1")
            self.begun.set()
            while not self.may_end.wait(0.005):
                if self.halted.is_set():
                    raise RefusedError("halted")
            return Done(outcome="succeeded")

        return await context.run(work, on_cancel=self.halted.set)


class Wire:
    """A client that sends what it likes."""

    def __init__(self, streams: Any) -> None:
        self._read, self._write = streams
        self._id = 0
        self.notices: list[dict[str, Any]] = []

    async def send(self, method: str, **params: Any) -> int:
        self._id += 1
        message = {"jsonrpc": "2.0", "id": self._id, "method": method, "params": params}
        await self._write.send(SessionMessage(types.JSONRPCRequest.model_validate(message)))
        return self._id

    async def answer(self, number: int) -> dict[str, Any]:
        while True:
            item = await self._read.receive()
            told = item.message.model_dump(mode="json", by_alias=True, exclude_none=True)
            if told.get("id") == number:
                return cast("dict[str, Any]", told)
            self.notices.append(told)

    async def ask(self, method: str, **params: Any) -> dict[str, Any]:
        return await self.answer(await self.send(method, **params))

    async def result(self, method: str, **params: Any) -> dict[str, Any]:
        answer = await self.ask(method, **params)
        assert "result" in answer, answer
        return cast("dict[str, Any]", answer["result"])

    async def until(self, task: str, status: str) -> dict[str, Any]:
        while (told := await self.result("tasks/get", taskId=task))["status"] != status:
            await anyio.sleep(0.005)
        return told

    async def begin(self, **more: Any) -> str:
        created = await self.result(
            "tools/call", name="run_task", arguments={}, task={"ttl": 60000}, **more
        )
        assert created["task"]["status"] == "working"
        return cast(str, created["task"]["taskId"])


Talk = Callable[[Wire, Robot], Awaitable[None]]


def converse(talk: Talk, version: str = KNOWS, clock: Callable[[], float] | None = None) -> None:
    """Have a client of a revision talk to a server with run_task."""
    robot = Robot()

    def tool(name: str, handler: Any) -> Tool[Any]:
        return Tool(
            name=name,
            title=name,
            description=name,
            arguments=NoArguments,
            result=Done,
            handler=handler,
        )

    tools = ToolRegistry([tool("run_task", robot.run_task), tool("wave", robot.run_task)])
    server = make_server(cast(Served, SimpleNamespace(tools=tools, features=None)), "test")
    server.middleware.append(TaskCalls() if clock is None else TaskCalls(clock))

    async def scenario() -> None:
        async with (
            create_client_server_memory_streams() as (client, (read, write)),
            anyio.create_task_group() as group,
        ):
            group.start_soon(server.run, read, write, server.create_initialization_options())
            wire = Wire(client)
            with anyio.fail_after(30):
                about = {"capabilities": {}, "clientInfo": {"name": "raw", "version": "1"}}
                begun = await wire.result("initialize", protocolVersion=version, **about)
                assert ("tasks" in begun["capabilities"]) is (version == KNOWS)
                note = types.JSONRPCNotification(jsonrpc="2.0", method="notifications/initialized")
                await client[1].send(SessionMessage(note))
                await talk(wire, robot)
            robot.may_end.set()
            group.cancel_scope.cancel()

    anyio.run(scenario)


def test_the_server_says_what_it_can_and_for_which_tool() -> None:
    async def talk(wire: Wire, robot: Robot) -> None:
        tools = (await wire.result("tools/list"))["tools"]
        assert {t["name"]: t.get("execution") for t in tools} == {
            "run_task": {"taskSupport": "optional"},
            "wave": None,
        }

    converse(talk)


def test_a_task_is_answered_at_once_and_its_result_is_that_of_the_plain_call() -> None:
    async def talk(wire: Wire, robot: Robot) -> None:
        task = await wire.begin(_meta={"progressToken": "p"})
        while (told := await wire.result("tasks/get", taskId=task)).get(
            "statusMessage"
        ) != "attempt 1":
            await anyio.sleep(0.005)
        assert (told["taskId"], told["status"], told["ttl"]) == (task, "working", 60000)
        assert datetime.fromisoformat(told["createdAt"]) <= datetime.fromisoformat(
            told["lastUpdatedAt"]
        )
        assert told["pollInterval"] > 0
        waiting = await wire.send("tasks/result", taskId=task)
        assert [t["taskId"] for t in (await wire.result("tasks/list"))["tasks"]] == [task]
        robot.may_end.set()
        result = (await wire.answer(waiting))["result"]
        assert result["structuredContent"] == {"outcome": "succeeded"}
        assert result["_meta"][RELATED] == {"taskId": task}
        assert (await wire.result("tasks/get", taskId=task))["status"] == "completed"
        again = await wire.result("tasks/result", taskId=task)
        assert again == result
        progress = [n["params"] for n in wire.notices if n["method"] == "notifications/progress"]
        assert [(p["progressToken"], p["message"]) for p in progress] == [("p", "attempt 1")]

    converse(talk)


def test_cancelling_a_task_stops_the_robot_before_it_is_answered() -> None:
    async def talk(wire: Wire, robot: Robot) -> None:
        task = await wire.begin()
        while not robot.begun.is_set():
            await anyio.sleep(0.005)
        assert (await wire.result("tasks/cancel", taskId=task))["status"] == "cancelled"
        assert robot.halted.is_set()
        robot.may_end.set()
        assert (await wire.result("tasks/get", taskId=task))["status"] == "cancelled"
        assert "cancelled" in (await wire.ask("tasks/result", taskId=task))["error"]["message"]
        assert (await wire.ask("tasks/cancel", taskId=task))["error"][
            "code"
        ] == types.INVALID_PARAMS

    converse(talk)


def test_a_task_whose_call_fails_has_failed_and_says_so_as_the_plain_call_does() -> None:
    async def talk(wire: Wire, robot: Robot) -> None:
        robot.halted.set()
        task = await wire.begin()
        await wire.until(task, "failed")
        result = await wire.result("tasks/result", taskId=task)
        assert result["isError"]
        assert "halted" in result["content"][0]["text"]

    converse(talk)


@pytest.mark.parametrize("method", ["tasks/get", "tasks/result", "tasks/cancel"])
def test_a_task_that_nobody_knows_is_an_error(method: str) -> None:
    async def talk(wire: Wire, robot: Robot) -> None:
        assert (await wire.ask(method, taskId="other"))["error"]["code"] == types.INVALID_PARAMS

    converse(talk)


def test_a_tool_that_does_not_run_as_a_task_is_refused_as_one() -> None:
    async def talk(wire: Wire, robot: Robot) -> None:
        answer = await wire.ask("tools/call", name="wave", arguments={}, task={})
        assert answer["error"]["code"] == types.METHOD_NOT_FOUND
        assert not robot.begun.is_set()

    converse(talk)


def test_results_are_kept_for_as_long_as_was_said() -> None:
    now_s = [0.0]

    async def talk(wire: Wire, robot: Robot) -> None:
        robot.may_end.set()
        task = await wire.begin()
        await wire.until(task, "completed")
        now_s[0] = 61.0
        assert "error" in await wire.ask("tasks/result", taskId=task)

    converse(talk, clock=lambda: now_s[0])


def test_a_client_of_an_older_revision_makes_the_plain_call() -> None:
    async def talk(wire: Wire, robot: Robot) -> None:
        assert all("execution" not in tool for tool in (await wire.result("tools/list"))["tools"])
        robot.may_end.set()
        result = await wire.result("tools/call", name="run_task", arguments={})
        assert result["structuredContent"] == {"outcome": "succeeded"}
        assert (await wire.ask("tasks/list"))["error"]["code"] == types.METHOD_NOT_FOUND

    converse(talk, OLD)


def test_the_feature_offers_it(tmp_path: Any) -> None:
    registry = fake_registry(SELECTION, FEATURE)
    config = parse_config('[robot]\nname = "gantry"\n', registry=registry)
    application = Application(config, plugins=lambda: registry, directory=tmp_path)
    try:
        assert isinstance(application.server.middleware[1], TaskCalls)
    finally:
        application.close()

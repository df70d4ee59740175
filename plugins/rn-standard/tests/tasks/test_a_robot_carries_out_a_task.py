"""Real processes: everything at once, a task with an outcome, and tasks that are cancelled, stopped
or left.
"""

from __future__ import annotations

import json
import os
import random
import sys
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any

import anyio
import pytest
from mcp import Client, StdioServerParameters, types
from mcp.client.stdio import stdio_client

from rn_simulation import ground_truth
from rn_testing.domain import free_ros_domain

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timing, pytest.mark.timeout(400)]
SEQUENCES = 6
START_S, TASK_S, IDLE_S = 120.0, 40.0, 30.0
"""Bounds of what takes 8 s, 20 s and 1 s: a hang fails by name, long before the run's own limit."""
INSTRUCTION = "pick up the red cube"
NEVER = {"kind": "tcp_in", "lower_m": [9, 9, 9], "upper_m": [10, 10, 10]}
LIFTED = {
    "kind": "held",
    "for_s": 0.5,
    "of": {
        "kind": "all",
        "of": [
            {"kind": "gripper_holds"},
            {"kind": "monitor", "name": "colour-lifted", "options": {"colour": "red"}},
        ],
    },
}


@asynccontextmanager
async def server(folder: Any, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Client]:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(free_ros_domain()))
    monkeypatch.setenv("XDG_STATE_HOME", str(folder))
    monkeypatch.setenv(ground_truth.SWITCH, "on")
    parameters = StdioServerParameters(
        command=sys.executable, args=["-m", "roboneuron.cli.main", "serve"], env=dict(os.environ)
    )
    with (folder / "server.log").open("w") as log:
        async with Client(
            stdio_client(parameters, errlog=log), read_timeout_seconds=START_S
        ) as client:
            yield client


async def called(
    client: Client, tool: str, arguments: dict[str, Any] | None = None
) -> types.CallToolResult:
    answer = await client.call_tool(tool, arguments or {})
    assert not answer.is_error, answer.content
    return answer


async def is_instructed(client: Client) -> bool:
    """The policy runs and has an instruction."""
    modules = (await called(client, "get_status")).structured_content["modules"]  # type: ignore[index]
    inference = next(module for module in modules if module["module"] == "inference")
    return bool(inference["phase"] == "running" and inference["instruction"])


async def is_idle(client: Client) -> bool:
    """No instruction, and no joint that moves."""
    if await is_instructed(client):
        return False
    states = (await called(client, "read_joint_states", {"count": 10})).structured_content[
        "messages"
    ]  # type: ignore[index]
    positions = [state["position"] for state in states]
    return all(max(column) - min(column) < 0.003 for column in zip(*positions, strict=True))


async def becomes(fact: Callable[[Client], Awaitable[bool]], client: Client) -> None:
    with anyio.fail_after(IDLE_S):
        while not await fact(client):
            await anyio.sleep(0.1)


def test_a_cube_is_picked_up_and_the_outcome_tells_so(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def run() -> None:
        async with server(tmp_path, monkeypatch) as client:
            started = (await called(client, "start_all")).structured_content
            assert started is not None
            assert len(started["started"]) == 4
            answer = await called(
                client,
                "run_task",
                {"instruction": INSTRUCTION, "until": LIFTED, "on_end": "stop", "max_s": TASK_S},
            )
            result = answer.structured_content
            assert result is not None
            assert result["outcome"] == "succeeded", result
            assert sum(isinstance(part, types.ImageContent) for part in answer.content) == 4
            status = (await called(client, "get_status")).structured_content
            assert status is not None
            cubes = json.loads(
                next(m for m in status["modules"] if m["module"] == "robot")["detail"]["cubes"]
            )
            assert cubes["red"]["lifted_m"] > 0.08
            events = (await client.read_resource("roboneuron://events/tasks")).contents[0]
            assert isinstance(events, types.TextResourceContents)
            assert json.loads(events.text)["events"][0]["outcome"] == "succeeded"

    anyio.run(run)


def test_no_sequence_leaves_a_task_or_a_moving_arm(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    draw = random.Random(16)

    async def run() -> None:
        async with server(tmp_path, monkeypatch) as client:
            await called(client, "start_all")
            task = {"instruction": INSTRUCTION, "until": NEVER, "max_s": TASK_S, "max_attempts": 1}
            for number in range(SEQUENCES):
                kind = (
                    "emergency_stop"
                    if number == SEQUENCES - 1
                    else draw.choice(["cancel", "stop_inference"])
                )
                async with anyio.create_task_group() as group:
                    outcome: list[types.CallToolResult] = []

                    async def start(outcome: list[types.CallToolResult] = outcome) -> None:
                        outcome.append(await client.call_tool("run_task", task))

                    group.start_soon(start)
                    if kind != "cancel":  # what is stopped before the task begins is started by it
                        await becomes(is_instructed, client)
                    await anyio.sleep(draw.uniform(0.0, 4.0))
                    if kind == "cancel":
                        group.cancel_scope.cancel()
                    else:
                        await client.call_tool(kind, {})
                await becomes(is_idle, client)
                if kind != "cancel" and not outcome[0].is_error:
                    assert (outcome[0].structured_content or {})["outcome"] == "stopped"

    anyio.run(run)

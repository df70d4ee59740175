"""A goal whose server takes its time: the call is over before the goal is accepted, and the goal
ends all the same.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import anyio
import pytest

pytestmark = [pytest.mark.ros, pytest.mark.timeout(60)]


class SlowServer:
    """Accepts a goal when it is told to, and follows it until it is cancelled or ten seconds are
    over.
    """

    def __init__(self, rover: Any) -> None:
        from rclpy.action import ActionServer, CancelResponse, GoalResponse
        from rclpy.callback_groups import ReentrantCallbackGroup
        from test_msgs.action import Fibonacci

        self.asked, self.may_accept, self.ended = (
            threading.Event(),
            threading.Event(),
            threading.Event(),
        )
        self.outcome = ""

        def accept(goal: Any) -> Any:
            self.asked.set()
            self.may_accept.wait(BUSY_S)
            return GoalResponse.ACCEPT

        def follow(goal: Any) -> Any:
            for _ in range(round(BUSY_S / 0.01)):
                if goal.is_cancel_requested:
                    goal.canceled()
                    self.outcome = "canceled"
                    break
                self.ended.wait(0.01)
            else:
                goal.succeed()
                self.outcome = "succeeded"
            self.ended.set()
            return Fibonacci.Result()

        self.server = ActionServer(
            rover.node,
            Fibonacci,
            "slow",
            follow,
            callback_group=ReentrantCallbackGroup(),
            goal_callback=accept,
            cancel_callback=lambda goal: CancelResponse.ACCEPT,
        )


BUSY_S = 60.0
"""Longest wait: a busy machine leaves this process a tenth of a core."""
CONFIG = """
[robot]
name = "rover"
[[expose]]
name = "slow"
kind = "action"
topic = "slow"
type = "test_msgs/action/Fibonacci"
"""


@pytest.fixture
def slow(rover: Any) -> Iterator[SlowServer]:
    server = SlowServer(rover)
    yield server
    server.may_accept.set()
    if server.asked.is_set():
        server.ended.wait(BUSY_S)
    server.server.destroy()


@pytest.mark.parametrize("cause", ["cancel", "stop"])
def test_a_goal_that_is_accepted_after_its_call_ended_is_cancelled(
    make_application: Any, slow: SlowServer, cause: str
) -> None:
    from mcp import Client

    application = make_application(CONFIG)
    texts: list[str] = []

    async def scenario() -> None:
        async with Client(application.server) as client:

            async def send() -> None:
                arguments = {"goal": {"order": 5}, "server_timeout_s": BUSY_S}
                answer = await client.call_tool("send_slow_goal", arguments)
                texts.append(answer.content[0].text)  # type: ignore[union-attr]

            with anyio.CancelScope() as scope:
                async with anyio.create_task_group() as group:
                    group.start_soon(send)
                    assert await anyio.to_thread.run_sync(slow.asked.wait, BUSY_S)
                    if cause == "cancel":
                        scope.cancel()
                    else:
                        await client.call_tool("emergency_stop", {})
            assert not slow.may_accept.is_set()
            while application.host.motions:  # the call has given up
                await anyio.sleep(0.01)
            slow.may_accept.set()
            assert await anyio.to_thread.run_sync(slow.ended.wait, BUSY_S)
        assert slow.outcome == "canceled"
        if cause == "stop":
            assert "the goal was asked to end, but did not confirm" in texts[0]

    anyio.run(scenario)

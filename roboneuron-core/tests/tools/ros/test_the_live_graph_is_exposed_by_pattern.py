"""Endpoints found in the live graph: only what a pattern allows, told to clients of both eras when
it changes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import anyio
import pytest
from mcp import Client

from roboneuron.server.app import Application

pytestmark = [pytest.mark.ros, pytest.mark.timeout(90)]
CONFIG = """
[robot]
name = "rover"
[[discover]]
pattern = "/rover/arm/*"
kinds = ["read", "publish", "service"]
period_s = 0.1
"""


async def names(client: Client) -> set[str]:
    return {tool.name for tool in (await client.list_tools()).tools}


def test_what_appears_becomes_a_tool_and_clients_are_told(
    make_application: Callable[..., Application], rover: Any
) -> None:
    from std_msgs.msg import Float32, String

    application = make_application(CONFIG)
    application.open()

    async def scenario() -> None:
        await application.settle()
        async with Client(application.server) as client:
            assert "read_arm_load" not in await names(client)
            async with client.listen(tools_list_changed=True) as events:
                rover.publish_often(Float32, "arm/load", Float32(data=2.5))
                rover.publish_often(String, "elsewhere", String())
                with anyio.fail_after(20):
                    async for _ in events:
                        if "read_arm_load" in await names(client):
                            break
            assert not any("elsewhere" in name for name in await names(client))
            answer = await client.call_tool("read_arm_load", {})
            assert answer.structured_content["messages"] == [{"data": 2.5}]
            rover.node.create_subscription(String, "arm/say", lambda message: None, 1)
            with anyio.fail_after(20):
                while "publish_arm_say" not in await names(client):
                    await anyio.sleep(0.05)
            sent = await client.call_tool("publish_arm_say", {"message": {"data": "x"}})
            assert not sent.is_error, sent.content

    anyio.run(scenario)


def test_a_client_of_the_older_era_is_told_too(
    make_application: Callable[..., Application], rover: Any
) -> None:
    from std_msgs.msg import Float32

    application = make_application(CONFIG)
    application.open()
    told = anyio.Event()

    async def hear(message: Any) -> None:
        if "tools/list_changed" in str(getattr(message, "method", message)):
            told.set()

    async def scenario() -> None:
        await application.settle()
        async with Client(application.server, mode="legacy", message_handler=hear) as client:
            await client.list_tools()
            rover.publish_often(Float32, "arm/load", Float32(data=2.5))
            with anyio.fail_after(20):
                await told.wait()

    anyio.run(scenario)

"""The protocol's SDK before its second version, at one revision: URL REVISION."""

from __future__ import annotations

import asyncio
import sys
from contextlib import AsyncExitStack
from typing import Any

import steps
from mcp import ClientSession, types
from mcp.client.streamable_http import streamablehttp_client

REVISION = sys.argv[2]
types.LATEST_PROTOCOL_VERSION = REVISION


async def main() -> None:
    async with AsyncExitStack() as stack:
        opened = streamablehttp_client(steps.URL, headers=steps.HEADERS)
        read, write, _ = await stack.enter_async_context(opened)
        session = await stack.enter_async_context(ClientSession(read, write))
        told = await session.initialize()
        assert told.protocolVersion == REVISION, told.protocolVersion

        async def text(name: str, arguments: dict[str, Any]) -> str:
            answer = await session.call_tool(name, arguments)
            return "\n".join(part.text for part in answer.content if part.type == "text")

        async def listed() -> str:
            found = [tool.name for tool in (await session.list_tools()).tools]
            return steps.expect("get_status" in found, str(len(found)))

        async def called() -> str:
            return steps.expect("modules" in (said := await text("get_status", {})), said)

        async def image() -> str:
            answer = await session.call_tool("get_camera_image", {})
            kinds = [part.type for part in answer.content]
            return steps.expect("image" in kinds, str(kinds))

        async def progress() -> str:
            seen: list[str] = []

            async def note(done: float, total: float | None, message: str | None) -> None:
                seen.append(message or "")

            await session.call_tool("start_control", steps.START, progress_callback=note)
            await text("stop_control", {})
            return steps.expect(seen, str(seen))

        async def cancel() -> str:
            number = session._request_id  # of the next request; the SDK cancels none by itself

            async def leave() -> None:
                params = types.CancelledNotificationParams(requestId=number)
                await session.send_notification(
                    types.ClientNotification(types.CancelledNotification(params=params))
                )

            return await steps.cancelled(
                lambda: session.call_tool("publish_velocity", steps.DRIVE), leave, text
            )

        await steps.go(
            {"list": listed, "call": called, "image": image, "progress": progress,
             "error": lambda: steps.error_of(text), "cancel": cancel}
        )  # fmt: skip


asyncio.run(main())

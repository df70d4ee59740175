"""The MCP clients of public frameworks, one table: `python clients.py NAME URL [REVISION]`.

Each is run by the interpreter of its own environment, tries the same steps, and tells each on a
line of JSON. URL is `stdio` with a command after REVISION for the SDK itself. Apart from the
framework only the standard library is imported.
"""

from __future__ import annotations

import asyncio
import json
import os
import re
import sys
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Collection
from contextlib import (
    AbstractAsyncContextManager,
    AsyncExitStack,
    asynccontextmanager,
    nullcontext,
)
from dataclasses import dataclass
from typing import Any

HEADERS = {"Authorization": f"Bearer {os.environ.get('TEST_TOKEN', '')}"}
"""All clients are one operator."""
DRIVE = {"message": {"linear": {"x": 0.1}}, "duration_s": 60}
DRIVEN_S, AT_ONCE_S, STEP_S = 1.5, 3.0, 120.0
IMAGES = re.compile(r"ImageContent|BinaryImage|PIL\.|'type': 'image'|'image': \{")
"""What frameworks make of an image."""
Note = Callable[[float, float | None, str | None], Awaitable[None]]


@dataclass
class Client:
    """A connected client.

    Attributes:
        names: names of the listed tools.
        call: an answer, as the framework shows it; an error may be an exception.
        seen: texts of progress; None if the framework passes none on.
        cancel: what cancels a call whose task was cancelled; None if the framework does it, or
            cannot.
    """

    names: Callable[[], Awaitable[Collection[str]]]
    call: Callable[[str, dict[str, Any]], Awaitable[object]]
    seen: list[str] | None = None
    cancel: Callable[[], Awaitable[object]] | None = None


def noting(seen: list[str]) -> Note:
    """A callback that keeps the texts of progress."""

    async def note(done: float, total: float | None, message: str | None, *_: object) -> None:
        seen.append(message or "")

    return note


@asynccontextmanager
async def mcp(url: str, revision: str, *command: str) -> AsyncIterator[Client]:
    """The protocol's SDK before its second version; it cancels nothing by itself."""
    from mcp import ClientSession, StdioServerParameters, stdio_client, types
    from mcp.client.streamable_http import streamablehttp_client

    types.LATEST_PROTOCOL_VERSION = revision
    seen: list[str] = []
    note = noting(seen)
    async with AsyncExitStack() as stack:
        if url == "stdio":
            server = StdioServerParameters(
                command=command[0], args=list(command[1:]), env=dict(os.environ)
            )
            opened: Any = stdio_client(server)
        else:
            opened = streamablehttp_client(url, headers=HEADERS)
        streams = await stack.enter_async_context(opened)
        session = await stack.enter_async_context(ClientSession(*streams[:2]))
        told = await session.initialize()
        assert told.protocolVersion == revision, told.protocolVersion

        async def names() -> list[str]:
            return [tool.name for tool in (await session.list_tools()).tools]

        async def call(name: str, arguments: dict[str, Any]) -> object:
            return await session.call_tool(name, arguments, progress_callback=note)

        async def cancel() -> None:
            params = types.CancelledNotificationParams(requestId=session._request_id - 1)
            await session.send_notification(
                types.ClientNotification(types.CancelledNotification(params=params))
            )

        yield Client(names, call, seen, cancel)


@asynccontextmanager
async def fastmcp(url: str) -> AsyncIterator[Client]:
    """fastmcp's client."""
    import fastmcp as framework

    seen: list[str] = []
    token = HEADERS["Authorization"].removeprefix("Bearer ")
    async with framework.Client(url, auth=token, progress_handler=noting(seen)) as client:

        async def names() -> list[str]:
            return [tool.name for tool in await client.list_tools()]

        async def call(name: str, arguments: dict[str, Any]) -> object:
            return await client.call_tool(name, arguments, raise_on_error=False)

        yield Client(names, call, seen)


@asynccontextmanager
async def langchain(url: str) -> AsyncIterator[Client]:
    """LangChain's adapter: every call has a session of its own."""
    from langchain_mcp_adapters.callbacks import Callbacks
    from langchain_mcp_adapters.client import MultiServerMCPClient

    seen: list[str] = []
    client = MultiServerMCPClient(
        {"robot": {"transport": "streamable_http", "url": url, "headers": HEADERS}},
        callbacks=Callbacks(on_progress=noting(seen)),
    )
    tools = {tool.name: tool for tool in await client.get_tools()}

    async def names() -> Collection[str]:
        return tools

    async def call(name: str, arguments: dict[str, Any]) -> object:
        return await tools[name].ainvoke(arguments)

    yield Client(names, call, seen)


@asynccontextmanager
async def strands(url: str) -> AsyncIterator[Client]:
    """The client of strands-agents."""
    import httpx2
    from mcp.client.streamable_http import streamable_http_client
    from strands.tools.mcp import MCPClient

    @asynccontextmanager
    async def opened() -> AsyncIterator[object]:
        async with (
            httpx2.AsyncClient(headers=HEADERS, timeout=60.0) as http,
            streamable_http_client(url, http_client=http) as streams,
        ):
            yield streams

    client = MCPClient(opened)
    await asyncio.to_thread(client.start)

    async def names() -> list[str]:
        return [tool.tool_name for tool in await asyncio.to_thread(client.list_tools_sync)]

    async def call(name: str, arguments: dict[str, Any]) -> object:
        return await client.call_tool_async("1", name, arguments)

    yield Client(names, call)
    await asyncio.to_thread(client.stop, None, None, None)


@asynccontextmanager
async def adk(url: str) -> AsyncIterator[Client]:
    """The MCP session of google-adk."""
    from google.adk.tools.mcp_tool.mcp_session_manager import (
        MCPSessionManager,
        StreamableHTTPConnectionParams,
    )

    parameters = StreamableHTTPConnectionParams(url=url, headers=HEADERS, timeout=60)
    manager = MCPSessionManager(parameters)
    session, seen = await manager.create_session(), list[str]()
    note = noting(seen)

    async def names() -> list[str]:
        return [tool.name for tool in (await session.list_tools()).tools]

    async def call(name: str, arguments: dict[str, Any]) -> object:
        return await session.call_tool(name, arguments, progress_callback=note)

    yield Client(names, call, seen)
    await manager.close()


@asynccontextmanager
async def openai(url: str) -> AsyncIterator[Client]:
    """The client of openai-agents."""
    from agents.mcp import MCPServerStreamableHttp

    async with MCPServerStreamableHttp(
        params={"url": url, "headers": HEADERS, "timeout": 60}, client_session_timeout_seconds=60
    ) as client:

        async def names() -> list[str]:
            return [tool.name for tool in await client.list_tools()]

        yield Client(names, client.call_tool)


CLIENTS: dict[str, Callable[..., AbstractAsyncContextManager[Client]]] = {
    "mcp": mcp,
    "fastmcp": fastmcp,
    "langchain": langchain,
    "strands": strands,
    "adk": adk,
    "openai": openai,
}


def expect(is_so: object, said: str) -> str:
    """Return what was said; raise AssertionError unless it is so."""
    if not is_so:
        raise AssertionError(said[:300])
    return said[:60].replace("\n", " ")


async def listed(client: Client) -> str:
    """The tools are listed."""
    return expect("get_status" in (found := await client.names()), f"{len(found)} tools")


async def called(client: Client) -> str:
    """A tool that reads answers."""
    said = str(await client.call("get_status", {}))
    return expect("modules" in said, said)


async def image(client: Client) -> str:
    """An image arrives, whatever the framework makes of it."""
    shown = await client.call("get_camera_image", {})
    found = IMAGES.search(f"{type(shown)} {shown!r}")
    return expect(found, found.group() if found else repr(shown))


async def error(client: Client) -> str:
    """A call that fails shows its reason, in an answer or an exception. Some frameworks offer only
    the tools that are listed.
    """
    wrong = {"tool": "describe_interface", "arguments": {"type": "no_such_msgs/msg/Nothing"}}
    try:
        said = str(await client.call("call_tool", wrong))
    except Exception as raised:  # every framework has its own
        said = f"{type(raised).__name__}: {raised}"
    return expect("no_such_msgs" in said, said)


async def progress(client: Client) -> str:
    """A start reports its stages."""
    if client.seen is None:
        return "the framework passes none on"
    await client.call("start_control", {"controller": "urdf"})
    await client.call("stop_control", {})
    return expect(client.seen, str(client.seen))


async def is_free(client: Client, within_s: float) -> bool:
    """True as soon as nothing drives any more."""
    end_s = time.monotonic() + within_s
    while time.monotonic() < end_s:
        said = str(await client.call("publish_velocity", {**DRIVE, "simulate": True}))
        if '"allowed":true' in said.replace("'", '"').replace(" ", "").lower():
            return True
        await asyncio.sleep(0.1)
    return False


async def cancelled(
    client: Client, connect: Callable[[], AbstractAsyncContextManager[Client]]
) -> str:
    """A drive ends when the task that calls is cancelled, or else when its client leaves."""
    async with AsyncExitStack() as stack:
        other = await stack.enter_async_context(connect())
        driving = asyncio.ensure_future(other.call("publish_velocity", dict(DRIVE)))
        await asyncio.sleep(DRIVEN_S)
        expect(not driving.done(), f"it did not drive: {driving}")
        driving.cancel()
        await asyncio.wait([driving], timeout=AT_ONCE_S)
        if other.cancel is not None:
            await other.cancel()
        if await is_free(client, AT_ONCE_S):
            return "the cancelled task ends it"
    expect(await is_free(client, AT_ONCE_S), "it drives on")
    return "the end of its client ends it"


async def main() -> None:
    """Try all steps in order; one that fails does not end the others."""
    name, *arguments = sys.argv[1:]

    is_stdio = arguments[0] == "stdio"
    async with CLIENTS[name](*arguments) as client:

        def connect() -> AbstractAsyncContextManager[Client]:
            return nullcontext(client) if is_stdio else CLIENTS[name](*arguments)

        if is_stdio:
            for tool in ("start_robot", "start_perception"):
                await client.call(tool, {})
        steps: dict[str, Callable[[], Awaitable[str]]] = {
            "list": lambda: listed(client),
            "call": lambda: called(client),
            "image": lambda: image(client),
            "error": lambda: error(client),
            "progress": lambda: progress(client),
            "cancel": lambda: cancelled(client, connect),
        }
        for step, attempt in steps.items():
            try:
                is_good, said = True, await asyncio.wait_for(attempt(), STEP_S)
            except Exception as raised:  # every framework has its own
                is_good, said = False, f"{type(raised).__name__}: {raised}"
            told = {"step": step, "good": is_good, "said": said[:200]}
            print(json.dumps(told), flush=True)


if __name__ == "__main__":
    asyncio.run(main())

"""What a scripted agent gets: the tools of the server, and its briefing."""

from __future__ import annotations

import base64
import json
import os
import shlex
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

import anyio
import httpx2
from mcp import Client, StdioServerParameters
from mcp.client.stdio import stdio_client
from mcp.client.streamable_http import streamable_http_client
from mcp.shared.exceptions import MCPError
from mcp.types import ImageContent, TextContent, Tool

from roboneuron import ConfigurationError, NotReadyError

TOKEN = "AGENT_EVAL_TOKEN"
"""Environment variable of an agent: the bearer token if the server is a URL."""
SERVER, INSTRUCTION, SEED, TRUTH = (
    "AGENT_EVAL_SERVER",
    "AGENT_EVAL_INSTRUCTION",
    "AGENT_EVAL_SEED",
    "AGENT_EVAL_TRUTH",
)
"""Environment variables of an agent: the server (shell command of an MCP server on stdio, or a URL
for HTTP), the person's instruction, a random seed, and, only for agents that know the truth, the
name of the task.
"""
CALL_TIMEOUT = "AGENT_EVAL_CALL_TIMEOUT_S"
"""Environment variable of an agent: longest time that a call may take [s]; longer in stepped time,
which a busy machine draws out.
"""
CALL_TIMEOUT_S = 120.0
_OTHER_CLIENT_S = 90.0


def call_timeout_s() -> float:
    """The longest time of a call [s]."""
    return float(os.environ.get(CALL_TIMEOUT, CALL_TIMEOUT_S))


@dataclass(frozen=True, kw_only=True, slots=True)
class Briefing:
    """What an agent is told.

    Attributes:
        instruction: the person's words, with the required form of the last words.
        seed: seed of the agent's random numbers.
        task: name of the task; "" unless the agent knows the truth.
    """

    instruction: str
    seed: int = 0
    task: str = ""

    @classmethod
    def from_environment(cls) -> Briefing:
        """Read the briefing of this process. Raises ConfigurationError outside of an evaluation."""
        try:
            instruction = os.environ[INSTRUCTION]
        except KeyError:
            raise ConfigurationError(
                f"The environment variable {INSTRUCTION} is not set.",
                hint="Start agents with roboneuron eval agents.",
            ) from None
        return cls(
            instruction=instruction,
            seed=int(os.environ.get(SEED, "0")),
            task=os.environ.get(TRUTH, ""),
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class ToolAnswer:
    """Result of a tool call.

    Attributes:
        ok: False for an error.
        data: the structured answer; empty after an error.
        code, rule, text: code, rule and text of the error; empty otherwise.
        images: encoded images in the answer.
    """

    ok: bool
    data: dict[str, object] = field(default_factory=dict)
    code: str = ""
    rule: str = ""
    text: str = ""
    images: tuple[bytes, ...] = ()

    def number(self, name: str) -> float:
        """Return a number of the answer. Raises NotReadyError if there is none of that name."""
        value = self.data.get(name)
        if not isinstance(value, int | float):
            raise NotReadyError(f"The answer has no number {name!r}: {str(self.data)[:200]}")
        return float(value)


class ToolClient:
    """The tools of one server; calls may be concurrent."""

    def __init__(self, client: Client, robot: str = "") -> None:
        """Args:
        client: a connected client.
        robot: argument of every call; "" if the server has one robot.
        """
        self._client = client
        self._always: dict[str, object] = {"robot": robot} if robot else {}

    def of(self, robot: str) -> ToolClient:
        """Return the tools for one of several robots."""
        return ToolClient(self._client, robot)

    async def names(self) -> list[str]:
        """Names of the offered tools."""
        return [tool.name for tool in await self.listed()]

    async def listed(self) -> list[Tool]:
        """The offered tools with their schemas."""
        return list((await self._client.list_tools()).tools)

    async def call(self, tool: str, /, **arguments: object) -> ToolAnswer:
        """Call a tool; errors are returned, not raised."""
        return await self.call_with(tool, arguments)

    async def call_with(
        self, tool: str, arguments: dict[str, object], timeout_s: float | None = None
    ) -> ToolAnswer:
        """Call a tool and wait at most `timeout_s` for the answer, without it `call_timeout_s`;
        errors are returned, not raised.
        """
        limit_s = timeout_s or call_timeout_s()
        try:
            result = await self._client.call_tool(
                tool, {**self._always, **arguments}, read_timeout_seconds=limit_s
            )
        except MCPError as error:
            return ToolAnswer(ok=False, code="protocol", text=str(error))
        images = tuple(
            base64.b64decode(part.data) for part in result.content if isinstance(part, ImageContent)
        )
        if result.is_error:
            told = (result.meta or {}).get("roboneuron/error")
            details = told if isinstance(told, dict) else {"code": "unknown"}
            text = " ".join(part.text for part in result.content if isinstance(part, TextContent))
            return ToolAnswer(
                ok=False,
                code=str(details.get("code")),
                rule=str(details.get("rule", "")),
                text=text,
                images=images,
            )
        return ToolAnswer(ok=True, data=dict(result.structured_content or {}), images=images)

    async def must(self, tool: str, /, **arguments: object) -> ToolAnswer:
        """Call a tool that must succeed.

        Raises:
            NotReadyError: it returned an error; contains the error text.
        """
        answer = await self.call(tool, **arguments)
        if not answer.ok:
            raise NotReadyError(f"{tool}({json.dumps(arguments)[:200]}): {answer.text}")
        return answer

    async def tcp_m(self) -> tuple[float, float, float]:
        """Measured TCP position in the base frame. Raises NotReadyError if there is none."""
        answer = await self.must("read_ee_pose")
        try:
            place = answer.data["messages"][0]["pose"]["position"]  # type: ignore[index]
            return float(place["x"]), float(place["y"]), float(place["z"])
        except (KeyError, IndexError, TypeError) as error:
            raise NotReadyError(f"read_ee_pose has no pose: {str(answer.data)[:200]}") from error


@asynccontextmanager
async def connected_to(url: str, token: str) -> AsyncIterator[Client]:
    """Connect a client to a server over HTTP."""
    headers = {"Authorization": f"Bearer {token}"}
    timeout = httpx2.Timeout(30.0, read=call_timeout_s())
    async with (
        httpx2.AsyncClient(headers=headers, timeout=timeout) as http,
        Client(streamable_http_client(url, http_client=http)) as client,
    ):
        yield client


@asynccontextmanager
async def connect() -> AsyncIterator[ToolClient]:
    """Connect to the server named in the environment.

    Raises:
        ConfigurationError: the environment names none.
    """
    address = os.environ.get(SERVER, "")
    if address.startswith("http"):
        async with connected_to(address, os.environ.get(TOKEN, "")) as client:
            yield ToolClient(client)
        return
    words = shlex.split(address)
    if not words:
        raise ConfigurationError(f"The environment variable {SERVER} does not name a server.")
    server = StdioServerParameters(command=words[0], args=words[1:], env=dict(os.environ))
    async with Client(stdio_client(server)) as client:
        yield ToolClient(client)


def begin_to_operate(url: str, token: str) -> None:
    """Start the robot as another client, which becomes the operator, and disconnect without
    releasing the lease, which then expires.

    Raises:
        NotReadyError: the robot could not be started.
    """
    anyio.run(_start_robot, url, token)


async def _start_robot(url: str, token: str) -> None:
    with anyio.move_on_after(_OTHER_CLIENT_S):
        async with connected_to(url, token) as client:
            await ToolClient(client).must("start_robot")
            return
    raise NotReadyError(f"The other client could not start the robot within {_OTHER_CLIENT_S:g} s.")

"""The scripted agent: a real MCP client whose only information is tools/list and the tools'
answers.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from mcp import Client
from mcp.types import ImageContent, TextContent

from rn_standard.demo.pace import MachinePace
from roboneuron import NotReadyError, foreign

_CALL_TIMEOUT_S = 180.0


@dataclass(frozen=True, kw_only=True, slots=True)
class DemoObject:
    """The simulator's report on one object.

    Attributes:
        name: for instance "red".
        lifted_m: height above its initial place.
        held_s: time since it was lifted by 10 cm or more without interruption [s].
    """

    name: str
    lifted_m: float
    held_s: float


class DemoAgent:
    """Calls tools and converts MCP errors to exceptions.

    Args:
        client: of the server.
        pace: given each answer of `get_status`.
    """

    def __init__(self, client: Client, pace: MachinePace | None = None) -> None:
        self._client = client
        self._pace = pace

    async def tools(self) -> list[str]:
        """Names of the offered tools."""
        return [tool.name for tool in (await self._client.list_tools()).tools]

    async def call(
        self, tool: str, arguments: Mapping[str, object] | None = None
    ) -> dict[str, object]:
        """Call a tool and return its structured answer.

        Raises:
            NotReadyError: the tool answered with an error; contains its text.
        """
        result = await self._client.call_tool(
            tool, dict(arguments or {}), read_timeout_seconds=_CALL_TIMEOUT_S
        )
        if result.is_error:
            texts = [part.text for part in result.content if isinstance(part, TextContent)]
            raise NotReadyError(f"{tool}: {' '.join(texts)}")
        answer = dict(result.structured_content or {})
        if self._pace is not None and tool == "get_status":
            self._pace.note(answer)
        return answer

    async def image(self, camera: str, robot: str | None = None) -> bytes:
        """The newest image of a camera, encoded; of the named robot if there are several."""
        arguments = {"camera": camera} if robot is None else {"camera": camera, "robot": robot}
        result = await self._client.call_tool("get_camera_image", arguments)
        for part in result.content:
            if isinstance(part, ImageContent):
                return base64.b64decode(part.data)
        texts = [part.text for part in result.content if isinstance(part, TextContent)]
        raise NotReadyError(f"get_camera_image: {' '.join(texts) or 'no image in the answer'}")

    async def status(self) -> dict[str, Any]:
        """Return the answer of `get_status`."""
        return await self.call("get_status", {"details": True})


def module_status(status: Mapping[str, Any], name: str) -> dict[str, Any]:
    """The part of `get_status` about one module, or an empty dict if it does not run."""
    for module in status.get("modules", ()):
        if module.get("module") == name:
            return dict(module)
    return {}


def simulated_objects(status: Mapping[str, Any]) -> list[DemoObject]:
    """The simulator's report on its objects; empty for a robot without one."""
    detail = module_status(status, "robot").get("detail") or {}
    objects = foreign.table(foreign.decode_json(detail.get("cubes", "{}"), "cubes"), "cubes")
    return [
        DemoObject(
            name=name,
            lifted_m=foreign.number(foreign.field(facts, "lifted_m"), "lifted_m"),
            held_s=foreign.number(foreign.field(facts, "held_s"), "held_s"),
        )
        for name, facts in objects.items()
    ]

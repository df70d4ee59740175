"""Every agent reads the whole list of tools: it stays within a bound, and answers match its
schemas.
"""

from __future__ import annotations

import anyio
import jsonschema
import pytest
from mcp import Client, types

from roboneuron.config import load_config
from roboneuron.gate.roles import Role
from roboneuron.plugins.discovery import discover
from roboneuron.server.app import Application

MOST_BYTES = 32_000
"""Bound for the default configuration with the packages of `[standard]` (including recorder and
view) and a robot.
"""
OPTIONAL = (
    "rn-eval-libero",
    "rn-backend-openpi",
    "rn-interfaces",
    "rn-robot-lerobot",
)
"""Packages with their own tools, backends or robots, installed in addition to the standard ones."""


def test_the_list_of_tools_is_at_most_32_kb() -> None:
    standard = load_config(registry=discover()).model_copy(update={"disabled_plugins": OPTIONAL})
    application = Application(standard)
    try:
        listing = types.ListToolsResult(tools=application.tools.short_listing(Role.ADMIN))
    finally:
        application.close()
    names = {tool.name for tool in listing.tools}
    assert {
        "start_inference",
        "find_tools",
        "publish_joint_trajectory",
        "move_ee",
        "get_status",
    } <= names
    size = len(listing.model_dump_json(by_alias=True, exclude_none=True).encode())
    assert size <= MOST_BYTES, f"tools/list is {size} bytes"


def test_answers_fit_the_listed_schemas() -> None:
    application = Application(load_config(registry=discover()))

    async def ask() -> None:
        async with Client(application.server) as client:
            for tool in (await client.list_tools()).tools:
                if tool.name in ("get_status", "list_robots", "list_backends", "stop_all"):
                    answer = await client.call_tool(tool.name, {})
                    assert answer.structured_content is not None, tool.name
                    assert tool.output_schema is not None
                    jsonschema.validate(answer.structured_content, tool.output_schema)
                    told, listed = (
                        answer.structured_content.keys(),
                        tool.output_schema["properties"].keys(),
                    )
                    assert told - {"acts_on"} <= listed
                    empty = {"emergency_stop_cause", "left_out", "versions"}
                    assert listed - told <= empty, "empty, or with details, so it is left out"

    try:
        anyio.run(ask)
    finally:
        application.close()


@pytest.mark.parametrize(
    ("query", "meant"),
    [
        ("switch policy backend list", ("switch_inference", "list_backends")),
        ("replace a running policy; list models checkpoints", ("switch_inference",)),
        ("show the log", ("get_logs",)),
        ("which topics are there", ("list_topics",)),
    ],
)
def test_a_rare_tool_is_found_by_the_words_of_a_request(query: str, meant: tuple[str, ...]) -> None:
    application = Application(load_config(registry=discover()))

    async def ask() -> list[str]:
        async with Client(application.server) as client:
            answer = await client.call_tool("find_tools", {"query": query, "schemas": False})
            return [tool["name"] for tool in (answer.structured_content or {})["tools"]]

    try:
        assert set(meant) <= set(anyio.run(ask))
    finally:
        application.close()


def test_a_backend_without_its_address_is_not_ready() -> None:
    application = Application(load_config(registry=discover()))

    async def ask() -> dict[str, str]:
        async with Client(application.server) as client:
            answer = await client.call_tool("list_backends", {})
            listed = (answer.structured_content or {})["backends"]
            return {entry["name"]: entry["status"] for entry in listed}

    try:
        told = anyio.run(ask)
    finally:
        application.close()
    assert (told["servo"], told["openpi"]) == ("ready", "not ready")

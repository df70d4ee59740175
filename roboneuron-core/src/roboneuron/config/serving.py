"""The section of the server: how agents connect."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from roboneuron.config.section import Name, Seconds, Section


class ServerConfig(Section):
    """`[server]`: how agents connect."""

    name: str = Field(default="roboneuron", description="server name that MCP clients see")
    transport: Name = Field(
        default="stdio", description="`stdio`, or what an installed feature serves: `http`, at /mcp"
    )
    max_concurrent_calls: Annotated[int, Field(ge=1, le=10000)] = Field(
        default=64, description="most tool calls at once of each role; stops are always taken"
    )
    dry_run: bool = Field(default=False, description="direct calls answer what would happen, nothing is sent")
    max_duration_s: Seconds = Field(default=120.0, description="longest direct motion, sequence or goal")
    reset_emergency_stop: Literal["person", "client"] = Field(
        default="person",
        description="who releases the emergency stop: a person, in a terminal or asked by a client; or any admin",
    )
    checkpoint_roots: tuple[str, ...] = Field(
        default=(),
        strict=False,
        description="folders whose checkpoints agents may name, besides those that this configuration names",
    )
    agent_options: tuple[Annotated[str, Field(pattern=r"^[a-z0-9-]+(\.[^.]+)+$")], ...] = Field(
        default=(),
        strict=False,
        description='options for the configuration only that an admin may set all the same, such as "pi0-remote.url"',
    )

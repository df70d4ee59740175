"""The section of the server: how agents connect."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from roboneuron.config.section import Name, Seconds, Section


class TokenConfig(Section):
    """One entry of `server.tokens`: where a bearer token is found, never the token itself."""

    name: Name = Field(description="who holds it; for the audit")
    role: Literal["viewer", "operator", "admin"] = Field(description="read; also move; also expose and reset")
    variable: str | None = Field(default=None, max_length=128, description="environment variable that holds it")
    file: str | None = Field(default=None, description="or a file that only its owner can read")


class ServerConfig(Section):
    """`[server]`: how agents connect."""

    name: str = Field(default="roboneuron", description="server name that MCP clients see")
    transport: Literal["stdio", "http"] = Field(default="stdio", description="http: streamable HTTP, at /mcp")
    host: str = Field(default="127.0.0.1", min_length=1, max_length=253, description="address that http listens on")
    port: Annotated[int, Field(ge=0, le=65535)] = Field(default=8765, description="port of http; 0: any free one")
    allowed_hosts: tuple[str, ...] = Field(
        default=(), strict=False, description="names that clients use for this machine, besides `host`"
    )
    allowed_origins: tuple[str, ...] = Field(
        default=(), strict=False, description="web pages that may connect, such as https://panel.lan"
    )
    lease_s: Seconds | None = Field(
        default=None, description="motion ends when its operator makes no call for this long; none: never"
    )
    max_request_bytes: Annotated[int, Field(ge=1024, le=1 << 28)] = Field(
        default=4 << 20, description="largest request over http"
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
    tokens: tuple[TokenConfig, ...] = Field(
        default=(), strict=False, description="who may connect over http: tables of `name`, `role`, `variable`, `file`"
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

"""The section `[http]` of roboneuron.toml."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field

from roboneuron import Section
from roboneuron.feature import Config


class TokenConfig(Section):
    """One entry of `http.tokens`: the place of a bearer token, never the token itself."""

    name: str = Field(
        pattern=r"^[a-z][a-z0-9-]*$", max_length=64, description="who holds it; for the audit"
    )
    role: Literal["viewer", "operator", "admin"] = Field(
        description="read; also move; also expose and reset"
    )
    variable: str | None = Field(
        default=None, max_length=128, description="environment variable that holds it"
    )
    file: str | None = Field(default=None, description="or a file that only its owner can read")


DEFAULT_LEASE_S = 120.0
"""Default lease: agents may think for a minute or two between calls; the robot keeps its own limits
meanwhile.
"""


class HttpOptions(Section):
    """`[http]`: the server over HTTP, and the robot's operator."""

    host: str = Field(
        default="127.0.0.1", min_length=1, max_length=253, description="address to listen on"
    )
    port: Annotated[int, Field(ge=0, le=65535)] = Field(
        default=8765, description="port; 0: any free one"
    )
    allowed_hosts: tuple[str, ...] = Field(
        default=(),
        strict=False,
        description="names that clients use for this machine, besides `host`",
    )
    allowed_origins: tuple[str, ...] = Field(
        default=(),
        strict=False,
        description="web pages that may connect, such as https://panel.lan",
    )
    lease_s: Annotated[float, Field(gt=0, le=3600)] | Literal["auto", "never"] = Field(
        default="auto",
        description="motion ends when its operator is silent for this long; auto: 120 over HTTP, "
        "never over stdio",
    )
    lease_streams: bool = Field(
        default=True,
        description="an open request or stream of the operator renews the lease; false: only its "
        "calls",
    )
    max_request_bytes: Annotated[int, Field(ge=1024, le=1 << 28)] = Field(
        default=4 << 20, description="largest request"
    )
    tokens: tuple[TokenConfig, ...] = Field(
        default=(),
        strict=False,
        description="who may connect: tables of `name`, `role`, `variable`, `file`",
    )

    @classmethod
    def of(cls, config: Config) -> Self:
        """Return the options of a configuration, which were checked when it was read."""
        return cls.model_validate(config.sections.get("http", {}))

    def lease_on(self, transport: str) -> float | None:
        """Longest silence of the operator of a server with this transport [s]; None for no
        lease.
        """
        if self.lease_s == "auto":
            return DEFAULT_LEASE_S if transport == "http" else None
        return None if self.lease_s == "never" else self.lease_s

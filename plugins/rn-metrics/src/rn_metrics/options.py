"""The section `[metrics]` of roboneuron.toml."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from roboneuron import Section


class MetricsOptions(Section):
    """`[metrics]`: data for programs that monitor many robots."""

    prometheus: bool = Field(default=False, description="serve metrics; nothing listens without it")
    host: str = Field(
        default="127.0.0.1", min_length=1, max_length=253, description="address to listen on"
    )
    port: Annotated[int, Field(ge=0, le=65535)] = Field(
        default=9464, description="port; 0: any free one"
    )
    traces: bool = Field(default=False, description="send spans of tool calls to otlp_endpoint")
    otlp_endpoint: str = Field(
        default="http://127.0.0.1:4318/v1/traces",
        max_length=500,
        description="OTLP over HTTP, of a collector",
    )

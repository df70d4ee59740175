"""What a user may set under `[plugins.openpi.server]`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from rn_vla.tcp_profiles import OptionSection
from roboneuron import ConfigurationOnly


class ServerOptions(OptionSection):
    """How `roboneuron openpi-server` serves."""

    host: Annotated[str | None, ConfigurationOnly()] = Field(
        default=None, min_length=1, description="address to listen on; this machine's own if unset"
    )
    port: int = Field(default=8000, ge=0, le=65535, description="port; 0 for any free one")
    token_file: Annotated[Path | None, ConfigurationOnly()] = Field(
        default=None, description="file with the key that clients send as Api-Key"
    )
    certificate: Annotated[Path | None, ConfigurationOnly()] = Field(
        default=None, description="PEM of the server; then wss://"
    )
    certificate_key: Annotated[Path | None, ConfigurationOnly()] = Field(
        default=None, description="PEM of its private key; in `certificate` when not given"
    )
    insecure: bool = Field(
        default=False,
        description="listen beyond this machine without token and certificate; logged",
    )
    clients: int = Field(default=16, ge=1, le=1024, description="most connections")
    waiting: int = Field(default=64, ge=1, le=4096, description="most observations that wait")
    most: int = Field(default=8, ge=1, le=256, description="most observations in one batch")
    linger_s: float = Field(
        default=0.003, ge=0, le=0.1, description="how long an idle server waits for other robots"
    )
    stateless: bool = Field(
        default=False,
        description="serve a backend that is asked one by one; only one that remembers nothing",
    )
    answer_timeout_s: float = Field(
        default=10.0, gt=0, le=600, description="an answer is worth nothing after this"
    )
    send_timeout_s: float = Field(
        default=5.0, gt=0, le=60, description="a client that does not read for so long is dropped"
    )
    idle_timeout_s: float = Field(
        default=600.0, gt=0, le=86400, description="a client that asks nothing for so long, too"
    )
    precision: Literal["float32", "float64"] = Field(
        default="float64", description="of the actions on the wire"
    )

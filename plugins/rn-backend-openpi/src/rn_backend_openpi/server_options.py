"""Options under `[plugins.openpi.server]`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from rn_vla.tcp_profiles import OptionSection
from roboneuron import ConfigurationOnly


class ServerOptions(OptionSection):
    """Options of `roboneuron openpi-server`."""

    host: Annotated[str | None, ConfigurationOnly()] = Field(
        default=None, min_length=1, description="address to listen on; this machine's own if unset"
    )
    port: int = Field(default=8000, ge=0, le=65535, description="port; 0 for any free one")
    token_file: Annotated[Path | None, ConfigurationOnly()] = Field(
        default=None, description="file with the key that clients send as Api-Key"
    )
    certificate: Annotated[Path | None, ConfigurationOnly()] = Field(
        default=None, description="PEM of the server; enables wss://"
    )
    certificate_key: Annotated[Path | None, ConfigurationOnly()] = Field(
        default=None, description="PEM of its private key; read from `certificate` if unset"
    )
    insecure: bool = Field(
        default=False,
        description="listen beyond this machine without token and certificate; logged",
    )
    clients: int = Field(default=16, ge=1, le=1024, description="most connections")
    waiting: int = Field(default=64, ge=1, le=4096, description="most observations in the queue")
    most: int = Field(default=8, ge=1, le=256, description="most observations in one batch")
    linger_s: float = Field(
        default=0.003, ge=0, le=0.1, description="wait of an idle server for further robots [s]"
    )
    stateless: bool = Field(
        default=False,
        description="serve a backend without batches; only one that keeps no history",
    )
    answer_timeout_s: float = Field(
        default=10.0, gt=0, le=600, description="time after which an answer is useless [s]"
    )
    send_timeout_s: float = Field(
        default=5.0,
        gt=0,
        le=60,
        description="disconnect a client that does not read for this time [s]",
    )
    idle_timeout_s: float = Field(
        default=600.0,
        gt=0,
        le=86400,
        description="disconnect a client without requests for this time [s]",
    )
    precision: Literal["float32", "float64"] = Field(
        default="float64", description="number type of the actions on the wire"
    )

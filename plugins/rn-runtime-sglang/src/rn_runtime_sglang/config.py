"""Options of the runtime `sglang`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from roboneuron import ConfigurationOnly

Seconds = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class SglangRuntimeConfig(BaseModel):
    """Either `python` (a server of its own, launched and ended with the model) or `urls` (servers
    that run anyway).
    """

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    python: Annotated[Path | None, ConfigurationOnly()] = None
    """Managed: interpreter of the virtual environment that SGLang and this package are installed
    in.
    """
    urls: Annotated[
        tuple[Annotated[str, Field(pattern=r"^https?://[^/\s?#]+/?$")], ...], ConfigurationOnly()
    ] = ()
    """Remote: one or several servers of the same model, for instance "https://gpu1:30000"."""
    key_variable: Annotated[
        str | None, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$"), ConfigurationOnly()
    ] = None
    """Remote: environment variable that holds the API key; none is sent when left out."""
    ca_file: Annotated[Path | None, ConfigurationOnly()] = None
    """Remote: certificate authority of https servers, where it is not one of the system's."""
    timeout_s: Annotated[float, Field(gt=0, le=60, allow_inf_nan=False)] = 1.5
    """An answer that takes longer is dropped and its request aborted; the backend's own limit
    counts when shorter.
    """
    connect_timeout_s: Seconds = 0.5
    """How long to wait for a connection."""
    attempts: Annotated[int, Field(ge=1, le=10)] = 2
    """How many servers (or times) one request may be sent to while its time lasts."""
    poll_s: Annotated[float, Field(ge=0.05, le=60, allow_inf_nan=False)] = 1.0
    """How often readiness and load of each server are asked for."""
    image_format: Literal["bmp", "png"] = "bmp"
    """How images travel, both without loss: `bmp` costs least time, `png` is half as large, for
    slow networks.
    """
    start_timeout_s: Seconds = 600.0
    """Managed: how long the server may take until it is ready; remote: how long to wait for the
    first one.
    """
    port: Annotated[int | None, Field(ge=1, le=65535), ConfigurationOnly()] = None
    """Managed: port on this machine; None takes a free one."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Managed: where the model runs; `cpu` needs the steps of docs/sglang.md."""
    dtype: Literal["auto", "float32", "bfloat16", "float16"] = "auto"
    """Managed: `auto` is the checkpoint's own on a GPU and float32 on the CPU."""
    server_arguments: Annotated[tuple[str, ...], ConfigurationOnly()] = ()
    """Managed: further arguments of the server, for instance ["--tp", "2"]."""
    environment: Annotated[dict[str, str], ConfigurationOnly()] = {}
    """Managed: further environment variables of the server."""
    log: Annotated[Path | None, ConfigurationOnly()] = None
    """Managed: file for the server's output; None takes a temporary one, which is kept when the
    server fails.
    """

    @model_validator(mode="after")
    def _check_mode(self) -> SglangRuntimeConfig:
        if (self.python is None) == (not self.urls):
            raise ValueError(
                "give either python (a server is launched) or urls (servers that run already)"
            )
        if len({url.rstrip("/") for url in self.urls}) != len(self.urls):
            raise ValueError("urls names a server twice")
        return self

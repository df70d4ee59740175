"""Options of the runtime `sglang`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from roboneuron import ConfigurationOnly

Seconds = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class SglangRuntimeConfig(BaseModel):
    """Either `python` (a server launched and ended with the model) or `urls` (servers that are
    already running).
    """

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    python: Annotated[Path | None, ConfigurationOnly()] = None
    """Managed: interpreter of the virtual environment with SGLang and this package."""
    urls: Annotated[
        tuple[Annotated[str, Field(pattern=r"^https?://[^/\s?#]+/?$")], ...], ConfigurationOnly()
    ] = ()
    """Remote: one or several servers of the same model, for instance "https://gpu1:30000"."""
    key_variable: Annotated[
        str | None, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$"), ConfigurationOnly()
    ] = None
    """Remote: environment variable with the API key; none is sent if unset."""
    ca_file: Annotated[Path | None, ConfigurationOnly()] = None
    """Remote: certificate authority of https servers, unless it is one of the system's."""
    timeout_s: Annotated[float, Field(gt=0, le=60, allow_inf_nan=False)] = 1.5
    """Time after which an answer is dropped and its request aborted; a shorter limit of the backend
    takes precedence.
    """
    connect_timeout_s: Seconds = 0.5
    """Longest wait for a connection."""
    attempts: Annotated[int, Field(ge=1, le=10)] = 2
    """Largest number of servers (or attempts) for one request within its time."""
    poll_s: Annotated[float, Field(ge=0.05, le=60, allow_inf_nan=False)] = 1.0
    """Period of queries for each server's readiness and load."""
    image_format: Literal["bmp", "png"] = "bmp"
    """Coding of images, both lossless: `bmp` takes the least time, `png` is half as large, for slow
    networks.
    """
    start_timeout_s: Seconds = 600.0
    """Managed: longest wait until the server is ready; remote: longest wait for the first one."""
    port: Annotated[int | None, Field(ge=1, le=65535), ConfigurationOnly()] = None
    """Managed: port on this machine; None chooses a free one."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Managed: device of the model; `cpu` needs the steps of docs/serving.md."""
    dtype: Literal["auto", "float32", "bfloat16", "float16"] = "auto"
    """Managed: `auto` is the checkpoint's own type on a GPU and float32 on the CPU."""
    server_arguments: Annotated[tuple[str, ...], ConfigurationOnly()] = ()
    """Managed: further arguments of the server, for instance ["--tp", "2"]."""
    environment: Annotated[dict[str, str], ConfigurationOnly()] = {}
    """Managed: further environment variables of the server."""
    log: Annotated[Path | None, ConfigurationOnly()] = None
    """Managed: file for the server's output; None for a temporary one, which is kept if the server
    fails.
    """

    @model_validator(mode="after")
    def _check_mode(self) -> SglangRuntimeConfig:
        if (self.python is None) == (not self.urls):
            raise ValueError(
                "give either python (a server is launched) or urls (servers that are running)"
            )
        if len({url.rstrip("/") for url in self.urls}) != len(self.urls):
            raise ValueError("urls names a server twice")
        return self

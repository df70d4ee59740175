"""The file of `roboneuron policy serve`."""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Self

from pydantic import Field, model_validator

from rn_backend_openpi.options import Identifier, ModelOptions
from rn_vla.tcp_profiles import OptionSection


class ReplicaOptions(OptionSection):
    """`[models.<name>.ray]`: the replicas of a model with `--engine ray`."""

    least: int = Field(default=1, ge=1, le=256, description="Smallest number of replicas")
    most: int = Field(
        default=1,
        ge=1,
        le=256,
        description="Largest number of replicas: more are started while each has more than one "
        "batch of observations, waiting ones included",
    )
    cpus: float = Field(
        default=1.0, ge=0, le=1024, description="CPUs that Ray reserves for a replica"
    )
    gpus: float = Field(
        default=0.0,
        ge=0,
        le=64,
        description="GPUs that Ray reserves for a replica; it sees no others",
    )

    @model_validator(mode="after")
    def _check_range(self) -> Self:
        if self.least > self.most:
            raise ValueError(f"least = {self.least} replicas is more than most = {self.most}")
        return self


class RayOptions(OptionSection):
    """`[ray]` of a server's file."""

    address: str | None = Field(
        default=None,
        description="The Ray cluster: `host:port`, or `auto` for the one of this machine. If "
        "unset: one that runs on this machine as long as the server.",
    )


class ServedModelOptions(ModelOptions):
    """`[models.<name>]` of a server's file."""

    ray: ReplicaOptions = Field(
        default=ReplicaOptions(), description="Its replicas; read with `--engine ray` only"
    )

    @model_validator(mode="after")
    def _has_a_backend(self) -> Self:
        if self.backend is None:
            raise ValueError("name the backend that holds the model")
        return self


class ListenOptions(OptionSection):
    """`[listen]` of a server's file: the address for robots of other machines, and their
    authentication.
    """

    host: str = Field(
        default="127.0.0.1",
        min_length=1,
        max_length=253,
        description="Address to listen on, of IPv4 or IPv6 (`::` for any of both), or a name: all "
        "its addresses",
    )
    port: int = Field(default=7420, ge=0, le=65535, description="TCP port; 0 for a free one")
    keys: Literal["link", "token", "none"] = Field(
        default="link",
        description="`link`: both sides use the keys of `roboneuron link` (mutual TLS 1.3). "
        "`token`: robots send a token. `none`: anybody who reaches the address.",
    )
    insecure: bool = Field(
        default=False, description="Listen beyond loopback without token and certificate; logged"
    )
    token_file: Path | None = Field(
        default=None,
        description="With `token`: its file, readable only by this user; created if missing",
    )
    certificate: Path | None = Field(
        default=None,
        description="Without `link`: the server's certificate chain (PEM), required unless it "
        "listens on loopback",
    )
    key: Path | None = Field(
        default=None, description="Its key (PEM); read from `certificate` if unset"
    )
    metrics_port: int | None = Field(
        default=None,
        ge=0,
        le=65535,
        description="Port of Prometheus metrics, usually 9465; 0 for a free one. If unset: no "
        "metrics are served.",
    )
    metrics_host: str = Field(
        default="127.0.0.1",
        min_length=1,
        max_length=253,
        description="Address of the metrics, likewise. Anyone who can reach it can read them, "
        "without a key.",
    )
    robots: int = Field(default=64, ge=1, le=100, description="Largest number of connected robots")
    drain_s: float = Field(
        default=0.0,
        ge=0,
        le=3600,
        description="Time after SIGTERM for which connected robots are still answered [s]; others "
        "are refused, and `/healthz` says 503",
    )
    directory: Path | None = Field(
        default=None,
        description="Folder of sockets and logs; by default in the user's run-time directory",
    )

    @model_validator(mode="after")
    def _check_keys(self) -> Self:
        if self.keys == "token" and self.token_file is None:
            raise ValueError("keys = 'token' needs a token_file")
        if self.keys != "token" and self.token_file is not None:
            raise ValueError("token_file belongs to keys = 'token'")
        if self.keys == "link" and (self.certificate or self.key or self.insecure):
            raise ValueError("certificate, key and insecure do not go with keys = 'link'")
        if self.certificate is None and self.key is not None:
            raise ValueError("key has no use without certificate")
        return self


class PolicyServerOptions(OptionSection):
    """The file of `roboneuron policy serve`."""

    listen: ListenOptions = Field(default=ListenOptions(), description="Address for robots")
    ray: RayOptions = Field(
        default=RayOptions(), description="The Ray cluster; read with `--engine ray` only"
    )
    models: dict[Identifier, ServedModelOptions] = Field(
        min_length=1, max_length=32, description="The served models by name"
    )

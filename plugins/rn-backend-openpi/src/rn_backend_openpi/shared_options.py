"""Options of the backend `shared`, and the identity of its server."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from rn_backend_openpi.options import InterfaceOptions
from roboneuron import MAX_SIDE_PX, ConfigurationOnly

Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]*$", max_length=64)]
Role = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$", max_length=64)]
_Pixel = Annotated[int, Field(ge=0, le=MAX_SIDE_PX)]
_Side = Annotated[int, Field(ge=1, le=MAX_SIDE_PX)]
Rectangle = Annotated[tuple[_Pixel, _Pixel, _Side, _Side], Field(strict=False)]
_WIRE = "websocket 1"
"""Part of the name of a local server, so that no release finds the server of another one."""
Table = Annotated[dict[str, object], ConfigurationOnly()]


def check_port(address: str | None) -> str | None:
    """Return an address. Raises ValueError: its port is beyond 65535."""
    if address is not None and int(address.rpartition(":")[2]) > 65535:
        raise ValueError(f"{address!r} names no port: write host:port, port from 1 to 65535")
    return address


class ModelOptions(BaseModel):
    """Options of the model and of its server."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    checkpoint: Annotated[str | None, ConfigurationOnly()] = None
    """Directory of its files, if it needs one."""
    options: Table = {}
    """Its own options, as under `[plugins.<backend>]`."""
    runtime: Annotated[Name | None, ConfigurationOnly()] = None
    """The runtime that executes it; the backend's default if unset."""
    runtime_options: Table = {}
    """Options of the runtime."""
    acceleration: Annotated[Name | None, ConfigurationOnly()] = None
    """A preset, if the runtime supports one."""
    acceleration_options: Table = {}
    """Options of the acceleration."""
    stateless: Annotated[bool, ConfigurationOnly()] = False
    """Share a backend that cannot answer several observations at once: they are answered one by
    one. Only for a backend that keeps no state from one observation to the next, otherwise it would
    mix the robots up.
    """
    crop: Annotated[dict[Role, Rectangle], ConfigurationOnly(), Field(max_length=16)] = {}
    """The part of an image that the checkpoint uses, by role of the camera: left, top, width and
    height [px]. A server crops whole images, and announces the crop to robots on other machines,
    which then send only that part. A crop set by a robot with an address is checked like
    `image_size`.
    """
    most: Annotated[int, Field(ge=1, le=256)] = 8
    """Largest number of observations in one batch."""
    waiting: Annotated[int, Field(ge=1, le=4096)] = 64
    """Largest number of queued observations; further ones are refused at once."""
    linger_s: Annotated[float, Field(ge=0, le=0.1, allow_inf_nan=False)] = 0.003
    """Time that an idle server waits for other robots before it answers the first one alone."""
    interface: Annotated[InterfaceOptions | None, ConfigurationOnly()] = None
    """For clients of openpi's kind: what their requests hold and what the answers mean, see the
    README. If unset: the state by name, and rows as the backend writes them.
    """
    python: Annotated[Path | None, ConfigurationOnly()] = None
    """Interpreter of the servers; by default that of this process."""
    environment: Annotated[dict[str, str], ConfigurationOnly()] = {}
    """Further environment variables of the servers."""


class SpaceOptions(BaseModel):
    """The control space of a model on another machine."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    kind: str
    """One of the contract's kinds, such as `joint_position`."""
    rate_hz: Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)] = 0.0
    """Rows per second for which the policy was trained; 0 for any rate."""
    channels: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """The robot's names of the policy's values, in the policy's order: joints, `gripper_open`,
    `left/x`. If unset: the robot's own order.
    """


class SharedOptions(ModelOptions):
    """The shared model and the connection to it. Robots with the same model options use the same
    server.
    """

    backend: Annotated[Name | None, ConfigurationOnly()] = None
    """The backend that holds the model, for instance `oft`; not needed with `address`."""
    address: Annotated[
        str | None,
        ConfigurationOnly(),
        Field(pattern=r"^[^\s:]{1,253}:\d{1,5}$"),
        AfterValidator(check_port),
    ] = None
    """A server on another machine, `host:port`; `host` may be the name of a machine of `roboneuron
    link`. If unset: a server on this machine, which is started if necessary.
    """
    model: Annotated[Name | None, ConfigurationOnly()] = None
    """Name of the model on that server; optional if it has only one."""
    space: Annotated[SpaceOptions | None, ConfigurationOnly()] = None
    """Control space of a model with an address, unless it moves the TCP by deltas. The model's
    answers are checked against it.
    """
    token_file: Annotated[Path | None, ConfigurationOnly()] = None
    """File with the token that identifies this robot to that server, instead of the keys of
    `roboneuron link`.
    """
    ca: Annotated[Path | None, ConfigurationOnly()] = None
    """With a token: the server's certificate, or that of its issuer (PEM). Without it the server
    must be on loopback.
    """
    coding: Literal["auto", "raw", "png", "jpeg"] = "auto"
    """Coding of images sent to an address. `auto`: raw if the link transfers it within `link_share`
    of a period, otherwise PNG, otherwise JPEG. On this machine images are always raw.
    """
    link_share: Annotated[float, Field(gt=0, le=1)] = 0.3
    """Fraction of a period, see `coding`."""
    quality: Annotated[int, Field(ge=1, le=100)] = 90
    """Quality of JPEG."""
    image_size: Annotated[tuple[int, int] | None, ConfigurationOnly(), Field(strict=False)] = None
    """Shrink images to this width and height [px] before sending, if the model itself declares no
    size.
    """
    parity_m: Annotated[float, ConfigurationOnly(), Field(ge=0)] = 0.002
    """Largest accepted change of actions by JPEG, `image_size` or `crop`, measured before the first
    action. Above it, JPEG is not chosen, and fixed settings are refused [m, m/s].
    """
    parity_rad: Annotated[float, ConfigurationOnly(), Field(ge=0)] = 0.01
    """Likewise [rad, rad/s]."""
    timeout_s: Annotated[float, Field(gt=0, le=60, allow_inf_nan=False)] = 1.5
    """Deadline of each observation; later answers are useless."""
    start_timeout_s: Annotated[float, Field(gt=0, le=3600, allow_inf_nan=False)] = 900.0
    """Longest wait for a server that is loading."""
    idle_s: Annotated[float, Field(ge=0, le=86400, allow_inf_nan=False)] = 60.0
    """Time without any robot after which a server ends."""
    directory: Annotated[Path | None, ConfigurationOnly()] = None
    """Folder of the servers' sockets and logs; by default in the user's run-time directory."""

    @model_validator(mode="after")
    def _check_place(self) -> Self:
        if self.backend is None and self.address is None:
            raise ValueError("name the backend that holds the model, or the address of a server")
        if self.address is None and (self.model or self.space or self.token_file or self.ca):
            raise ValueError("model, space, token_file and ca belong to a server with an address")
        if self.ca is not None and self.token_file is None:
            raise ValueError("ca belongs to a token_file; with a link the keys are known")
        return self

    def identity(self) -> str:
        """16 hexadecimal digits, equal for robots that share a model."""
        of_the_server = {*ModelOptions.model_fields, "backend", "idle_s"}
        own = self.model_dump(mode="json", include=of_the_server)
        return hashlib.sha256(json.dumps([_WIRE, own], sort_keys=True).encode()).hexdigest()[:16]


class ReplicaOptions(BaseModel):
    """`[models.<name>.ray]`: the replicas of a model with `--engine ray`."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    least: Annotated[int, Field(ge=1, le=256)] = 1
    """Smallest number of replicas."""
    most: Annotated[int, Field(ge=1, le=256)] = 1
    """Largest number of replicas: more are started while each has more than one batch of
    observations, waiting ones included.
    """
    cpus: Annotated[float, Field(ge=0, le=1024)] = 1.0
    """CPUs that Ray reserves for a replica."""
    gpus: Annotated[float, Field(ge=0, le=64)] = 0.0
    """GPUs that Ray reserves for a replica; it sees no others."""

    @model_validator(mode="after")
    def _check_range(self) -> Self:
        if self.least > self.most:
            raise ValueError(f"least = {self.least} replicas is more than most = {self.most}")
        return self


class RayOptions(BaseModel):
    """`[ray]` of a server's file."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    address: str | None = None
    """The Ray cluster: `host:port`, or `auto` for the one of this machine. If unset: one that runs
    on this machine as long as the server.
    """


class ServedModelOptions(ModelOptions):
    """`[models.<name>]` of a server's file."""

    backend: Name
    """The backend that holds the model, for instance `oft`."""
    ray: ReplicaOptions = ReplicaOptions()
    """Its replicas; read with `--engine ray` only."""

    def shared(self) -> SharedOptions:
        """The options of the model's process."""
        own = self.model_dump(include=set(ModelOptions.model_fields), exclude_unset=True)
        return SharedOptions.model_validate({**own, "backend": self.backend})


class ListenOptions(BaseModel):
    """`[listen]` of a server's file: the address for robots of other machines, and their
    authentication.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    host: str = "127.0.0.1"
    """Address to listen on."""
    port: Annotated[int, Field(ge=0, le=65535)] = 7420
    """TCP port; 0 for a free one."""
    keys: Literal["link", "token", "none"] = "link"
    """`link`: both sides use the keys of `roboneuron link` (mutual TLS 1.3). `token`: robots send a
    token. `none`: anybody who reaches the address.
    """
    insecure: bool = False
    """Listen beyond loopback without token and certificate; logged."""
    token_file: Path | None = None
    """With `token`: its file, readable only by this user; created if missing."""
    certificate: Path | None = None
    """Without `link`: the server's certificate chain (PEM), required unless it listens on
    loopback.
    """
    key: Path | None = None
    """Its key (PEM); read from `certificate` if unset."""
    metrics_port: Annotated[int | None, Field(ge=0, le=65535)] = None
    """Port of Prometheus metrics, usually 9465; 0 for a free one. If unset: no metrics are
    served.
    """
    metrics_host: str = "127.0.0.1"
    """Address of the metrics. Anyone who can reach it can read them, without a key."""
    robots: Annotated[int, Field(ge=1, le=100)] = 64
    """Largest number of connected robots."""
    drain_s: Annotated[float, Field(ge=0, le=3600, allow_inf_nan=False)] = 0.0
    """Time after SIGTERM for which connected robots are still answered [s]; others are refused, and
    `/healthz` says 503.
    """
    directory: Path | None = None
    """Folder of sockets and logs; by default in the user's run-time directory."""

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


class PolicyServerOptions(BaseModel):
    """The file of `roboneuron serve-policy`."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    listen: ListenOptions = ListenOptions()
    """Address for robots."""
    ray: RayOptions = RayOptions()
    """The Ray cluster; read with `--engine ray` only."""
    models: Annotated[dict[Name, ServedModelOptions], Field(min_length=1, max_length=32)]
    """The served models by name."""

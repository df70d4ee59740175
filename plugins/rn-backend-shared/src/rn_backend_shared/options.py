"""Options of the backend `shared`, and which server they mean."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from rn_backend_shared.frames import VERSION
from rn_backend_shared.images import MOST_SIDE_PX
from roboneuron import ConfigurationOnly

Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]*$", max_length=64)]
Role = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$", max_length=64)]
_Pixel = Annotated[int, Field(ge=0, le=MOST_SIDE_PX)]
_Side = Annotated[int, Field(ge=1, le=MOST_SIDE_PX)]
Rectangle = Annotated[tuple[_Pixel, _Pixel, _Side, _Side], Field(strict=False)]
GpuName = Annotated[str, Field(pattern=r"^[A-Za-z0-9,:_/-]+$", max_length=256)]
Table = Annotated[dict[str, object], ConfigurationOnly()]


class ModelOptions(BaseModel):
    """Which model is held, and how its server answers."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    checkpoint: Annotated[str | None, ConfigurationOnly()] = None
    """Directory of its files, where it needs one."""
    options: Table = {}
    """Its own options, as they would stand under `[plugins.<backend>]`."""
    runtime: Annotated[Name | None, ConfigurationOnly()] = None
    """The runtime that executes it; the backend's default when left out."""
    runtime_options: Table = {}
    """Options of the runtime."""
    acceleration: Annotated[Name | None, ConfigurationOnly()] = None
    """A preset, where the runtime takes one."""
    acceleration_options: Table = {}
    """Options of the acceleration."""
    stateless: Annotated[bool, ConfigurationOnly()] = False
    """Share a backend that cannot answer several observations at once: it is asked one by one. Only
    for a backend that remembers nothing from one observation to the next, because it would mix the
    robots up.
    """
    crop: Annotated[dict[Role, Rectangle], ConfigurationOnly(), Field(max_length=16)] = {}
    """What the checkpoint takes of an image, by role of the camera: left, top, width and height
    [px]. A server crops what comes whole, and tells robots of other machines, which send no more
    than that. A robot's own, with an address, is checked as `image_size`.
    """
    most: Annotated[int, Field(ge=1, le=256)] = 8
    """Most observations in one batch."""
    waiting: Annotated[int, Field(ge=1, le=4096)] = 64
    """Most observations that wait; more are refused at once."""
    linger_s: Annotated[float, Field(ge=0, le=0.1, allow_inf_nan=False)] = 0.003
    """How long an idle server waits for other robots before it answers the first one alone."""
    python: Annotated[Path | None, ConfigurationOnly()] = None
    """Interpreter of the servers; this one's by default."""
    environment: Annotated[dict[str, str], ConfigurationOnly()] = {}
    """Further environment variables of the servers."""


class SpaceOptions(BaseModel):
    """The control space of a model on another machine."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    kind: str
    """One of the contract's kinds, such as `joint_position`."""
    rate_hz: Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)] = 0.0
    """Rows per second that the policy was trained for; 0 when any rate will do."""
    channels: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """Names of its values in its own order, as the robot calls them: joints, `gripper_open`,
    `left/x`. Left out: the robot's own order.
    """


class SharedOptions(ModelOptions):
    """Which model is shared, and how it is asked. Robots with the same model options use the same
    server.
    """

    backend: Annotated[Name | None, ConfigurationOnly()] = None
    """The backend that holds the model, for instance `oft`; with `address` the server knows it."""
    address: Annotated[
        str | None, ConfigurationOnly(), Field(pattern=r"^[^\s:]{1,253}:\d{1,5}$")
    ] = None
    """A server on another machine, `host:port`; `host` may be the name of a machine of `roboneuron
    link`. Left out: a server of this machine, started when there is none.
    """
    model: Annotated[Name | None, ConfigurationOnly()] = None
    """Name of the model on that server; may be left out when it has one."""
    space: Annotated[SpaceOptions | None, ConfigurationOnly()] = None
    """Control space of a model with an address, when it does not move the TCP by deltas. What it
    answers is held against it.
    """
    token_file: Annotated[Path | None, ConfigurationOnly()] = None
    """Introduce this robot to that server by the token in this file, instead of the keys of
    `roboneuron link`.
    """
    ca: Annotated[Path | None, ConfigurationOnly()] = None
    """With a token: certificate that the server's is, or is issued by (PEM). Without it the server
    has to be reached by loopback.
    """
    coding: Literal["auto", "raw", "png", "jpeg"] = "auto"
    """How images are sent to an address. `auto`: raw where the link carries it within `link_share`
    of a period, else PNG, else JPEG. On this machine they are always raw.
    """
    link_share: Annotated[float, Field(gt=0, le=1)] = 0.3
    """See `coding`."""
    quality: Annotated[int, Field(ge=1, le=100)] = 90
    """Of JPEG."""
    image_size: Annotated[tuple[int, int] | None, ConfigurationOnly(), Field(strict=False)] = None
    """Shrink images to this width and height before they are sent [px], where the model itself
    declares no size.
    """
    parity_m: Annotated[float, ConfigurationOnly(), Field(ge=0)] = 0.002
    """Before the first action it is measured how far JPEG, `image_size` or `crop` move actions.
    Where it is more, JPEG is not chosen, and what is fixed is refused [m, m/s].
    """
    parity_rad: Annotated[float, ConfigurationOnly(), Field(ge=0)] = 0.01
    """Likewise [rad, rad/s]."""
    replicas: Annotated[int, Field(ge=1, le=8)] = 1
    """Servers, each with a copy of the model; when one dies, its robots go on with another within
    the same chunk.
    """
    timeout_s: Annotated[float, Field(gt=0, le=60, allow_inf_nan=False)] = 1.5
    """An answer that takes longer is of no use: the deadline of each observation."""
    start_timeout_s: Annotated[float, Field(gt=0, le=3600, allow_inf_nan=False)] = 900.0
    """Longest wait for a server that loads."""
    idle_s: Annotated[float, Field(ge=0, le=86400, allow_inf_nan=False)] = 60.0
    """A server without any robot ends after this long."""
    directory: Annotated[Path | None, ConfigurationOnly()] = None
    """Where sockets and logs of the servers are; by default in the user's run-time directory."""

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
        """16 hexadecimal digits: the same for robots that share a model."""
        of_the_server = {*ModelOptions.model_fields, "backend", "replicas", "idle_s"}
        own = self.model_dump(mode="json", include=of_the_server)
        return hashlib.sha256(json.dumps([VERSION, own], sort_keys=True).encode()).hexdigest()[:16]


class ServedModelOptions(ModelOptions):
    """`[models.<name>]` of a server's file."""

    backend: Name
    """The backend that holds the model, for instance `oft`."""
    replicas: Annotated[int, Field(ge=1, le=16)] = 1
    """Processes that hold it. A robot stays at one of them, the one with the fewest robots, and
    goes on with another when that dies.
    """
    gpus: Annotated[tuple[GpuName, ...], Field(strict=False, max_length=16)] = ()
    """What each replica sees as `CUDA_VISIBLE_DEVICES`, replica after replica: `["0", "1"]`. Left
    out: all see all.
    """

    @model_validator(mode="after")
    def _check_gpus(self) -> Self:
        if self.gpus and len(self.gpus) != self.replicas:
            raise ValueError(
                f"gpus names {len(self.gpus)} for {self.replicas} replicas; name one for each"
            )
        return self

    def of_replica(self, number: int) -> ServedModelOptions:
        """As replica `number` takes them."""
        if not self.gpus:
            return self
        environment = {**self.environment, "CUDA_VISIBLE_DEVICES": self.gpus[number]}
        return self.model_copy(update={"environment": environment})

    def shared(self) -> SharedOptions:
        """As its process takes them."""
        own = self.model_dump(include=set(ModelOptions.model_fields))
        return SharedOptions.model_validate({**own, "backend": self.backend})


class ListenOptions(BaseModel):
    """`[listen]` of a server's file: where robots of other machines connect, and how they prove
    who they are.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    host: str = "127.0.0.1"
    """Address to listen on."""
    port: Annotated[int, Field(ge=0, le=65535)] = 7420
    """TCP port; 0 for a free one."""
    keys: Literal["link", "token"] = "link"
    """`link`: both sides show the keys of `roboneuron link` (mutual TLS 1.3). `token`: robots show
    a token.
    """
    token_file: Path | None = None
    """With `token`: the file that holds it, readable for this user alone; made when it is not
    there.
    """
    certificate: Path | None = None
    """With `token`: the server's certificate chain (PEM), a must where it is not loopback."""
    key: Path | None = None
    """Its key (PEM)."""
    metrics_port: Annotated[int | None, Field(ge=0, le=65535)] = None
    """Serve numbers for Prometheus at this port, 9465 as a rule; 0 for a free one. Left out: none
    are served.
    """
    metrics_host: str = "127.0.0.1"
    """Address of that. Whoever reaches it reads the numbers, without a key."""
    robots: Annotated[int, Field(ge=1, le=100)] = 64
    """Most robots that are connected. Beyond it the newest of the client with most of them gives
    way to a client with fewer.
    """
    directory: Path | None = None
    """Where sockets and logs are; by default in the user's run-time directory."""

    @model_validator(mode="after")
    def _check_keys(self) -> Self:
        if self.keys == "token" and self.token_file is None:
            raise ValueError("keys = 'token' needs a token_file")
        if self.keys == "link" and (self.token_file or self.certificate or self.key):
            raise ValueError("token_file, certificate and key belong to keys = 'token'")
        if (self.certificate is None) != (self.key is None):
            raise ValueError("certificate and key come together")
        return self


class PolicyServerOptions(BaseModel):
    """The file of `roboneuron serve-policy`."""

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    listen: ListenOptions = ListenOptions()
    """Where robots connect."""
    models: Annotated[dict[Name, ServedModelOptions], Field(min_length=1, max_length=32)]
    """What is served, by the name that robots ask for."""

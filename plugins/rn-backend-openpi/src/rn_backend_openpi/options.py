"""Options of a policy that is served elsewhere, under `[plugins.openpi]` or `[plugins.shared]`."""

from __future__ import annotations

import hashlib
import json
import logging
from pathlib import Path
from typing import Annotated, Literal, Self
from urllib.parse import urlsplit

from pydantic import AfterValidator, AliasChoices, Field, model_validator

from rn_backend_openpi.interface_options import InterfaceOptions, Key
from rn_vla.normalisation import ScalingKind
from rn_vla.tcp_profiles import OptionSection
from roboneuron import AgentMaySet, ConfigurationOnly

log = logging.getLogger(__name__)
_PATHS = {"sglang": "/openpi/policy", "vllm-omni": "/v1/realtime/robot/openpi"}
"""Paths of the engines' websockets."""
_WIRE = "websocket 1"
"""Part of the name of a local server, so that no release finds the server of another one."""
Identifier = Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]*$", max_length=64)]
Table = Annotated[dict[str, object], ConfigurationOnly()]


class NormalisationOptions(OptionSection):
    """Statistics of the served checkpoint's training data."""

    file: Annotated[Path, ConfigurationOnly()] = Field(description="openpi's norm_stats.json")
    kind: ScalingKind = Field(description="'quantiles' for pi0.5, 'mean_std' for pi0")


class ModelOptions(OptionSection):
    """A model, and its server."""

    backend: Annotated[Identifier | None, ConfigurationOnly()] = Field(
        default=None, description="the backend that holds the model, for instance `oft`"
    )
    checkpoint: Annotated[str | None, ConfigurationOnly()] = Field(
        default=None, description="directory of its files, if it needs one"
    )
    options: Table = Field(default={}, description="its options, as under `[plugins.<backend>]`")
    runtime: Annotated[Identifier | None, ConfigurationOnly()] = Field(
        default=None, description="the runtime that executes it; the backend's default if unset"
    )
    runtime_options: Table = Field(default={}, description="options of the runtime")
    acceleration: Annotated[Identifier | None, ConfigurationOnly()] = Field(
        default=None, description="a preset, if the runtime supports one"
    )
    acceleration_options: Table = Field(default={}, description="options of the acceleration")
    stateless: Annotated[bool, ConfigurationOnly()] = Field(
        default=False,
        description="share a backend that cannot answer several observations at once: they are "
        "answered one by one. Only for a backend that keeps no state from one observation to the "
        "next, otherwise it would mix the robots up.",
    )
    most: int = Field(
        default=8, ge=1, le=256, description="largest number of observations in one batch"
    )
    waiting: int = Field(
        default=64,
        ge=1,
        le=4096,
        description="largest number of queued observations; further ones are refused at once",
    )
    linger_s: float = Field(
        default=0.003,
        ge=0,
        le=0.1,
        description="wait of an idle server for other robots before it answers the first alone [s]",
    )
    interface: Annotated[InterfaceOptions | None, ConfigurationOnly()] = Field(
        default=None,
        description="for clients of openpi's kind: what their requests hold and what the answers "
        "mean. If unset: the state by name, and rows as the backend writes them.",
    )
    python: Annotated[Path | None, ConfigurationOnly()] = Field(
        default=None, description="interpreter of the server; by default that of this process"
    )
    environment: Annotated[dict[str, str], ConfigurationOnly()] = Field(
        default={}, description="further environment variables of the server"
    )

    def of_the_model(self) -> ModelOptions:
        """These options without those of a robot or of a server's file."""
        own = self.model_dump(include=set(ModelOptions.model_fields), exclude_unset=True)
        return ModelOptions.model_validate(own)


def check_port(address: str | None) -> str | None:
    """Return an address. Raises ValueError: its port is beyond 65535."""
    if address is not None and int(address.rpartition(":")[2]) > 65535:
        raise ValueError(f"{address!r} names no port: write host:port, port from 1 to 65535")
    return address


class PolicyOptions(InterfaceOptions, ModelOptions):
    """Options of the backends `openpi` and `shared`: where the policy is served (`url`, `address`,
    or by a `backend` on this machine), and what is exchanged with its server.
    """

    url: Annotated[str | None, ConfigurationOnly()] = Field(
        default=None,
        pattern=r"^wss?://\S+$",
        description="address of a policy server, with its path if it has one",
    )
    address: Annotated[
        str | None,
        ConfigurationOnly(),
        Field(pattern=r"^(\[[0-9A-Fa-f:.]+(%\w+)?\]|[^\s:\[\]]{1,253}):\d{1,5}$"),
        AfterValidator(check_port),
    ] = Field(
        default=None,
        description="a server of `roboneuron policy serve`, `host:port` or `[IPv6]:port`; `host` "
        "may be the name of a machine of `roboneuron link`, whose keys are used without token_file",
    )
    model: Annotated[Identifier | None, ConfigurationOnly()] = Field(
        default=None, description="name of the model at that address; optional if there is only one"
    )
    token_file: Annotated[Path | None, ConfigurationOnly()] = Field(
        default=None,
        validation_alias=AliasChoices("token_file", "api_key_file"),
        description="file with the token or API key that the server expects",
    )
    api_key_variable: Annotated[str | None, ConfigurationOnly()] = Field(
        default=None, description="name of the environment variable with the API key"
    )
    allow_insecure_key: Annotated[bool, ConfigurationOnly()] = Field(
        default=False, description="send the key over an unencrypted remote connection"
    )
    ca_file: Annotated[Path | None, ConfigurationOnly()] = Field(
        default=None,
        validation_alias=AliasChoices("ca_file", "ca"),
        description="PEM of the authority that signed the server's certificate, or the certificate;"
        " the system's authorities if unset",
    )
    engine: Literal["sglang", "vllm-omni"] | None = Field(
        default=None,
        description="the engine that serves a LeRobot checkpoint: its path, its names, rows padded "
        "to the network's width",
    )
    normalisation: NormalisationOptions | Literal["server"] | None = Field(
        default=None,
        description="of an engine: the statistics by which the client converts states and rows; "
        "'server' if the engine does",
    )
    action_keys: Annotated[tuple[Key, ...], Field(min_length=1, max_length=16), AgentMaySet()] = (
        Field(default=("actions",), description="arrays of the answer, concatenated in this order")
    )
    action_steps: int | None = Field(
        default=None, ge=1, description="actions of a chunk to execute before the next one"
    )
    coding: Literal["auto", "raw", "png", "jpeg"] = Field(
        default="auto",
        description="coding of images sent to another machine without a profile. `auto`: raw if the"
        " link transfers it within `link_share` of a period, otherwise PNG, otherwise JPEG",
    )
    link_share: float = Field(
        default=0.3, gt=0, le=1, description="fraction of a period, see `coding`"
    )
    quality: int = Field(default=90, ge=1, le=100, description="quality of JPEG")
    parity_m: Annotated[float, ConfigurationOnly()] = Field(
        default=0.002,
        ge=0,
        description="largest accepted change of actions by JPEG, measured before the first action; "
        "above it JPEG is not chosen, or refused if configured [m, m/s]",
    )
    parity_rad: Annotated[float, ConfigurationOnly()] = Field(
        default=0.01, ge=0, description="likewise [rad, rad/s]"
    )
    timeout_s: float = Field(
        default=1.5,
        gt=0,
        le=60,
        validation_alias=AliasChoices("timeout_s", "request_timeout_s"),
        description="deadline of each observation [s]",
    )
    start_timeout_s: float = Field(
        default=900.0,
        gt=0,
        le=3600,
        validation_alias=AliasChoices("start_timeout_s", "connect_timeout_s"),
        description="longest wait for a server that is loading; for one that does not answer 10 s "
        "at most [s]",
    )
    warm_up_timeout_s: float = Field(
        default=120.0,
        gt=0,
        le=600,
        description="limit of the first inference with a profile (compilation) [s]",
    )
    idle_s: Annotated[float, ConfigurationOnly()] = Field(
        default=60.0,
        ge=0,
        le=86400,
        description="time without any robot after which a server on this machine ends [s]",
    )
    directory: Annotated[Path | None, ConfigurationOnly()] = Field(
        default=None,
        description="folder of the servers' sockets and logs; by default in the user's run-time "
        "directory",
    )
    server: Table = Field(default={}, description="options of `roboneuron policy openpi`")

    def identity(self) -> str:
        """16 hexadecimal digits, equal for robots that share a model on this machine."""
        own = self.of_the_model().model_dump(mode="json")
        named = json.dumps([_WIRE, own, self.idle_s], sort_keys=True)
        return hashlib.sha256(named.encode()).hexdigest()[:16]

    @property
    def server_url(self) -> str:
        """The URL of a server elsewhere: with the path of the engine if it has none, or with the
        model at an address.
        """
        if self.address is not None:
            scheme = "ws" if self.ca_file is None else "wss"
            return f"{scheme}://{self.address}/{self.model or ''}"
        assert self.url is not None
        if self.engine is None or urlsplit(self.url).path.strip("/"):
            return self.url
        return self.url.rstrip("/") + _PATHS[self.engine]

    @property
    def is_local(self) -> bool:
        """True for a model on this machine, whose server is started if necessary."""
        return self.url is None and self.address is None

    @property
    def is_bare(self) -> bool:
        """True if the engine serves the network of a LeRobot checkpoint; DreamZero is no such."""
        return self.engine is not None and self.profile != "roboarena"

    @model_validator(mode="after")
    def _has_one_place(self) -> Self:
        if self.is_local and self.backend is None:
            raise ValueError(
                "name the url of a server, its address, or the backend that holds the model"
            )
        if self.url is not None and self.address is not None:
            raise ValueError("give url or address, not both")
        of_others = (self.model, self.space, self.token_file, self.ca_file, self.profile)
        if self.is_local and any(option is not None for option in of_others):
            raise ValueError(
                "model, space, token_file, ca_file and profile belong to a server elsewhere"
            )
        if self.model is not None and self.address is None:
            raise ValueError("model belongs to address; the path of a url names it")
        if self.token_file is not None and self.api_key_variable is not None:
            raise ValueError("give token_file or api_key_variable, not both")
        if self.address is not None and self.ca_file is not None and self.token_file is None:
            raise ValueError("ca_file belongs to a token_file; with a link the keys are known")
        return self

    @model_validator(mode="after")
    def _fits_the_engine(self) -> Self:
        if self.engine is not None and self.profile is None:
            raise ValueError("an engine serves none of RoboNeuron's rows; choose a profile")
        if self.is_bare and self.normalisation is None:
            raise ValueError(
                "an engine needs normalisation: a table with file and kind, or 'server'"
            )
        if not self.is_bare and self.normalisation is not None:
            raise ValueError("normalisation belongs to an engine")
        return self

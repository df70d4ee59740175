"""Options of the backend `shared`, and which server they mean."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from rn_backend_shared.frames import VERSION
from roboneuron import ConfigurationOnly

Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]*$", max_length=64)]
Table = Annotated[dict[str, object], ConfigurationOnly()]


class SharedOptions(BaseModel):
    """Which model is shared, and how it is asked. Robots with the same model options use the same
    server.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, use_attribute_docstrings=True)

    backend: Annotated[Name, ConfigurationOnly()]
    """The backend that holds the model, for instance `oft`."""
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
    most: Annotated[int, Field(ge=1, le=256)] = 8
    """Most observations in one batch."""
    waiting: Annotated[int, Field(ge=1, le=4096)] = 64
    """Most observations that wait; more are refused at once."""
    linger_s: Annotated[float, Field(ge=0, le=0.1, allow_inf_nan=False)] = 0.003
    """How long an idle server waits for other robots before it answers the first one alone."""
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
    python: Annotated[Path | None, ConfigurationOnly()] = None
    """Interpreter of the servers; this one's by default."""
    environment: Annotated[dict[str, str], ConfigurationOnly()] = {}
    """Further environment variables of the servers."""

    def identity(self) -> str:
        """16 hexadecimal digits: the same for robots that share a model."""
        own = self.model_dump(mode="json", exclude={"timeout_s", "start_timeout_s", "directory"})
        return hashlib.sha256(json.dumps([VERSION, own], sort_keys=True).encode()).hexdigest()[:16]

"""Who calls, what a role may call, and what a client may name when it starts a module."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from roboneuron.config import Config
from roboneuron.errors import CheckpointError, MissingDependencyError, RefusedError
from roboneuron.gate.roles import ADMIN, OPERATOR, VIEWER, has_role
from roboneuron.plugins.loading import load_options_model
from roboneuron.plugins.restricted import restricted_values
from roboneuron.plugins.specs import DriverSpec, Spec
from roboneuron.server.tool import CallContext, Tool

HOLDER_KEY = "roboneuron.holder"
"""Where a transport of a feature leaves the Holder in the scope of a request."""
CONNECTION_KEY = "roboneuron.connection"
"""Where it leaves the WatchedConnection of a request, if a call outlives the loss of its connection."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Holder:
    """A client as the transport knows it.

    Attributes:
        who: for the audit and the log.
        role: one of ROLES; anything else has no rights.
        client: which of several clients without a token; empty for others.
    """

    who: str
    role: str
    client: str = ""


LOCAL_AGENT = Holder(who="agent on stdio", role=ADMIN)
"""The client of a stdio server: whoever started the server, so it has every role."""
LOCAL_PROCESS = Holder(who="local HTTP client", role=ADMIN)
"""A client of a server on loopback that asks for no token: anybody on this machine, who could start one as well."""
NOBODY = Holder(who="unknown", role="")


def holder_of(request: Any) -> Holder:
    """Who sent a request; None is stdio. A request without a Holder has no rights."""
    if request is None:
        return LOCAL_AGENT
    holder = request.scope.get(HOLDER_KEY)
    return holder if isinstance(holder, Holder) else NOBODY


def is_local(who: str) -> bool:
    """Whether that client was let in without a token; no token can have such a name."""
    return who == LOCAL_AGENT.who or who.startswith(LOCAL_PROCESS.who)


class WatchedConnection(Protocol):
    """The connection that a request came on."""

    def watched(self, listener: Callable[[], object]) -> AbstractContextManager[None]:
        """Call `listener` when the connection is lost within the block, or was before."""
        ...


def watching(request: Any, listener: Callable[[], object] | None) -> AbstractContextManager[None]:
    """Call `listener` when the connection of a request is lost; stdio has none, its end cancels the call."""
    connection: WatchedConnection | None = request.scope.get(CONNECTION_KEY) if request is not None else None
    return nullcontext() if listener is None or connection is None else connection.watched(listener)


def least_role(tool: Tool[Any]) -> str:
    """The least role that may call a tool."""
    return tool.role or (VIEWER if tool.read_only else OPERATOR)


def may_call(role: str, tool: Tool[Any]) -> bool:
    """Whether a role may call a tool."""
    return has_role(role, least_role(tool))


def check_role(tool: Tool[Any], context: CallContext) -> None:
    """Refuse a tool that the caller may not call.

    Raises:
        RefusedError: names the roles.
    """
    if not may_call(context.role, tool):
        raise RefusedError(
            f"{tool.name} needs the role {least_role(tool)!r}; {context.who} has {context.role or 'none'!r}.",
            hint="Use a token with that role, or ask a person who has one.",
        )


_ABSENT = object()


def check_may_set(
    spec: Spec | DriverSpec,
    name: str,
    configured: Mapping[str, object],
    wanted: Mapping[str, object],
    listed: Collection[str],
    role: str,
) -> None:
    """Refuse a change of options that only the configuration may set; those that are listed are for admins.

    Whole tables are replaced by a client's, so a restricted option may be neither changed, added nor left out.

    Args:
        spec: whose options these are.
        name: of their section, `[plugins.<name>]`.
        configured, wanted: without and with what the client gave.
        listed: `agent_options` of `[server]`.
        role: of the client.

    Raises:
        RefusedError: names the options.
    """
    if spec.config is None:
        return  # there are no options; the one that was named is refused as unknown
    try:
        model = load_options_model(spec)
    except MissingDependencyError:  # a plugin for an interpreter of its own: nobody here knows what its options name
        model = None
    fixed, given = restricted_values(model, configured), restricted_values(model, wanted)
    changed = [key for key in {**fixed, **given} if fixed.get(key, _ABSENT) != given.get(key, _ABSENT)]
    if model is not None:  # an unknown option is refused as such, with the nearest known one
        known = {field.alias or option for option, field in model.model_fields.items()}
        changed = [key for key in changed if "." in key or key in known]
    keys = [f"{name}.{key}" for key in changed]
    barred = [key for key in keys if not any(key == entry or key.startswith(f"{entry}.") for entry in listed)]
    if f"{name}.checkpoint" in barred:
        raise RefusedError("A checkpoint is no option for clients.", hint="Name it in the argument `checkpoint`.")
    if barred:
        raise RefusedError(
            f"Only the configuration may set {_list(barred)}.",
            hint="A person can set it there, or list it in agent_options of [server] for admins.",
        )
    if keys and not has_role(role, ADMIN):
        raise RefusedError(
            f"Only a client with the role 'admin' may set {_list(keys)}.", hint="Ask a person who has it."
        )


def _list(keys: Collection[str]) -> str:
    return ", ".join(f"plugins.{key}" for key in keys)


def check_may_load(config: Config, checkpoint: str) -> None:
    """Refuse a client's path that lies neither below what the configuration names nor below a checkpoint root.

    Raises:
        RefusedError: it is neither; checked before whether it exists.
        CheckpointError: it is no path.
    """
    named = [config.inference.checkpoint if config.inference else None]
    named += [options.get("checkpoint") for options in config.plugins.values()]
    allowed = [path for path in (*named, *config.server.checkpoint_roots) if isinstance(path, str) and path]
    try:
        wanted = _resolve(checkpoint)
        if any(wanted.is_relative_to(_resolve(path)) for path in allowed):
            return
    except (OSError, RuntimeError, ValueError) as error:  # a loop of links, an unknown user, a NUL
        raise CheckpointError(f"The checkpoint {checkpoint!r} is no usable path: {error}.") from error
    raise RefusedError(
        f"The configuration does not allow the checkpoint {checkpoint!r}.",
        hint=f"Allowed is what lies in: {', '.join(allowed) or 'nothing yet'}. A person can add a folder of models to "
        "checkpoint_roots in [server].",
    )


def _resolve(path: str) -> Path:
    return Path(path).expanduser().resolve()

"""Descriptors of this package: the backend `openpi`, a client of policy servers, and the command
`openpi-server`.
"""

from __future__ import annotations

from collections.abc import Sequence

from roboneuron import PICK_AND_PLACE, ActionSpace, BackendSpec, CommandSpec, Requirement, hookimpl

_INSTALL = "pip install msgpack websockets"
_MODULES = tuple(Requirement(module=m, install=_INSTALL) for m in ("msgpack", "websockets"))
MOST_ROWS = 100
"""Largest number of rows in one answer."""
BACKEND = BackendSpec(
    name="openpi",
    summary="any policy served elsewhere over openpi's websocket, in every action space",
    target="rn_backend_openpi.backend:OpenpiBackend",
    config="rn_backend_openpi.options:OpenpiOptions",
    case="rn_backend_openpi.case:openpi_case",
    requires=_MODULES,
    cameras=("primary",),
    optional_cameras=("wrist", "right_wrist", "secondary"),
    needs_state=True,
    action_space=ActionSpace(horizon=MOST_ROWS, step_s=0.0),
    space="rn_backend_openpi.space:openpi_space",
    verbs=PICK_AND_PLACE,
)
"""Descriptor of the backend."""
COMMAND = CommandSpec(
    name="openpi-server",
    summary="serve the configured backend over openpi's websocket until Ctrl-C",
    target="rn_backend_openpi.command:OpenpiServerCommand",
    requires=_MODULES,
)
"""Descriptor of the command."""


@hookimpl
def roboneuron_backends() -> Sequence[BackendSpec]:
    """Register the backend."""
    return (BACKEND,)


@hookimpl
def roboneuron_commands() -> Sequence[CommandSpec]:
    """Register the command."""
    return (COMMAND,)

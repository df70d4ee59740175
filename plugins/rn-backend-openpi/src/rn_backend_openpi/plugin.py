"""Descriptors of this package: the backends `openpi` and `shared`, two names of the client of a
policy that is served elsewhere, and the commands that run servers.
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
    config="rn_backend_openpi.options:PolicyOptions",
    case="rn_backend_openpi.case:openpi_case",
    requires=_MODULES,
    cameras=("primary",),
    optional_cameras=("wrist", "right_wrist", "secondary"),
    needs_state=True,
    action_space=ActionSpace(horizon=MOST_ROWS, step_s=0.0),
    space="rn_backend_openpi.space:policy_space",
    verbs=PICK_AND_PLACE,
)
"""Descriptor of the backend that asks any server."""
SHARED = BackendSpec(
    name="shared",
    summary="One model for several robots: another backend in a server process, on this machine or "
    "another, that answers in batches.",
    target="rn_backend_openpi.backend:PolicyBackend",
    config="rn_backend_openpi.options:PolicyOptions",
    optional_cameras=("wrist", "left_wrist", "right_wrist", "side", "top", "front"),
    needs_state=True,
    action_space=ActionSpace(horizon=MOST_ROWS, step_s=0.0),
    conditions_on_rows=True,
    case="rn_backend_openpi.case:policy_case",
    space="rn_backend_openpi.space:policy_space",
    verbs=PICK_AND_PLACE,
)
"""Descriptor of the backend of RoboNeuron's own server. The model's own requirements are checked
when its server answers; a chunk that continues no rows is marked as such.
"""
COMMAND = CommandSpec(
    name="policy-openpi",
    group="policy",
    summary="`serve` for the backend of a robot's configuration; of earlier releases",
    target="rn_backend_openpi.serve_command:OpenpiServerCommand",
    old_names=("openpi-server",),
    requires=_MODULES,
)
MODEL_COMMAND = CommandSpec(
    name="policy-share",
    group="policy",
    summary="serve the model of [plugins.shared] until Ctrl-C",
    target="rn_backend_openpi.serve_command:SharedModelCommand",
    old_names=("shared-model",),
)
SERVE_COMMAND = CommandSpec(
    name="policy-serve",
    group="policy",
    summary="serve models to robots on other machines, each in a process of its own",
    target="rn_backend_openpi.serve_command:ServePolicyCommand",
    old_names=("serve-policy",),
)
"""Descriptors of the commands."""


@hookimpl
def roboneuron_backends() -> Sequence[BackendSpec]:
    """Register the backends."""
    return (BACKEND, SHARED)


@hookimpl
def roboneuron_commands() -> Sequence[CommandSpec]:
    """Register the commands."""
    return (COMMAND, MODEL_COMMAND, SERVE_COMMAND)

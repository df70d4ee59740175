"""Descriptors of this package: the backend `shared`, and the commands that run servers, for this
machine or for others.
"""

from __future__ import annotations

from collections.abc import Sequence

from roboneuron import PICK_AND_PLACE, ActionSpace, BackendSpec, CommandSpec, hookimpl

BACKEND = BackendSpec(
    name="shared",
    summary="One model for several robots: another backend in a server process, on this machine or "
    "another, that answers in batches.",
    target="rn_backend_shared.backend:SharedBackend",
    config="rn_backend_shared.options:SharedOptions",
    optional_cameras=("wrist", "left_wrist", "right_wrist", "side", "top", "front"),
    needs_state=True,
    action_space=ActionSpace(horizon=100, step_s=0.0),
    conditions_on_rows=True,
    case="rn_backend_shared.case:shared_case",
    space="rn_backend_shared.space:shared_space",
    verbs=PICK_AND_PLACE,
)
"""Descriptor of the backend. The model's own requirements are checked when its server answers; a
chunk that continues no rows is marked as such.
"""
COMMAND = CommandSpec(
    name="shared-model",
    summary="serve the model of [plugins.shared] until Ctrl-C",
    target="rn_backend_shared.command:SharedModelCommand",
)
SERVE_COMMAND = CommandSpec(
    name="serve-policy",
    summary="serve models to robots on other machines, each in a process of its own",
    target="rn_backend_shared.serve_command:ServePolicyCommand",
)
"""Descriptors of the commands."""


@hookimpl
def roboneuron_backends() -> Sequence[BackendSpec]:
    """Register the backend."""
    return (BACKEND,)


@hookimpl
def roboneuron_commands() -> Sequence[CommandSpec]:
    """Register the commands."""
    return (COMMAND, SERVE_COMMAND)

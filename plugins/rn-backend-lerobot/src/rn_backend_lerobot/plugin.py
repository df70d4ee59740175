"""Descriptors of this package: the backend "lerobot"."""

from __future__ import annotations

from collections.abc import Sequence

from roboneuron import PICK_AND_PLACE, ActionSpace, BackendSpec, Requirement, hookimpl

_INSTALL = 'pip install "lerobot>=0.6.1,<0.7" in an environment of Python 3.12 or newer'
BACKEND = BackendSpec(
    name="lerobot",
    summary="A LeRobot policy (ACT, Diffusion, SmolVLA, pi0.5 ...) from a checkpoint folder.",
    target="rn_backend_lerobot.backend:LeRobotBackend",
    config="rn_backend_lerobot.options:LeRobotOptions",
    case="rn_backend_lerobot.case:lerobot_case",
    requires=tuple(
        Requirement(module=module, install=_INSTALL)
        for module in ("lerobot", "torch", "safetensors")
    ),
    cameras=("primary",),
    optional_cameras=(
        "wrist",
        "left_wrist",
        "right_wrist",
        "side",
        "top",
        "front",
    ),
    needs_state=True,
    needs_checkpoint=True,
    action_space=ActionSpace(horizon=100, step_s=0.0),
    conditions_on_rows=True,
    space="rn_backend_lerobot.space:lerobot_space",
    verbs=PICK_AND_PLACE,
)
"""Descriptor. `space` checks which cameras a policy needs, from its checkpoint."""


@hookimpl
def roboneuron_backends() -> Sequence[BackendSpec]:
    """Register the backend "lerobot"."""
    return (BACKEND,)

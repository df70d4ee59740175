"""Descriptors of this package: the backends "pi0" and "pi0-fast"."""

from __future__ import annotations

from collections.abc import Sequence

from roboneuron import PICK_AND_PLACE, ActionSpace, BackendSpec, Requirement, hookimpl

_NATIVE = "pip install torch safetensors tokenizers"
_NATIVE_MODULES = tuple(
    Requirement(module=module, install=_NATIVE) for module in ("torch", "safetensors", "tokenizers")
)
_SPACE = ActionSpace(horizon=50, step_s=0.0)


@hookimpl
def roboneuron_backends() -> Sequence[BackendSpec]:
    """Register the backends "pi0" and "pi0-fast"."""
    return [
        BackendSpec(
            name="pi0",
            summary="pi0 or pi0.5 in this process, from a LeRobot or openpi PyTorch checkpoint",
            target="rn_backend_pi0.native:Pi0Backend",
            config="rn_backend_pi0.options:Pi0Options",
            case="rn_backend_pi0.case:native_case",
            requires=_NATIVE_MODULES,
            cameras=("primary",),
            optional_cameras=("wrist", "right_wrist"),
            needs_state=True,
            needs_checkpoint=True,
            action_space=_SPACE,
            conditions_on_rows=True,
            space="rn_backend_pi0.space:pi0_space",
            verbs=PICK_AND_PLACE,
        ),
        BackendSpec(
            name="pi0-fast",
            summary="pi0-FAST in this process, from a LeRobot checkpoint",
            target="rn_backend_pi0.fast:Pi0FastBackend",
            config="rn_backend_pi0.options:Pi0FastOptions",
            case="rn_backend_pi0.case:fast_case",
            requires=_NATIVE_MODULES,
            cameras=("primary",),
            optional_cameras=("wrist", "right_wrist"),
            needs_state=True,
            needs_checkpoint=True,
            action_space=_SPACE,
            space="rn_backend_pi0.space:pi0_space",
            verbs=PICK_AND_PLACE,
        ),
    ]

"""Descriptors of this package: the backends `openvla` and `openvla-tcp`."""

from __future__ import annotations

from collections.abc import Sequence

from roboneuron import PICK_AND_PLACE, ActionSpace, BackendSpec, Requirement, hookimpl

_REQUIRES = (
    Requirement(module="torch", install="pip install torch (which build: README.md, PyTorch)"),
    Requirement(module="tokenizers", install="pip install tokenizers"),
    Requirement(module="simplejpeg", install="pip install simplejpeg"),
    Requirement(module="PIL", install="pip install pillow"),
)


def _spec(name: str, summary: str, target: str, case: str, needs_state: bool) -> BackendSpec:
    return BackendSpec(
        name=name,
        summary=summary,
        target=f"rn_backend_openvla.backend:{target}",
        config="rn_backend_openvla.config:OpenVlaConfig",
        case=f"rn_backend_openvla.case:{case}",
        requires=_REQUIRES,
        cameras=("primary",),
        needs_state=needs_state,
        needs_checkpoint=True,
        action_space=ActionSpace(step_s=0.0),
        family="openvla",
        runtimes_required=True,
        default_runtime="torch",
        verbs=PICK_AND_PLACE,
    )


@hookimpl
def roboneuron_backends() -> Sequence[BackendSpec]:
    """Register the backends for OpenVLA checkpoints with base-frame and with tool-frame actions."""
    return (
        _spec(
            "openvla",
            "OpenVLA (7B and alike): one action per image from seven decoded tokens; base-frame "
            "checkpoints.",
            "OpenVlaBackend",
            "openvla_case",
            False,
        ),
        _spec(
            "openvla-tcp",
            "OpenVLA checkpoints trained on tool-frame actions; also reads the measured TCP pose.",
            "OpenVlaTcpBackend",
            "openvla_tcp_case",
            True,
        ),
    )

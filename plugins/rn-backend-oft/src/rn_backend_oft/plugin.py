"""Descriptors of this package: the backends `oft`, `oft-primary` and `oft-pair`."""

from __future__ import annotations

from collections.abc import Sequence

from roboneuron import PICK_AND_PLACE, ActionSpace, BackendSpec, Requirement, hookimpl

MAX_CHUNK = 25
"""Largest number of actions per inference."""


def _spec(name: str, summary: str, target: str, case: str, cameras: tuple[str, ...]) -> BackendSpec:
    return BackendSpec(
        name=name,
        summary=summary,
        target=f"rn_backend_oft.backend:{target}",
        config="rn_backend_oft.config:OftConfig",
        case=f"rn_backend_oft.case:{case}",
        requires=(
            Requirement(
                module="torch", install="pip install torch (which build: README.md, PyTorch)"
            ),
            Requirement(module="tokenizers", install="pip install tokenizers"),
            Requirement(module="simplejpeg", install="pip install simplejpeg"),
            Requirement(module="rn_vla", install="pip install ./plugins/rn-vla"),
        ),
        cameras=cameras,
        needs_state=True,
        needs_checkpoint=True,
        action_space=ActionSpace(horizon=MAX_CHUNK, step_s=0.0),
        space="rn_backend_oft.space:oft_space",
        family="openvla-oft",
        runtimes_required=True,
        default_runtime="torch",
        verbs=PICK_AND_PLACE,
    )


@hookimpl
def roboneuron_backends() -> Sequence[BackendSpec]:
    """Register the backends for OpenVLA-OFT checkpoints trained with one, two or three cameras."""
    return (
        _spec(
            "oft",
            "OpenVLA-OFT: a chunk of actions in one pass, from a primary and a wrist camera and "
            "the measured state.",
            "OftBackend",
            "oft_case",
            ("primary", "wrist"),
        ),
        _spec(
            "oft-primary",
            "OpenVLA-OFT checkpoints trained with the primary camera only.",
            "OftPrimaryBackend",
            "oft_primary_case",
            ("primary",),
        ),
        _spec(
            "oft-pair",
            "OpenVLA-OFT checkpoints of two arms: a primary camera and one at each wrist.",
            "OftPairBackend",
            "oft_pair_case",
            ("primary", "wrist", "right_wrist"),
        ),
    )

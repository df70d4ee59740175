"""Files next to the base checkpoint: action head and proprio projector, and unsupported ones."""

from __future__ import annotations

from pathlib import Path

from rn_vla.decoding import DecoderShape, Shard, Weight
from roboneuron import CheckpointError

_PREFIX = "module."
"""Prefix left in the files by distributed training."""
_BLOCKS = 2
_REFUSED = {
    "noisy_action_projector": "a diffusion head, which is not implemented; use the L1 checkpoint "
    "of the same suite",
    "vision_backbone": "FiLM conditioning of the vision towers, which is not implemented; use a "
    "checkpoint without it",
}


def find_component(checkpoint: Path, component: str) -> Path:
    """The file of `component`. Raises CheckpointError unless there is exactly one."""
    found = _files(checkpoint, component)
    if len(found) != 1:
        names = ", ".join(path.name for path in found) or "none"
        raise CheckpointError(
            f"{checkpoint} must hold exactly one file {component}--*checkpoint.pt, found: {names}.",
            hint="Download the component file of one training step, or set `head` and `proprio` "
            "as it was trained.",
        )
    return found[0]


def _files(checkpoint: Path, component: str) -> list[Path]:
    return sorted(
        path for path in checkpoint.glob(f"*{component}*.pt") if "checkpoint" in path.name
    )


def check_components(checkpoint: Path, *, head: bool, proprio: bool) -> None:
    """Raise CheckpointError if a component exists that would be left out or is not implemented."""
    for component, reason in _REFUSED.items():
        for path in _files(checkpoint, component):
            raise CheckpointError(f"{path.name} says that the checkpoint has {reason}.")
    wanted = {
        "action_head": (head, 'head = "l1"'),
        "proprio_projector": (proprio, "proprio = true"),
    }
    for component, (used, option) in wanted.items():
        found = _files(checkpoint, component)
        if found and not used:
            raise CheckpointError(
                f"{found[0].name} would be left out, but the model was trained with it.",
                hint=f"Set {option}.",
            )


def head_shard(path: Path, decoder: DecoderShape, action_width: int) -> Shard:
    """Shard of the L1 head: a residual MLP over the hidden rows of one action."""
    hidden, wide = decoder.hidden, action_width * decoder.hidden
    shapes: dict[str, tuple[int, ...]] = {
        "layer_norm1.weight": (wide,),
        "layer_norm1.bias": (wide,),
        "fc1.weight": (hidden, wide),
        "fc1.bias": (hidden,),
        "layer_norm2.weight": (hidden,),
        "layer_norm2.bias": (hidden,),
        "fc2.weight": (action_width, hidden),
        "fc2.bias": (action_width,),
    }
    for block in range(_BLOCKS):
        base = f"mlp_resnet_blocks.{block}.ffn."
        shapes |= {f"{base}0.weight": (hidden,), f"{base}0.bias": (hidden,)}
        shapes |= {f"{base}1.weight": (hidden, hidden), f"{base}1.bias": (hidden,)}
    return Shard(
        path=path,
        weights={
            f"{_PREFIX}model.{name}": Weight(shape=shape, target=f"back.{name}")
            for name, shape in shapes.items()
        },
    )


def proprio_shard(path: Path, decoder: DecoderShape, width: int) -> Shard:
    """Shard of the proprio projector: two linear layers."""
    hidden = decoder.hidden
    shapes: dict[str, tuple[int, ...]] = {
        "fc1.weight": (hidden, width),
        "fc1.bias": (hidden,),
        "fc2.weight": (hidden, hidden),
        "fc2.bias": (hidden,),
    }
    return Shard(
        path=path,
        weights={
            f"{_PREFIX}{name}": Weight(shape=shape, target=f"front.proprio_projector.{name}")
            for name, shape in shapes.items()
        },
    )

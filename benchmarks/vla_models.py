"""The models of bench_vla.py: shapes of OpenVLA and OFT with random weights, and a request."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
from torch import Tensor

from rn_backend_oft.constants import CONSTANTS
from rn_backend_oft.policy import OftPolicy
from rn_vla.decoding import DecoderShape, PolicyModel, Request
from rn_vla.openvla.checkpoint import BACKBONES, OpenvlaCheckpoint
from rn_vla.openvla.layout import TowerShape, VisionShape
from rn_vla.openvla.policy import policy_model
from rn_vla.openvla.preprocessing import TowerPixels

PROMPT_TOKENS = 24
FULL = DecoderShape(
    hidden=4096,
    intermediate=11008,
    layers=32,
    heads=32,
    key_value_heads=32,
    vocabulary=32064,
    norm_epsilon=1e-6,
    rope_theta=10000.0,
    max_positions=2048,
)
SMALL = replace(FULL, hidden=384, intermediate=1032, layers=8, heads=6, key_value_heads=6)


def shrink(tower: TowerShape) -> TowerShape:
    """A tower with an eighth of the width and a quarter of the depth."""
    return replace(
        tower,
        width=tower.width // 8,
        depth=tower.depth // 4,
        heads=4,
        intermediate=tower.intermediate // 8,
    )


def make_checkpoint(size: str, path: Path) -> OpenvlaCheckpoint:
    """A checkpoint with shapes only; the weights are made on the device."""
    towers = BACKBONES["dinosiglip-vit-so-224px"]
    decoder = FULL if size == "full" else SMALL
    return OpenvlaCheckpoint(
        path=path,
        decoder=decoder,
        vision=VisionShape(
            towers=towers if size == "full" else tuple(map(shrink, towers)), hidden=decoder.hidden
        ),
        action_bins=256,
        token_vocabulary=32000,
        is_vicuna=False,
        towers=(TowerPixels(mean=(0.5,) * 3, std=(0.5,) * 3),) * 2,
        statistics={},
        statistics_source="",
        shards=(),
    )


@contextmanager
def random_weights(seed: int = 0) -> Iterator[None]:
    """Let engines built inside fill their parameters at random instead of reading files."""

    def fill(shards: object, slots: dict[str, Tensor]) -> None:
        for index, slot in enumerate(slots.values()):
            torch.manual_seed(seed + index)
            slot.normal_(std=slot.shape[-1] ** -0.5) if slot.ndim > 1 else slot.fill_(1.0)

    with (
        patch("rn_runtime_torch.engine.load_shards", fill),
        patch("rn_runtime_torch.engine.check_shards"),
    ):
        yield


def policies(size: str, path: Path) -> Iterator[tuple[str, OpenvlaCheckpoint, PolicyModel]]:
    """The models to measure."""
    checkpoint = make_checkpoint(size, path)
    for component in ("action_head", "proprio_projector"):
        (path / f"{component}--0_checkpoint.pt").touch()
    yield "openvla", checkpoint, policy_model(checkpoint, action_width=7, max_prompt_tokens=64)
    oft = OftPolicy(
        checkpoint=checkpoint, constants=CONSTANTS["libero"], cameras=2, head="l1", proprio_width=8
    )
    yield "oft", checkpoint, oft.model(64)


def make_request(model: PolicyModel) -> Request:
    """A request with random pixels."""
    request = model.example(PROMPT_TOKENS)
    generator = np.random.default_rng(0)
    arrays = {
        name: generator.standard_normal(array.shape).astype(np.float32)
        for name, array in request.prompt.arrays.items()
    }
    return replace(request, prompt=replace(request.prompt, arrays=arrays))

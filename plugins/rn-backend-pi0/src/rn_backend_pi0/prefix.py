"""Common first part of all models: images and text as one sequence for the language model.

Missing cameras and prompt padding occupy no positions, so leaving them out equals masking them.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from rn_backend_pi0.architecture import Pi0Dims
from rn_backend_pi0.layers import Gemma, Rotary, VisionTower


class PrefixNetwork(nn.Module):
    """Vision tower, projector, token embedding and language model. Parameters are named as in
    `architecture.module_keys`.
    """

    def __init__(self, dims: Pi0Dims, *, keys_only_last: bool) -> None:
        super().__init__()
        self.dims = dims
        self.vision = VisionTower(dims.vision)
        self.projector = nn.Linear(dims.vision.width, dims.prefix.width)
        # Without given values nn.Embedding draws them, and on the meta device PyTorch imports 800
        # modules (1.7 s) to do so.
        values = torch.empty(dims.vocabulary, dims.prefix.width)
        self.embedding = nn.Embedding(dims.vocabulary, dims.prefix.width, _weight=values)
        self.prefix = Gemma(dims.prefix, keys_only_last=keys_only_last)

    def embed_prefix(self, pixels: Tensor, token_ids: Tensor) -> Tensor:
        """Embed images and prompt as (images x tokens + prompt, width): images unchanged, the
        prompt scaled by sqrt(width).
        """
        images = self.projector(self.vision(pixels)).flatten(0, 1)
        return torch.cat([images, self.embed_text(token_ids)])

    def embed_text(self, token_ids: Tensor) -> Tensor:
        """Embed token ids (n,) as (n, width), scaled by sqrt(width)."""
        out: Tensor = self.embedding(token_ids) * math.sqrt(self.dims.prefix.width)
        return out

    def rotary_of(self, length: int, device: torch.device, dtype: torch.dtype) -> Rotary:
        """The rotary embedding of `length` tokens."""
        head_dim = self.dims.prefix.head_dim
        exponents = torch.arange(0, head_dim, 2, device=device, dtype=torch.float32) / head_dim
        angles = torch.arange(length, device=device, dtype=torch.float32)[:, None] / (
            self.dims.prefix.rope_base**exponents
        )
        return angles.cos().to(dtype), angles.sin().to(dtype)

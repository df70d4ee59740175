"""Parts that OpenVLA-OFT adds to OpenVLA's network: proprio projector, placeholder rows, L1
head.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional

from rn_vla.openvla.front import OpenVlaFront, Projector
from rn_vla.openvla.layout import VisionShape


class OftFront(OpenVlaFront):
    """Input sequence: first prompt token, patches of all cameras, proprioception, the rest of the
    prompt, empty rows, stop token.
    """

    def __init__(self, shape: VisionShape, *, placeholders: int, proprio_width: int) -> None:
        """`proprio_width` is 0 for checkpoints without proprioception."""
        super().__init__(shape)
        self.placeholders = placeholders
        self.proprio_projector = (
            Projector((proprio_width, shape.hidden, shape.hidden)) if proprio_width else None
        )

    def forward(
        self, arrays: dict[str, Tensor], ids: Tensor, embed: Callable[[Tensor], Tensor]
    ) -> Tensor:
        """Build the input rows from arrays {"pixel_values", "proprio"?} and ids (b, n) with
        placeholders; returns (b, patches + 0 or 1 + n, hidden).
        """
        words = embed(ids)
        end = words.shape[1] - 1
        start = end - self.placeholders
        parts = [words[:, :1], self.patches(arrays["pixel_values"])]
        if self.proprio_projector is not None:
            parts.append(self.proprio_projector(arrays["proprio"])[:, None])
        parts += [words[:, 1:start], torch.zeros_like(words[:, start:end]), words[:, end:]]
        return torch.cat(parts, dim=1)


class _ResidualBlock(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.ffn = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.ReLU())

    def forward(self, x: Tensor) -> Tensor:
        result: Tensor = x + self.ffn(x)
        return result


class L1Head(nn.Module):
    """Maps rows (b, chunk * width, hidden) to normalised actions (b, chunk, width)."""

    def __init__(self, *, hidden: int, chunk: int, action_width: int) -> None:
        super().__init__()
        self.chunk = chunk
        self.layer_norm1 = nn.LayerNorm(action_width * hidden)
        self.fc1 = nn.Linear(action_width * hidden, hidden)
        self.mlp_resnet_blocks = nn.ModuleList(_ResidualBlock(hidden) for _ in range(2))
        self.layer_norm2 = nn.LayerNorm(hidden)
        self.fc2 = nn.Linear(hidden, action_width)

    def forward(self, rows: Tensor) -> Tensor:
        """See the class."""
        x = functional.relu(self.fc1(self.layer_norm1(rows.reshape(rows.shape[0], self.chunk, -1))))
        for block in self.mlp_resnet_blocks:
            x = block(x)
        actions: Tensor = self.fc2(self.layer_norm2(x))
        return actions

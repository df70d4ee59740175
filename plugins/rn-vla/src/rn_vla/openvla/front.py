"""The part before the decoder: converts pixels and ids to the sequence of embeddings."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from rn_vla.openvla.layout import TOWER_NAMES, VisionShape
from rn_vla.openvla.vision import Tower, gelu_in_place


class Projector(nn.Module):
    """Projects features (..., features) to the language model's width, with exact GELU between
    layers.
    """

    def __init__(self, widths: tuple[int, ...]) -> None:
        super().__init__()
        self.names = tuple(f"fc{index}" for index in range(1, len(widths)))
        for name, before, after in zip(self.names, widths, widths[1:], strict=False):
            self.add_module(name, nn.Linear(before, after))

    def forward(self, x: Tensor) -> Tensor:
        """See the class."""
        for name in self.names[:-1]:
            x = gelu_in_place(self.get_submodule(name)(x))
        result: Tensor = self.get_submodule(self.names[-1])(x)
        return result


class OpenVlaFront(nn.Module):
    """Front of OpenVLA: first prompt token, image patches, the rest of the prompt."""

    def __init__(self, shape: VisionShape) -> None:
        super().__init__()
        self.towers = TOWER_NAMES[: len(shape.towers)]
        for name, tower in zip(self.towers, shape.towers, strict=True):
            self.add_module(name, Tower(tower))
        self.projector = Projector(shape.projector)

    def patches(self, pixels: Tensor) -> Tensor:
        """Embed pixels (b, cameras * 3 * towers, side, side) as patches (b, cameras * patches,
        hidden).
        """
        side = pixels.shape[-1]
        images = pixels.view(-1, 3 * len(self.towers), side, side)
        parts = torch.split(images, 3, dim=1)
        features = [
            self.get_submodule(name)(part) for name, part in zip(self.towers, parts, strict=True)
        ]
        embedded: Tensor = self.projector(torch.cat(features, dim=-1))
        return embedded.view(pixels.shape[0], -1, embedded.shape[-1])

    def forward(
        self, arrays: dict[str, Tensor], ids: Tensor, embed: Callable[[Tensor], Tensor]
    ) -> Tensor:
        """Embed arrays {"pixel_values"} and ids (b, n) as (b, patches + n, hidden)."""
        words = embed(ids)
        return torch.cat((words[:, :1], self.patches(arrays["pixel_values"]), words[:, 1:]), dim=1)

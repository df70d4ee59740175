"""The static key-value cache: allocated once, filled per layer; layers may hold different lengths
after pruning.
"""

from __future__ import annotations

import torch
from torch import Tensor

from rn_vla.decoding import DecoderShape


class KeyValueCache:
    """Keys and values of one sequence; the tensors never move, because CUDA graphs refer to
    them.
    """

    def __init__(
        self, shape: DecoderShape, length: int, device: torch.device, dtype: torch.dtype
    ) -> None:
        size = (shape.layers, 1, shape.key_value_heads, length, shape.head_width)
        self._keys = torch.zeros(size, device=device, dtype=dtype)
        self._values = torch.zeros(size, device=device, dtype=dtype)
        self._used = [0] * shape.layers

    def start(self, layer: int, key: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
        """Replace the contents of `layer` by (1, key-value heads, n, head width); return views of
        the cache.
        """
        count = key.shape[2]
        self._keys[layer, :, :, :count] = key
        self._values[layer, :, :, :count] = value
        self._used[layer] = count
        return self._keys[layer, :, :, :count], self._values[layer, :, :, :count]

    def append(self, layer: int, key: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
        """Add one position; return all keys and values of `layer` (1, key-value heads, n + 1, head
        width).
        """
        end = self._used[layer]
        self._keys[layer, :, :, end : end + 1] = key
        self._values[layer, :, :, end : end + 1] = value
        self._used[layer] = end + 1
        return self._keys[layer, :, :, : end + 1], self._values[layer, :, :, : end + 1]

    def tensors(self) -> tuple[Tensor, Tensor]:
        """All keys and all values, as allocated."""
        return self._keys, self._values

    def used(self, layer: int) -> int:
        """Positions held by `layer`."""
        return self._used[layer]

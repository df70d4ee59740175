"""Int8 weights with one scale per output, for products with a single row: decoding reads half the
bytes of bfloat16.
"""

from __future__ import annotations

import torch
from torch import Tensor

from roboneuron import ConfigurationError

_ROWS = 1024
"""Number of rows quantised at a time, which bounds the float32 copy."""


class Int8Weight:
    """A matrix (outputs, inputs), symmetric, rounded to the nearest of 255 steps per output."""

    def __init__(self, weight: Tensor) -> None:
        self.values = torch.empty(weight.shape, dtype=torch.int8, device=weight.device)
        scales = torch.empty(weight.shape[0], dtype=torch.float32, device=weight.device)
        for start in range(0, weight.shape[0], _ROWS):
            part = weight[start : start + _ROWS].float()
            scale = (part.abs().amax(dim=1) / 127.0).clamp_min(torch.finfo(torch.float32).tiny)
            self.values[start : start + _ROWS] = (part / scale[:, None]).round().to(torch.int8)
            scales[start : start + _ROWS] = scale
        # torch's CPU kernel is fast only for bfloat16 rows: in float32 it is slower than a float32
        # product.
        self.scales = scales.to(torch.bfloat16)

    def times(self, row: Tensor) -> Tensor:
        """Multiply row (1, inputs); returns (1, outputs) in the row's type, computed in bfloat16
        with float32 sums.
        """
        product = torch._weight_int8pack_mm(
            row.to(torch.bfloat16).contiguous(), self.values, self.scales
        )
        return product.to(row.dtype)


def check_int8(device: torch.device) -> None:
    """Raise ConfigurationError if `device` has no kernel for int8 weights."""
    if device.type != "cpu" or not hasattr(torch, "_weight_int8pack_mm"):
        raise ConfigurationError(
            f'decode_weights = "int8" has no kernel on {device} with torch {torch.__version__}.',
            hint='Set decode_weights = "same", or device = "cpu" with torch 2.3 or newer.',
        )

"""Reason why FastV is refused: SGLang's attention after rows of a prompt were dropped, compared
with attention over the kept ones.

    SGLANG_ENVIRONMENT/bin/python pruning.py

Calls the CPU attention of SGLang 0.5.23 itself, with rows, slots and lengths like those of a model.
"""

from __future__ import annotations

import os

os.environ["SGLANG_USE_CPU_ENGINE"] = "1"

import torch
from sglang.srt.layers.attention.torch_native_backend import TorchNativeAttnBackend
from torch import Tensor
from torch.nn.functional import scaled_dot_product_attention

HEADS, WIDTH, ROWS = 2, 8, 20
KEPT = torch.tensor([row for row in range(ROWS) if not (1 <= row <= 16 and row % 2 == 0)])


def expected(query: Tensor, key: Tensor, value: Tensor, causal: bool) -> Tensor:
    """Plain attention (rows, heads, width)."""
    moved = (tensor.movedim(0, 1)[None] for tensor in (query, key, value))
    return scaled_dot_product_attention(*moved, is_causal=causal)[0].movedim(0, 1)


def main() -> None:
    """Print the result of each of four cases."""
    torch.manual_seed(0)
    backend = object.__new__(TorchNativeAttnBackend)
    key, value, query = (torch.randn(ROWS, HEADS, WIDTH) for _ in range(3))
    # the pool: rows of other requests
    keys, values = torch.randn(64, HEADS, WIDTH), torch.randn(64, HEADS, WIDTH)
    slots, request = torch.arange(30, 30 + ROWS), torch.tensor([0])
    # a layer after the pruning writes the kept rows
    keys[slots[KEPT]], values[slots[KEPT]] = key[KEPT], value[KEPT]
    table = torch.zeros(1, 64, dtype=torch.int64)
    table[0, :ROWS] = slots
    wanted = expected(query[KEPT], key[KEPT], value[KEPT], causal=True)

    def prefill(length: int, of: Tensor) -> Tensor:
        out = torch.empty(len(KEPT), HEADS, WIDTH)
        size = torch.tensor([length])
        arguments = (query[KEPT], out, keys, values, of, request, size, torch.tensor([0]), size)
        backend._run_sdpa_forward_extend(*arguments, causal=True)
        return out

    try:
        prefill(ROWS, table)
    except RuntimeError as error:
        print(f"prefill, lengths of the whole prompt: {str(error).partition('.')[0]}")
    cut = (prefill(len(KEPT), table) - wanted).abs().max()
    print(
        f"prefill, lengths cut to the kept rows: off by {cut:.3f} (values reach "
        f"{wanted.abs().max():.3f})"
    )
    own = table.clone()
    own[0, : len(KEPT)] = slots[KEPT]
    exact = (prefill(len(KEPT), own) - wanted).abs().max()
    print(f"prefill, and a slot table of its own for the layers behind the cut: off by {exact:.3f}")
    step, out = torch.randn(1, HEADS, WIDTH), torch.empty(1, HEADS, WIDTH)
    backend._run_sdpa_forward_decode(
        step, out, keys, values, table, request, torch.tensor([ROWS]), causal=False
    )
    late = (out - expected(step, key[KEPT], value[KEPT], causal=False)).abs().max()
    print(f"the next token, with the one table a request has: off by {late:.3f}")


if __name__ == "__main__":
    main()

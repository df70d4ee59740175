"""Memory for the large intermediates of a pass, reused by later passes."""

from __future__ import annotations

import math

from torch import Tensor


class Scratch:
    """Named buffers that grow to the largest requested size.

    On the CPU a new temporary costs a page fault for each 4 kB. On CUDA the allocator reuses memory
    anyway, and a recorded graph must not refer to a buffer that grows later, so nothing is kept.
    """

    def __init__(self, keep: bool = False) -> None:
        """`keep` False creates a new tensor every time."""
        self._keep = keep
        self._held: dict[str, Tensor] = {}

    def empty(self, name: str, like: Tensor, *shape: int) -> Tensor:
        """An uninitialised contiguous tensor with the type and device of `like`, valid until `name`
        is requested again.
        """
        if not self._keep:
            return like.new_empty(shape)
        size = math.prod(shape)
        held = self._held.get(name)
        if (
            held is None
            or held.numel() < size
            or held.dtype != like.dtype
            or held.device != like.device
        ):
            held = self._held[name] = like.new_empty(size)
        return held[:size].view(shape)

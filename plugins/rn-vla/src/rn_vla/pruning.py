"""The hook for presets that drop visual tokens between two decoder layers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from torch import Tensor  # heavy


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class AttentionView:
    """Input of a selection: queries and keys of the layer just run, with rotary positions applied.

    With several sequences in one pass, each one is passed separately.

    Attributes:
        query: (1, heads, positions, head width).
        key: (1, key-value heads, positions, head width).
        visual_start, visual_count: the span of positions that hold image patches.
        rows: positions that a `RowsRequest` reads; None for token decoding.
        causal: True if a position attends only to earlier ones.
    """

    query: Tensor
    key: Tensor
    visual_start: int
    visual_count: int
    rows: tuple[int, int] | None
    causal: bool


class TokenSelection(Protocol):
    """Selects the positions to keep. The shapes of its results must depend only on shapes (CUDA
    graphs).

    Hashable; equal selections choose the same positions, so that they share recordings.
    """

    @property
    def layer(self) -> int:
        """Index of the first layer that runs only on the selected positions, at least 1."""
        ...

    def select(self, view: AttentionView) -> Tensor | None:
        """Return the positions to keep, int64, ascending; None keeps all. Only visual positions may
        be dropped.
        """
        ...


class PrunableDecoder(Protocol):
    """Interface that an acceleration gets from a runtime with the capability
    "visual-token-pruning".
    """

    def install_selection(self, selection: TokenSelection) -> None:
        """Use `selection` in every later pass. Raises ConfigurationError if the decoder has no such
        layer.
        """
        ...

"""The hook for presets that drop visual tokens between two decoder layers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from torch import Tensor  # heavy


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class AttentionView:
    """What a selection may look at: queries and keys of the layer just run, rotary positions
    applied.

    Of several sequences in one pass, each is shown alone.

    Attributes:
        query: (1, heads, positions, head width).
        key: (1, key-value heads, positions, head width).
        visual_start, visual_count: the span of positions that hold image patches.
        rows: positions that a `RowsRequest` reads; None for token decoding.
        causal: whether a position sees only earlier ones.
    """

    query: Tensor
    key: Tensor
    visual_start: int
    visual_count: int
    rows: tuple[int, int] | None
    causal: bool


class TokenSelection(Protocol):
    """Chooses which positions go on. Shapes of what it returns must follow from shapes alone (CUDA
    graphs).

    Hashable; equal ones choose alike, so that recordings of one serve the other.
    """

    @property
    def layer(self) -> int:
        """Index of the first layer that runs on the selected positions only, at least 1."""
        ...

    def select(self, view: AttentionView) -> Tensor | None:
        """Return the positions to keep, int64, ascending; None keeps all. Only visual ones may be
        dropped.
        """
        ...


class PrunableDecoder(Protocol):
    """What an acceleration gets from a runtime with the capability "visual-token-pruning"."""

    def install_selection(self, selection: TokenSelection) -> None:
        """Use `selection` in every later pass. Raises ConfigurationError when its layer is not one
        of the decoder's.
        """
        ...

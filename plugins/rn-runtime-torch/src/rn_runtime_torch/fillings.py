"""Padding of several sequences in one pass: no other position attends to it, and it shifts no
positions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rn_vla.pruning import AttentionView, TokenSelection
from roboneuron import PluginError

State = tuple[Tensor, Tensor, Tensor, Tensor | None]
"""State between two layers: hidden (b, n, hidden), rotary tables (n, width) or (b, 1, n, width),
seen (b, 1, 1, n).
"""


def fill_up(prompts: Sequence[NDArray[np.int64]]) -> tuple[NDArray[np.int64], tuple[int, ...]]:
    """Pad prompts after their first id; returns ids (b, longest) and the number of padding ids of
    each.
    """
    longest = max(ids.size for ids in prompts)
    counts = tuple(longest - ids.size for ids in prompts)
    filled = [
        np.insert(ids, [1] * count, ids[0]) for ids, count in zip(prompts, counts, strict=True)
    ]
    return np.stack(filled), counts


@dataclass(frozen=True, slots=True)
class Fillings:
    """Padding positions: after the image, so that the image, the words and the read rows are
    aligned in all sequences.

    Attributes:
        start: first padding position.
        counts: number of padding positions of each sequence.
    """

    start: int
    counts: tuple[int, ...]

    def tables(self, cos: Tensor, sin: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor | None]:
        """Rotary tables of sequences with `count` positions, and a mask of the visible ones; None
        if all are visible.
        """
        if not any(self.counts):
            return cos[:count], sin[:count], None
        at = torch.arange(count, device=cos.device)
        added = torch.tensor(self.counts, device=cos.device)[:, None]
        is_filling = (at >= self.start) & (at < self.start + added)
        own = torch.where(at < self.start, at, (at - added).clamp(min=0))
        return cos[own][:, None], sin[own][:, None], ~is_filling[:, None, None]

    def prune(self, selection: TokenSelection, view: AttentionView, state: State) -> State:
        """Apply the selection to each sequence as if it were alone, and keep the selected positions
        and the padding.

        Raises:
            PluginError: it drops more positions from one sequence than from another.
        """
        hidden, cos, sin, seen = state
        kept = [self._kept(selection, view, row) for row in range(len(self.counts))]
        if len({positions.numel() for positions in kept}) > 1:
            raise PluginError(
                f"{type(selection).__name__} keeps "
                f"{sorted(positions.numel() for positions in kept)} positions of "
                "sequences with equally many visual tokens; such prompts cannot be answered in "
                "one pass."
            )
        index = torch.stack(kept)
        rows = torch.arange(index.shape[0], device=index.device)[:, None]
        turned = [
            table[index] if table.dim() == 2 else table[rows, 0, index] for table in (cos, sin)
        ]
        if seen is not None:
            seen = seen[rows, 0, 0, index][:, None, None]
        return hidden[rows, index], turned[0][:, None], turned[1][:, None], seen

    def _kept(self, selection: TokenSelection, view: AttentionView, row: int) -> Tensor:
        """Positions (n',) of one sequence to keep, including its padding."""
        count, fill = view.key.shape[2], self.counts[row]
        real = torch.arange(count - fill, device=view.key.device)
        real = real + fill * (real >= self.start)
        query, key = view.query[row : row + 1], view.key[row : row + 1]
        if fill:
            query, key = query[:, :, real], key[:, :, real]
        rows = None if view.rows is None else (view.rows[0] - fill, view.rows[1] - fill)
        kept = selection.select(replace(view, query=query, key=key, rows=rows))
        if kept is None:
            kept = torch.arange(count - fill, device=view.key.device)
        # only visual positions are dropped, which come before
        before = self.start - (count - fill - kept.numel())
        filling = torch.arange(self.start, self.start + fill, device=kept.device)
        return torch.cat((kept[:before], filling, kept[before:] + fill))

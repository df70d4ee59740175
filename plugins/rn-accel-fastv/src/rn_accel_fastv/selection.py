"""Selection of the visual tokens that are kept. Source: Chen et al. 2024 (FastV), its public code
for the selecting row.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from rn_vla.pruning import AttentionView
from roboneuron import ConfigurationError


@dataclass(frozen=True, slots=True)
class AttendedTokens:
    """Keeps the visual tokens with the highest attention from one row, averaged over heads, and all
    other tokens.

    Kept positions stay in order and keep their rotary positions. Only the selecting rows are
    computed, with a softmax in float32, so that attention itself can stay fused.

    Attributes:
        layer: see `TokenSelection`.
        share: fraction of the visual tokens to be dropped.
        query: the selecting rows.
    """

    layer: int
    share: float
    query: Literal["last", "actions"]

    def kept(self, visual_count: int) -> int:
        """Number of kept tokens among `visual_count` visual ones."""
        return round(visual_count * (1.0 - self.share))

    def select(self, view: AttentionView) -> Tensor | None:
        """See `TokenSelection`."""
        kept = self.kept(view.visual_count)
        if kept == view.visual_count:
            return None
        attention = self._attention(view)
        start, end = view.visual_start, view.visual_start + view.visual_count
        best = attention[start:end].topk(kept).indices.sort().values + start
        count, device = view.key.shape[2], view.key.device
        return torch.cat(
            (torch.arange(start, device=device), best, torch.arange(end, count, device=device))
        )

    def _attention(self, view: AttentionView) -> Tensor:
        """Mean attention (positions,) of the selecting rows; the last row attends to all positions,
        causal or not.
        """
        count = view.query.shape[2]
        if self.query == "last":
            first, end = count - 1, count
        elif view.rows is not None and not view.causal:
            first, end = view.rows
        else:
            raise ConfigurationError(
                'FastV with query = "actions" needs a model that reads action rows in one pass '
                "(OpenVLA-OFT).",
                hint='Set query = "last".',
            )
        query = view.query[0, :, first:end].float()
        heads, groups = query.shape[0], view.key.shape[1]
        key = view.key[0].float().repeat_interleave(heads // groups, dim=0)
        scores = query @ key.transpose(1, 2) * query.shape[-1] ** -0.5
        attention: Tensor = scores.softmax(dim=-1).mean(dim=(0, 1))
        return attention

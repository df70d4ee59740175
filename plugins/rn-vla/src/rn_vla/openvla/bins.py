"""Action tokens: 256 bins over [-1, 1] at the end of the vocabulary."""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import NDArray

from roboneuron import UngroundedError

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
log = logging.getLogger(__name__)


class ActionBins:
    """Conversion of tokens to values and back. Source: OpenVLA (Kim et al. 2024), action
    tokenizer.
    """

    def __init__(self, bins: int, vocabulary: int) -> None:
        """`vocabulary` is the number of ids before padding: the last one encodes the lowest bin."""
        self._edges = np.linspace(-1.0, 1.0, bins)
        self._centers = (self._edges[:-1] + self._edges[1:]) / 2.0
        self._vocabulary = vocabulary

    def to_values(self, tokens: I64) -> F64:
        """Bin centres (n,) in (-1, 1) of ids (n,); ids outside the action range saturate, as in the
        original.
        """
        index = np.clip(self._vocabulary - tokens - 1, 0, len(self._centers) - 1)
        return self._centers[index]

    def count_outside(self, tokens: I64) -> int:
        """Number of ids that are not action tokens; `to_values` would saturate them to full-scale
        moves.
        """
        index = self._vocabulary - tokens - 1
        return int(((index < 0) | (index > len(self._centers))).sum())

    def to_tokens(self, values: F64) -> I64:
        """Encode values (n,), clipped to [-1, 1], as ids (n,), as in the training data."""
        ids: I64 = self._vocabulary - np.digitize(np.clip(values, -1.0, 1.0), self._edges)
        return ids


class OutsideCounter:
    """Counts tokens that are not action tokens; refuses an answer with too many of them.

    Such a token means that the model did not predict an action. The original implementation
    saturates it to the end of the range.
    """

    def __init__(self, bins: ActionBins, max_share: float) -> None:
        self._bins = bins
        self._max_share = max_share
        self.total = 0

    def check(self, tokens: I64) -> tuple[dict[str, float], str]:
        """Metrics and a note (empty without problems) for the chunk decoded from `tokens` (n,).

        Raises:
            UngroundedError: more than `max_share` of the tokens are outside; they are not decoded
                to actions.
        """
        outside = self._bins.count_outside(tokens)
        self.total += outside
        metrics = {
            "tokens_outside_actions": float(outside),
            "tokens_outside_actions_total": float(self.total),
        }
        if not outside:
            return metrics, ""
        note = f"{outside} of {tokens.size} tokens are not action tokens"
        if outside > self._max_share * tokens.size:
            raise UngroundedError(
                f"The model's answer was refused: {note}, {self.total} since it was loaded.",
                hint="Check checkpoint, prompt and camera image; `max_outside_share` sets the "
                "accepted share.",
            )
        log.warning(
            "%s and count as full-scale moves; %d since the model was loaded", note, self.total
        )
        return metrics, f"{note} and count as full-scale moves"

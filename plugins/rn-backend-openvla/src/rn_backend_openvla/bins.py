"""Action tokens: 256 bins over [-1, 1] at the end of the vocabulary."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


class ActionBins:
    """Tokens to values and back. Source: OpenVLA (Kim et al. 2024), action tokenizer."""

    def __init__(self, bins: int, vocabulary: int) -> None:
        """`vocabulary` counts the ids before padding: the last one stands for the lowest bin."""
        self._edges = np.linspace(-1.0, 1.0, bins)
        self._centers = (self._edges[:-1] + self._edges[1:]) / 2.0
        self._vocabulary = vocabulary

    def to_values(self, tokens: I64) -> F64:
        """Ids (n,) -> bin centres (n,) in (-1, 1); ids outside the action range saturate, as in the original."""
        index = np.clip(self._vocabulary - tokens - 1, 0, len(self._centers) - 1)
        return self._centers[index]

    def to_tokens(self, values: F64) -> I64:
        """Values (n,), clipped to [-1, 1], -> ids (n,): how the training data were encoded."""
        ids: I64 = self._vocabulary - np.digitize(np.clip(values, -1.0, 1.0), self._edges)
        return ids

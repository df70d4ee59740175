"""Statistics of a checkpoint's training data, and the z-scores computed with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ZScore:
    """Mean and standard deviation of one vector, and the small numbers that a code family adds to
    the latter.

    Attributes:
        mean, std: float32 (n,).
        forward_eps: added to `std` when normalising.
        backward_eps: added to `std` when un-normalising.
    """

    mean: F32
    std: F32
    forward_eps: float
    backward_eps: float

    @classmethod
    def of(
        cls, mean: Sequence[float], std: Sequence[float], *, forward_eps: float, backward_eps: float
    ) -> ZScore:
        """Build from what a file holds, two checked sequences of one length."""
        numbers = (np.asarray(values, dtype=np.float32) for values in (mean, std))
        return cls(
            mean=next(numbers),
            std=next(numbers),
            forward_eps=forward_eps,
            backward_eps=backward_eps,
        )

    @property
    def width(self) -> int:
        """Number of values."""
        return len(self.mean)

    def normalize(self, values: F32) -> F32:
        """float32 (n,) in the data's units -> float32 (n,), z-scores."""
        out: F32 = (values - self.mean) / (self.std + np.float32(self.forward_eps))
        return out

    def denormalize(self, values: F32) -> F32:
        """float32 (H, n), z-scores -> float32 (H, n) in the data's units."""
        out: F32 = values * (self.std + np.float32(self.backward_eps)) + self.mean
        return out

    def head(self, width: int) -> ZScore:
        """The first `width` values (statistics padded to the model's width hold more)."""
        return replace(self, mean=self.mean[:width], std=self.std[:width])

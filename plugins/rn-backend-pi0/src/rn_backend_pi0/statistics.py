"""Statistics of a checkpoint's training data, and the z-scores computed with them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from roboneuron.errors import CheckpointError

F32 = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ZScore:
    """Mean and standard deviation of one vector, and the small numbers that a code family adds to the latter.

    Attributes:
        mean, std: float32 (n,).
        forward_eps: added to `std` when normalising.
        backward_eps: added to `std` when un-normalising.
    """

    mean: F32
    std: F32
    forward_eps: float
    backward_eps: float

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


def check_statistics(
    mean: object, std: object, *, what: str, source: str, forward_eps: float, backward_eps: float
) -> ZScore:
    """Build a ZScore from what a file holds.

    Args:
        mean, std: sequences or arrays of numbers.
        what: "state" or "actions", for messages.
        source: file name, for messages.
        forward_eps, backward_eps: see ZScore.

    Raises:
        CheckpointError: not two equally long vectors of finite numbers with std >= 0.
    """
    try:
        m, s = np.asarray(mean, dtype=np.float32), np.asarray(std, dtype=np.float32)
    except (TypeError, ValueError) as error:
        raise CheckpointError(f"{source}: mean or std of {what} is not a list of numbers: {error}.") from error
    if m.ndim != 1 or m.shape != s.shape or m.size == 0:
        raise CheckpointError(f"{source}: mean and std of {what} have shapes {m.shape} and {s.shape}, expected equal.")
    if not (np.isfinite(m).all() and np.isfinite(s).all() and (s >= 0).all()):
        raise CheckpointError(f"{source}: mean or std of {what} is not finite, or std is negative.")
    return ZScore(mean=m, std=s, forward_eps=forward_eps, backward_eps=backward_eps)

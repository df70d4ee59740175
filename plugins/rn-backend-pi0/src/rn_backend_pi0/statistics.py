"""Statistics of a checkpoint's training data, and normalisation with them: by z-scores, or by the
range between two quantiles.

Everything is computed in the number type of the given values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, TypeAlias

import numpy as np
from numpy.typing import NDArray

Real: TypeAlias = np.dtype[np.floating]
Values: TypeAlias = NDArray[np.floating]
F64 = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ZScore:
    """Mean and standard deviation of one vector, and the eps that a code family adds to the latter.

    Attributes:
        mean, std: float64 (n,).
        forward_eps: added to `std` when normalising.
        backward_eps: added to `std` when un-normalising.
        measure, spread: names of normalised values and of `std` in messages.
    """

    mean: F64
    std: F64
    forward_eps: float
    backward_eps: float
    measure: ClassVar[str] = "standard deviations"
    spread: ClassVar[str] = "standard deviation"

    @classmethod
    def of(
        cls, mean: Sequence[float], std: Sequence[float], *, forward_eps: float, backward_eps: float
    ) -> ZScore:
        """Create from two checked sequences of equal length."""
        numbers = (np.asarray(values, dtype=np.float64) for values in (mean, std))
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

    @property
    def centre(self) -> F64:
        """Un-normalised value of 0, float64 (n,)."""
        return self.mean

    @property
    def is_flat(self) -> NDArray[np.bool_]:
        """bool (n,), True for values that never varied in the training data."""
        return np.equal(self.std, 0.0)

    def unit(self, dtype: Real) -> Values:
        """Change of the un-normalised value per normalised unit, (n,)."""
        return self.std.astype(dtype) + dtype.type(self.backward_eps)

    def normalize(self, values: Values) -> Values:
        """Convert (..., n) in the data's units to z-scores of the same shape and number type."""
        kind = values.dtype
        out: Values = (values - self.mean.astype(kind)) / (
            self.std.astype(kind) + kind.type(self.forward_eps)
        )
        return out

    def denormalize(self, values: Values) -> Values:
        """Convert z-scores (H, n) to the data's units, same shape and number type."""
        kind = values.dtype
        out: Values = values * self.unit(kind) + self.mean.astype(kind)
        return out

    def head(self, width: int) -> ZScore:
        """The first `width` values; statistics padded to the model's width hold more."""
        return replace(self, mean=self.mean[:width], std=self.std[:width])


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Quantiles:
    """The 1st and 99th percentile of one vector, which map to -1 and 1; nothing is clipped.

    Attributes:
        low, high: float64 (n,).
        eps: added to the range, both ways.
        measure, spread: names of normalised values and of the range in messages.
    """

    low: F64
    high: F64
    eps: float
    measure: ClassVar[str] = "half ranges"
    spread: ClassVar[str] = "range"

    @classmethod
    def of(cls, low: Sequence[float], high: Sequence[float], *, eps: float) -> Quantiles:
        """Create from two checked sequences of equal length."""
        return cls(
            low=np.asarray(low, dtype=np.float64), high=np.asarray(high, dtype=np.float64), eps=eps
        )

    @property
    def width(self) -> int:
        """Number of values."""
        return len(self.low)

    @property
    def centre(self) -> F64:
        """Un-normalised value of 0, float64 (n,)."""
        return (self.low + self.high) / 2.0

    @property
    def is_flat(self) -> NDArray[np.bool_]:
        """bool (n,), True for values that never varied in the training data."""
        return np.equal(self.high, self.low)

    def unit(self, dtype: Real) -> Values:
        """Change of the un-normalised value per normalised unit, (n,)."""
        return self._range(dtype) / dtype.type(2.0)

    def normalize(self, values: Values) -> Values:
        """Convert (..., n) in the data's units to about -1..1, same shape and number type."""
        kind = values.dtype
        out: Values = (values - self.low.astype(kind)) / self._range(kind) * kind.type(
            2.0
        ) - kind.type(1.0)
        return out

    def denormalize(self, values: Values) -> Values:
        """Convert (H, n), about -1..1, to the data's units, same shape and number type."""
        kind = values.dtype
        share = (values + kind.type(1.0)) / kind.type(2.0)
        out: Values = share * self._range(kind) + self.low.astype(kind)
        return out

    def head(self, width: int) -> Quantiles:
        """The first `width` values; statistics padded to the model's width hold more."""
        return replace(self, low=self.low[:width], high=self.high[:width])

    def _range(self, dtype: Real) -> Values:
        return self.high.astype(dtype) - self.low.astype(dtype) + dtype.type(self.eps)


Scaling: TypeAlias = ZScore | Quantiles

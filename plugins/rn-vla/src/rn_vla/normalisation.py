"""Statistics of a checkpoint's training data, and normalisation with them: by z-scores, or by the
range between two quantiles. openpi's file of them, norm_stats.json.

Everything is computed in the number type of the given values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from rn_vla.checkpoint_files import read_schema

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
ScalingKind = Literal["mean_std", "quantiles"]
"""How a model normalises: pi0 by mean and standard deviation, pi0.5 and pi0-FAST by quantiles."""
_OPENPI_EPS = 1e-6
Vector = Annotated[
    tuple[Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)], ...],
    Field(min_length=1, max_length=256),
]


class _NormStatsPart(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class Moments(_NormStatsPart):
    """Mean and standard deviation of one vector."""

    mean: Vector
    std: Vector

    @model_validator(mode="after")
    def _widths_agree(self) -> Self:
        if len(self.mean) != len(self.std):
            raise ValueError(f"mean has {len(self.mean)} values, std {len(self.std)}")
        if min(self.std) < 0:
            raise ValueError(f"std holds the negative value {min(self.std)}")
        return self


class Range(_NormStatsPart):
    """1st and 99th percentile of one vector."""

    q01: Vector
    q99: Vector

    @model_validator(mode="after")
    def _is_ordered(self) -> Self:
        if len(self.q01) != len(self.q99):
            raise ValueError(f"q01 has {len(self.q01)} values, q99 {len(self.q99)}")
        if any(low > high for low, high in zip(self.q01, self.q99, strict=True)):
            raise ValueError("a value of q01 is above that of q99")
        return self


class NormStats(_NormStatsPart):
    """The object in norm_stats.json, for pi0."""

    state: Moments
    actions: Moments


class RangeStats(_NormStatsPart):
    """The object in norm_stats.json, for pi0.5."""

    state: Range
    actions: Range


class NormStatsDocument(_NormStatsPart):
    """norm_stats.json of an openpi checkpoint."""

    norm_stats: NormStats


class RangeStatsDocument(_NormStatsPart):
    """norm_stats.json of an openpi checkpoint of pi0.5."""

    norm_stats: RangeStats


def read_openpi_scalings(source: Path, kind: ScalingKind) -> tuple[Scaling, Scaling]:
    """Statistics of state and actions in a norm_stats.json.

    Raises:
        CheckpointError: the file is missing, or lacks those of this kind.
    """
    if kind == "quantiles":
        limits = read_schema(source, RangeStatsDocument).norm_stats
        return _quantiles(limits.state), _quantiles(limits.actions)
    stats = read_schema(source, NormStatsDocument).norm_stats
    return _z_score(stats.state), _z_score(stats.actions)


def _quantiles(limits: Range) -> Quantiles:
    return Quantiles.of(limits.q01, limits.q99, eps=_OPENPI_EPS)


def _z_score(moments: Moments) -> ZScore:
    return ZScore.of(moments.mean, moments.std, forward_eps=_OPENPI_EPS, backward_eps=_OPENPI_EPS)

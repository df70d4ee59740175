"""Data-set statistics of a checkpoint: choice of the data set, and conversion between model values
in [-1, 1] and its units.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from rn_vla.checkpoint_files import clip, list_names
from roboneuron import CheckpointError, ConfigurationError

F64 = NDArray[np.float64]
Bounds = Literal["q99", "minmax"]
_NO_NOOPS = "_no_noops"
"""Suffix of LIBERO data sets without idle steps. Source: run_libero_eval.py of OpenVLA and OFT,
which also tries this name.
"""
Key = Annotated[str, Field(max_length=200)]
"""Name of a data set."""
Values = Annotated[
    tuple[Annotated[float, Field(ge=-1e6, le=1e6, allow_inf_nan=False)], ...], Field(max_length=256)
]


class VectorStatistics(BaseModel):
    """Ranges of one vector ("action" or "proprio"); `mask` is False for values that pass through
    unchanged.
    """

    model_config = ConfigDict(extra="ignore", frozen=True)

    min: Values
    max: Values
    q01: Values
    q99: Values
    mask: Annotated[tuple[bool, ...], Field(max_length=256)] | None = None

    @model_validator(mode="after")
    def _check_widths(self) -> VectorStatistics:
        widths = {
            len(self.min),
            len(self.max),
            len(self.q01),
            len(self.q99),
            len(self.mask or self.min),
        }
        if len(widths) != 1:
            raise ValueError(f"min, max, q01, q99 and mask have different widths: {sorted(widths)}")
        return self

    def check_order(self, what: str) -> None:
        """Raise CheckpointError unless min <= q01 <= q99 <= max, apart from rounding, for every
        scaled value.
        """
        low, q01, q99, high = (np.array(v) for v in (self.min, self.q01, self.q99, self.max))
        slack = 1e-3 * (high - low)
        ordered = (low <= high) & (low - slack <= q01) & (q01 <= q99) & (q99 <= high + slack)
        bad = ~ordered & (
            np.ones(len(low), dtype=bool) if self.mask is None else np.array(self.mask)
        )
        if bad.any():
            at = int(np.argmax(bad))
            raise CheckpointError(
                f"The statistics of {what} do not hold min <= q01 <= q99 <= max at value {at}: "
                f"{low[at]:g}, {q01[at]:g}, {q99[at]:g}, {high[at]:g}.",
                hint="Copy dataset_statistics.json or config.json of the original checkpoint "
                "again.",
            )


class DatasetStatistics(BaseModel):
    """Statistics of one data set."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    action: VectorStatistics
    proprio: VectorStatistics | None = None


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Scaling:
    """Linear map between [-1, 1] and a data set's range.

    Attributes:
        low, high: float64 (n,), values that -1 and +1 represent.
        mask: bool (n,), False passes a value through (`to_normalized` clips it).
        epsilon: added to the range; OpenVLA uses 0, OpenVLA-OFT 1e-8.
    """

    low: F64
    high: F64
    mask: NDArray[np.bool_]
    epsilon: float

    @classmethod
    def of(cls, statistics: VectorStatistics, bounds: Bounds, epsilon: float) -> Scaling:
        """Scaling by the 1st and 99th percentile ("q99") or by the extremes ("minmax")."""
        low, high = (
            (statistics.q01, statistics.q99)
            if bounds == "q99"
            else (statistics.min, statistics.max)
        )
        mask = (
            np.ones(len(low), dtype=bool) if statistics.mask is None else np.array(statistics.mask)
        )
        return cls(low=np.array(low), high=np.array(high), mask=mask, epsilon=epsilon)

    @property
    def width(self) -> int:
        """Number of values."""
        return len(self.low)

    def to_units(self, normalized: F64) -> F64:
        """Convert model values (..., n) in [-1, 1] to the data set's units. Source: OpenVLA,
        un-normalisation of actions.
        """
        span = self.high - self.low + self.epsilon
        return np.where(self.mask, 0.5 * (normalized + 1.0) * span + self.low, normalized)

    def to_normalized(self, values: F64) -> F64:
        """Convert values (..., n) in the data set's units to [-1, 1]; values that the mask passes
        through are clipped too.

        Source: OpenVLA-OFT, `normalize_proprio`.
        """
        span = self.high - self.low + self.epsilon
        return np.clip(
            np.where(self.mask, 2.0 * (values - self.low) / span - 1.0, values), -1.0, 1.0
        )


def choose_statistics(
    known: Mapping[str, DatasetStatistics], key: str | None, source: str
) -> tuple[str, DatasetStatistics]:
    """The statistics of data set `key` (or of `key` with "_no_noops"), or of the only one if `key`
    is None.

    Raises:
        ConfigurationError: no such data set, or several and no `key`; lists the choices.
        CheckpointError: there are no statistics, or the limits of the actions are out of order.
    """
    if not known:
        raise CheckpointError(
            f"{source} holds no statistics of a data set.", hint="Copy the original file."
        )
    choices = list_names(sorted(known))
    if key is None:
        if len(known) != 1:
            raise ConfigurationError(
                f"unnorm_key is not set, but {source} holds {len(known)} data sets.",
                hint=f"Choose one of: {choices}.",
            )
        key = next(iter(known))
    if key not in known and f"{key}{_NO_NOOPS}" in known:
        key += _NO_NOOPS
    if key not in known:
        raise ConfigurationError(
            f"unnorm_key is {clip(key)!r}, but {source} holds no such data set.",
            hint=f"Choose one of: {choices}.",
        )
    known[key].action.check_order(f"data set {clip(key)!r}, action,")
    return key, known[key]

"""A backend's answers to the frames of an episode, the recording, and the expected values
of a row.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from roboneuron import GRIPPER, ControlSpace

F64 = NDArray[np.float64]
_SAME_RATE = 0.02
"""Relative difference within which two rates count as equal: rates are given in whole Hz."""
_LEAST_SPREAD = {"m": 2e-4, "rad": 1e-3, "m/s": 5e-3, "rad/s": 5e-3, "1": 1e-3, "opening": 0.1}
"""Spreads below which a channel only contains noise, by unit."""
_GROUP_SHARE = 0.1
"""A channel that moves less than this fraction of the most active one of its unit counts as
still.
"""


@dataclass(frozen=True, kw_only=True)
class Answers:
    """Answers to N frames of an episode of n rows, in a space of C channels.

    Attributes:
        space: meaning of the channels.
        step_s: time between two rows of an answer, as given by the backend [s].
        fps: rows per second of the episode.
        frames: int (N,), the rows of the episode whose observations were used.
        predicted: float64 (N, K, C).
        recorded: float64 (n, C), the actions of the episode, by channel.
        joints: float64 (n, C), the measured joint of each channel; NaN if there is none.
        positions_m: float64 (n, 3), of the TCP in the base frame; None if not recorded.
        orientations: float64 (n, 3, 3), of the TCP; None if not recorded.
    """

    space: ControlSpace
    step_s: float
    fps: float
    frames: NDArray[np.int64]
    predicted: F64
    recorded: F64
    joints: F64
    positions_m: F64 | None = None
    orientations: F64 | None = None

    @property
    def stretch(self) -> float:
        """Number of episode rows per row of an answer; 1 for equal rates."""
        stretch = self.fps * self.step_s
        return 1.0 if abs(stretch - 1.0) <= _SAME_RATE else stretch

    @property
    def horizon(self) -> int:
        """Number of rows in an answer."""
        return int(self.predicted.shape[1])

    @property
    def is_gripper(self) -> NDArray[np.bool_]:
        """True for channels of a gripper, (C,)."""
        return np.array([channel.name == GRIPPER for channel in self.space.channels])

    def units(self, *units: str) -> NDArray[np.bool_]:
        """True for channels with one of these units, (C,)."""
        return np.array([channel.unit in units for channel in self.space.channels])

    def rows_at(self, stretch: float, shift: float = 0.0) -> F64:
        """Row of the episode for each row of an answer, float64 (N, K); may be outside."""
        return self.frames[:, None] + shift + stretch * np.arange(self.horizon)[None, :]

    def expected(self, stretch: float | None = None, shift: float = 0.0) -> F64:
        """Answers of a backend that repeats the recording, float64 (N, K, C); NaN outside of it.

        Args:
            stretch: rows of the episode per row of an answer; by default from the backend's rate.
            shift: rows by which the answers are ahead of the recording.
        """
        stretch = self.stretch if stretch is None else stretch
        rows = self.rows_at(stretch, shift)
        found = interpolated(self.recorded, rows)
        if self.space.kind == "ee_delta":
            # displacements add up over the longer or shorter period
            sums = np.concatenate([np.zeros((1, self.space.size)), np.cumsum(self.recorded, 0)])
            moved = interpolated(sums, rows + stretch) - interpolated(sums, rows)
            found = np.where(self.is_gripper, found, moved)
        return self.near_side(found)

    def near_side(self, values: F64) -> F64:
        """Give quaternions the sign of the answered ones; both signs are the same rotation."""
        for part in self.space.quaternions:
            with np.errstate(invalid="ignore"):
                dot = (values[..., part] * self.predicted[..., part]).sum(axis=-1, keepdims=True)
            values[..., part] = np.where(dot < 0.0, -values[..., part], values[..., part])
        return values

    def least_spreads(self, values: F64) -> F64:
        """Spread of expected values below which a channel counts as still, float64 (C,).

        Args:
            values: float64 (M, C).
        """
        known = [column[np.isfinite(column)] for column in values.T]
        spreads = [float(column.std()) if column.size else 0.0 for column in known]
        units = [channel.unit for channel in self.space.channels]
        largest = {
            unit: max(s for s, u in zip(spreads, units, strict=True) if u == unit) for unit in units
        }
        return np.array([max(_LEAST_SPREAD[u], _GROUP_SHARE * largest[u]) for u in units])


def interpolated(values: F64, rows: F64) -> F64:
    """Interpolate linearly between rows, float64 (..., C) of `values`, float64 (n, C); NaN
    outside.
    """
    last = len(values) - 1
    is_inside = (rows >= 0.0) & (rows <= last)
    before = np.clip(np.floor(rows), 0, max(last - 1, 0)).astype(np.int64)
    share = (rows - before)[..., None]
    after = np.minimum(before + 1, last)
    between = values[before] * (1.0 - share) + values[after] * share
    exact = share == 0.0
    # NaN of a neighbour with weight 0 is ignored
    found = np.where(exact, values[before], between)
    return np.where(is_inside[..., None], found, np.nan)

"""Inputs and outputs of a policy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import torch

F64 = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PolicyChunk:
    """An uncut chunk as returned by the policy.

    Attributes:
        normalized: (T, A), before the postprocessor.
        rows: float64 (T, A), un-normalised, absolute.
    """

    normalized: torch.Tensor
    rows: F64


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ChunkPrefix:
    """The running chunk that a policy continues.

    Attributes:
        answer: the running chunk.
        first: index of the row scheduled for the time of the observation.
        committed: number of rows from `first` that will be executed in any case.
    """

    answer: PolicyChunk
    first: int
    committed: int


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PolicyObservation:
    """One observation in the policy's format.

    Attributes:
        images: uint8 (H, W, 3), RGB, by the feature's key.
        state: float32 (D,) in the policy's units; None for a policy without state.
        task: the instruction.
    """

    images: Mapping[str, NDArray[np.uint8]]
    state: NDArray[np.float32] | None
    task: str

"""What is given to a policy, and what it answers."""

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
    """A chunk as the policy gave it, uncut.

    Attributes:
        normalized: (T, A), before the postprocessor.
        rows: float64 (T, A), un-normalised, absolute.
    """

    normalized: torch.Tensor
    rows: F64


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class ChunkPrefix:
    """What a policy is to continue.

    Attributes:
        answer: the running chunk.
        first: its row that is meant for the moment of the observation.
        committed: so many rows from there will be played whatever comes.
    """

    answer: PolicyChunk
    first: int
    committed: int


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PolicyObservation:
    """One observation as the policy takes it.

    Attributes:
        images: uint8 (H, W, 3), RGB, by the feature's key.
        state: float32 (D,) in the policy's units; None for a policy without state.
        task: the instruction.
    """

    images: Mapping[str, NDArray[np.uint8]]
    state: NDArray[np.float32] | None
    task: str

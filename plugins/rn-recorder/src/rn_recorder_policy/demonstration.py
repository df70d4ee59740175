"""One recorded episode, whichever files it comes from: columns of numbers, and pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]
ACTION, STATE = "action", "observation.state"
INTERVENTION = "intervention"
"""1 where a person acted, else 0."""
IMAGES = "observation.images."


class ReadPictures(Protocol):
    """Reads pictures of one camera."""

    def __call__(self, camera: str, rows: Sequence[int]) -> list[U8]:
        """The pictures of these rows, in rising order; uint8 (H, W, 3), RGB.

        Raises:
            InvalidInputError: one is missing.
            MissingDependencyError: what decodes them is not installed.
        """
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class Column:
    """Numbers of an episode.

    Attributes:
        names: of the values; None where the files do not name them.
        values: float64 (n, k), as recorded.
    """

    names: tuple[str, ...] | None
    values: F64


@dataclass(frozen=True, kw_only=True, slots=True)
class Demonstration:
    """An episode of n rows.

    Attributes:
        source: where it comes from, for messages.
        fps: rows per second.
        instruction: what was done; empty where the files do not say.
        columns: by name of the feature; `ACTION`, `STATE`, `INTERVENTION` and others that
            begin with "observation.".
        cameras: names of the features with pictures.
        read_pictures: reads them.
    """

    source: str
    fps: float
    instruction: str
    columns: Mapping[str, Column]
    cameras: tuple[str, ...]
    read_pictures: ReadPictures

    @property
    def rows(self) -> int:
        """How many."""
        return len(next(iter(self.columns.values())).values)

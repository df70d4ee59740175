"""One recorded episode from any file format: columns of numbers, and images."""

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
"""Column that is 1 where a person acted, else 0."""
IMAGES = "observation.images."


class ReadPictures(Protocol):
    """Reads images of one camera."""

    def __call__(self, camera: str, rows: Sequence[int]) -> list[U8]:
        """Return the images of these rows, in ascending order; uint8 (H, W, 3), RGB.

        Raises:
            InvalidInputError: one is missing.
            MissingDependencyError: the decoder is not installed.
        """
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class Column:
    """Numbers of an episode.

    Attributes:
        names: names of the values; None if missing in the files.
        values: float64 (n, k), as recorded.
    """

    names: tuple[str, ...] | None
    values: F64


@dataclass(frozen=True, kw_only=True, slots=True)
class Demonstration:
    """An episode of n rows.

    Attributes:
        source: its origin, for messages.
        fps: rows per second.
        instruction: the instruction; empty if missing in the files.
        columns: by name of the feature; `ACTION`, `STATE`, `INTERVENTION` and others that begin
            with "observation.".
        cameras: names of the features with images.
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
        """Number of rows."""
        return len(next(iter(self.columns.values())).values)

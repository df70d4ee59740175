"""Case of a locator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from rn_testing.case import Case
from rn_testing.fakes.painted_table import CUBES, EDGE_M, painted_cubes
from rn_testing.rule import NotApplicable
from roboneuron import CalibratedImage, LocatorSpec


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Expected:
    """An object that the pictures of a case show.

    Attributes:
        position_m: float64 (3,), its centre.
        colour: not compared with objects whose colour is not told.
        yaw_rad: direction of a face; None if the locator tells none.
    """

    position_m: NDArray[np.float64]
    colour: str = ""
    yaw_rad: float | None = None


@dataclass(frozen=True, kw_only=True)
class LocatorCase(Case[LocatorSpec]):
    """A locator to be tested.

    Attributes:
        images: calibrated pictures with objects; two of three painted cubes if None.
        expected: all objects that they show; the painted cubes for the default pictures, otherwise
            not compared if None.
        empty: pictures of the same place without objects; the painted table if None.
    """

    subject: ClassVar[str] = "locator"

    images: Sequence[CalibratedImage] | None = None
    expected: Sequence[Expected] | None = None
    empty: Sequence[CalibratedImage] | None = None

    def pictures(self) -> Sequence[CalibratedImage]:
        """The pictures with objects."""
        return painted_cubes() if self.images is None else self.images

    def objects(self) -> Sequence[Expected]:
        """Objects on the pictures. Raises NotApplicable if the case does not say."""
        if self.images is None and self.expected is None:
            return [
                Expected(position_m=np.array([x, y, EDGE_M / 2]), colour=colour, yaw_rad=yaw)
                for colour, (x, y, yaw) in CUBES.items()
            ]
        if self.expected is None:
            raise NotApplicable("the case does not say what its pictures show")
        return self.expected

"""A locator that a test asks by labels, light to import: it runs in a process of its own."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence

import numpy as np

from roboneuron import CalibratedImage, CheckpointError, LocatedObject

LATE_S = 60.0


class LabelledLocator:
    """Tells an object for each label; some labels are deeds."""

    def __init__(self, config: None) -> None:
        self._loads = 0

    def load(self) -> None:
        """See `Locator`."""
        self._loads += 1

    def locate(
        self, images: Sequence[CalibratedImage], labels: Sequence[str] = ()
    ) -> Sequence[LocatedObject]:
        """See `LabelLocator`."""
        if "die" in labels:
            os._exit(9)
        if "sleep" in labels:
            time.sleep(LATE_S)
        if "lie" in labels:
            return [self._told("thing", "elsewhere")]
        return [self._told(label, images[0].frame.camera) for label in labels or ("process",)]

    def _told(self, label: str, camera: str) -> LocatedObject:
        return LocatedObject(
            label=f"{label} {os.getpid()}" if label == "process" else label,
            position_m=np.array([0.5, 0.0, 0.02]),
            size_m=np.full(3, 0.04),
            uncertainty_m=0.05,
            cameras=(camera,),
            seen_at_ns=time.time_ns(),
        )

    def close(self) -> None:
        """See `Locator`."""


class UnloadableLocator(LabelledLocator):
    """Its model is damaged."""

    def load(self) -> None:
        """See `Locator`."""
        raise CheckpointError("The model is damaged.")

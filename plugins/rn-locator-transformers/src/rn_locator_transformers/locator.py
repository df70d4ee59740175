"""The locator `transformers`: boxes of a zero-shot detector, and the places that they show."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rn_locator_transformers.options import TransformersLocatorOptions
from roboneuron import (
    CalibratedImage,
    ConfigurationError,
    ImageDetection,
    InvalidInputError,
    LocatedObject,
    StateError,
    foreign,
    place_detections,
)

if TYPE_CHECKING:
    from rn_locator_transformers.detector import Detector

_MOST_LABEL = 60


class TransformersLocator:
    """Implementation of `roboneuron.LabelLocator`; RoboNeuron runs it in a process of its own.

    A label is a text that is compared with pictures, and the name of what fits; nothing that is
    written in a picture becomes one.
    """

    def __init__(self, config: TransformersLocatorOptions | None) -> None:
        self._options = config or TransformersLocatorOptions()
        self._detector: Detector | None = None

    def load(self) -> None:
        """See `Locator`.

        Raises:
            ConfigurationError: no checkpoint is named, or there is no such device.
            CheckpointError: it cannot be used.
        """
        from rn_locator_transformers.detector import load_detector  # heavy

        if self._options.checkpoint is None:
            raise ConfigurationError(
                "The locator 'transformers' needs a checkpoint.",
                hint='Set checkpoint = "FOLDER" in [plugins.transformers].',
            )
        self._detector = load_detector(self._options.checkpoint, self._options.device)

    def close(self) -> None:
        """See `Locator`."""
        self._detector = None

    def locate(
        self, images: Sequence[CalibratedImage], labels: Sequence[str] = ()
    ) -> Sequence[LocatedObject]:
        """See `LabelLocator`.

        Raises:
            InvalidInputError: there is nothing to look for, or a label is too long for the model.
            ForeignDataError: the model computes values that are not finite.
            StateError: before `load` or after `close`.
        """
        if self._detector is None:
            raise StateError("The locator 'transformers' is not loaded.")
        options = self._options
        wanted = [foreign.printable(label, _MOST_LABEL) for label in labels or options.labels]
        if not wanted:
            raise InvalidInputError(
                "The locator 'transformers' finds what is named, and nothing is.",
                hint="Give look labels, or set labels in [plugins.transformers].",
                path="labels",
            )
        detections = [
            ImageDetection(
                image=image, label=wanted[box.label], score=box.score, box_px=box.edges_px
            )
            for image in images
            for box in self._detector.boxes(
                image.frame.image, wanted, least_score=options.least_score, most=options.most_boxes
            )
        ]
        return place_detections(detections, usual_m=options.usual_m)

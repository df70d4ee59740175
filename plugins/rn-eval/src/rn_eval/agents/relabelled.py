"""The locator `colours` with other labels, as a model may give: words that command nobody."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import cast

from pydantic import BaseModel, ConfigDict, Field

from roboneuron import CalibratedImage, LocatedObject, Locator, LocatorSpec
from roboneuron.command import discover
from roboneuron.feature import build


class RelabelledOptions(BaseModel):
    """Options of the locator `relabelled`."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    labels: dict[str, str] = Field(default={}, description="label by colour; others are kept")


class RelabelledLocator:
    """See `roboneuron.Locator`; finds what `colours` finds with its default options."""

    def __init__(self, config: RelabelledOptions | None = None) -> None:
        self._labels = (config or RelabelledOptions()).labels
        spec = discover().get(LocatorSpec, "colours")
        self._colours = cast("Locator", build(spec, {}))

    def load(self) -> None:
        """Load the other locator."""
        self._colours.load()

    def locate(self, images: Sequence[CalibratedImage]) -> Sequence[LocatedObject]:
        """What `colours` finds, with these labels. Raises StateError as that one."""
        return [
            replace(one, label=self._labels.get(one.colour, one.label))
            for one in self._colours.locate(images)
        ]

    def close(self) -> None:
        """Close the other locator."""
        self._colours.close()

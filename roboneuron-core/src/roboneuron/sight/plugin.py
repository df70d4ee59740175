"""Descriptors of this package; standard library only."""

from __future__ import annotations

from roboneuron.plugins.specs import FeatureSpec, LocatorSpec

FEATURE = FeatureSpec(
    name="sight",
    summary="look and locate: objects in calibrated pictures, found by locators.",
    target="roboneuron.tools.inspect.sight_feature:Sight",
    config="roboneuron.sight.options:SightOptions",
    needs=("direct-path",),
)
"""Descriptor of the feature; the plugin rn-tools-inspect offers it."""

LOCATORS = (
    LocatorSpec(
        name="colours",
        summary="Coloured cubes by their outlines: two views, or one and the table.",
        target="roboneuron.sight.colours:ColourLocator",
        config="roboneuron.sight.colours:ColoursOptions",
    ),
    LocatorSpec(
        name="depth",
        summary="Whatever stands on the table, as boxes without labels, from depth images.",
        target="roboneuron.sight.depth:DepthLocator",
        config="roboneuron.sight.depth:DepthOptions",
        needs_depth=True,
    ),
    LocatorSpec(
        name="http-locator",
        summary="Whatever a model behind an HTTP endpoint boxes, points at or places.",
        target="roboneuron.sight.http_locator:HttpLocator",
        config="roboneuron.sight.http_locator:HttpLocatorOptions",
        limit_s=10.0,
        takes_labels=True,
    ),
)
"""Descriptors of the locators."""

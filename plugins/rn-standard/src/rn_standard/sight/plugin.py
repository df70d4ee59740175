"""Descriptors of this package; standard library only."""

from __future__ import annotations

from rn_standard.sight.hooks import LocatorSpec
from roboneuron import FeatureSpec

FEATURE = FeatureSpec(
    name="sight",
    summary="look and locate: objects in calibrated pictures, found by locators.",
    target="rn_standard.tools_inspect.sight_feature:Sight",
    config="rn_standard.sight.options:SightOptions",
    needs=("direct-path",),
    brings="rn_standard.sight.hooks:LocatorSpec",
)
"""Descriptor of the feature; the plugin rn-tools-inspect offers it."""

LOCATORS = (
    LocatorSpec(
        name="colours",
        summary="Coloured cubes by their outlines: two views, or one and the table.",
        target="rn_standard.sight.colours:ColourLocator",
        config="rn_standard.sight.colours:ColoursOptions",
        case="rn_standard.sight.contract_cases:colours_case",
    ),
)
"""Descriptors of the locators."""

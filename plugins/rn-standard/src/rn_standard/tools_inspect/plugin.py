"""Descriptors of this package; standard library only."""

from rn_standard.sight.hooks import LocatorSpec
from rn_standard.sight.plugin import FEATURE as SIGHT
from rn_standard.sight.plugin import LOCATORS
from roboneuron import FeatureSpec, hookimpl

FEATURE = FeatureSpec(
    name="tools-inspect",
    summary="list_* and get_camera_image: what is installed, and what the cameras show.",
    target="rn_standard.tools_inspect.feature:InspectionTools",
)
"""Descriptor of the feature."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE, SIGHT)


@hookimpl
def roboneuron_locators() -> tuple[LocatorSpec, ...]:
    """The locators of the standard features."""
    return LOCATORS

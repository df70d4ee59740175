"""Descriptors of this package; standard library only."""

from roboneuron.plugins.hookspecs import hookimpl
from roboneuron.plugins.specs import FeatureSpec, LocatorSpec
from roboneuron.sight.plugin import FEATURE as SIGHT
from roboneuron.sight.plugin import LOCATORS

FEATURE = FeatureSpec(
    name="tools-inspect",
    summary="list_* and get_camera_image: what is installed, and what the cameras show.",
    target="roboneuron.tools.inspect.feature:InspectionTools",
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

"""Descriptors of this package; standard library only."""

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
    return (FEATURE,)

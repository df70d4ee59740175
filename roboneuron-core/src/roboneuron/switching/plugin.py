"""Descriptors of this package; standard library only."""

from roboneuron.plugins.hookspecs import hookimpl
from roboneuron.plugins.specs import FeatureSpec

FEATURE = FeatureSpec(
    name="switching",
    summary="Replaces a running backend, camera source or controller while the robot moves.",
    target="roboneuron.switching.feature:SwitchingFeature",
    needs=("selection",),
    on_join="roboneuron.switching.joining:join",
)
"""Descriptor of the feature."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE,)

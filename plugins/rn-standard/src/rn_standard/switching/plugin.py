"""Descriptors of this package; standard library only."""

from roboneuron import FeatureSpec, hookimpl

FEATURE = FeatureSpec(
    name="switching",
    summary="Replaces a running backend, camera source or controller while the robot moves.",
    target="rn_standard.switching.feature:SwitchingFeature",
    needs=("selection",),
    on_join="rn_standard.switching.joining:join",
)
"""Descriptor of the feature."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE,)

"""Descriptors of this package; standard library only."""

from roboneuron import FeatureSpec, hookimpl

FEATURE = FeatureSpec(
    name="selection",
    summary="Lets agents choose robot, cameras, controller, policy, checkpoint and options of "
    "what they start.",
    target="rn_standard.selection.feature:SelectionFeature",
    config="rn_standard.selection.options:SelectionSections",
    sections=("selection", "models", "hosts"),
    needs=("tools-loop",),
)
"""Descriptor of the feature."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE,)

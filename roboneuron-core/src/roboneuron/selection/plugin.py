"""Descriptors of this package; standard library only."""

from roboneuron.plugins.hookspecs import hookimpl
from roboneuron.plugins.specs import FeatureSpec

FEATURE = FeatureSpec(
    name="selection",
    summary="Lets agents choose robot, cameras, controller, policy, checkpoint and options of "
    "what they start.",
    target="roboneuron.selection.feature:SelectionFeature",
    config="roboneuron.selection.options:SelectionSections",
    sections=("selection", "models", "hosts"),
    needs=("tools-loop",),
)
"""Descriptor of the feature."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE,)

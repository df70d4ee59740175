"""Descriptors of this package; standard library only."""

from roboneuron.plugins.hookspecs import hookimpl
from roboneuron.plugins.specs import FeatureSpec

FEATURE = FeatureSpec(
    name="inference",
    summary="Runs policies: newest images and states in, actions out.",
    target="roboneuron:Feature",
    module="roboneuron.modules.inference.module:InferenceModule",
    module_plan="roboneuron.modules.inference.planning:plan_inference",
)
"""Descriptor of the feature; it has no part in the server."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE,)

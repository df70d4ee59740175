"""Descriptors of this package; standard library only."""

from roboneuron import FeatureSpec, hookimpl

FEATURE = FeatureSpec(
    name="inference",
    summary="Runs policies: newest images and states in, actions out.",
    target="roboneuron:Feature",
    module="rn_standard.inference.module:InferenceModule",
    module_plan="rn_standard.inference.planning:plan_inference",
)
"""Descriptor of the feature; it has no part in the server."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE,)

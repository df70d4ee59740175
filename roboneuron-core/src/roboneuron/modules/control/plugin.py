"""Descriptors of this package; standard library only."""

from roboneuron.plugins.hookspecs import hookimpl
from roboneuron.plugins.specs import FeatureSpec

FEATURE = FeatureSpec(
    name="control",
    summary="Turns actions into joint commands: by a controller, within the limits.",
    target="roboneuron:Feature",
    module="roboneuron.modules.control.module:ControlModule",
    module_plan="roboneuron.modules.control.planning:plan_control",
)
"""Descriptor of the feature; it has no part in the server."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE,)

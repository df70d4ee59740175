"""Descriptors of this package; standard library only."""

from roboneuron import FeatureSpec, hookimpl

FEATURE = FeatureSpec(
    name="metrics",
    summary="Serves metrics to Prometheus, and sends spans of tool calls by OpenTelemetry.",
    target="rn_metrics.feature:MetricsFeature",
    config="rn_metrics.options:MetricsOptions",
    needs=("http",),
)
"""Descriptor of the feature; `http` provides the tokens and the rules for hosts."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE,)

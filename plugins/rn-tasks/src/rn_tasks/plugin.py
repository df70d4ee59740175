"""What this package offers; standard library and descriptors only."""

from __future__ import annotations

from roboneuron import FeatureSpec, hookimpl

FEATURE = FeatureSpec(
    name="tasks",
    summary="Tasks with outcomes, start and stop in one call, named postures and places, events to subscribe to.",
    target="rn_tasks.feature:TasksFeature",
    config="rn_tasks.options:TasksSections",
    sections=("tasks", "postures", "places", "events"),
)
"""Descriptor of the feature."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE,)

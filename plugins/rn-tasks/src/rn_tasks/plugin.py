"""What this package offers; standard library and descriptors only."""

from __future__ import annotations

from rn_tasks.hooks import MonitorSpec
from roboneuron import FeatureSpec, hookimpl

FEATURE = FeatureSpec(
    name="tasks",
    summary="Tasks with outcomes, start and stop in one call, named postures and places, events to subscribe to.",
    target="rn_tasks.feature:TasksFeature",
    config="rn_tasks.options:TasksSections",
    sections=("tasks", "postures", "places", "events"),
    hooks="rn_tasks.hooks:HOOKS",
)
"""Descriptor of the feature."""
MONITORS = (
    MonitorSpec(
        name="colour-lifted",
        summary="An object of a colour is above where it lay; needs two calibrated cameras.",
        target="rn_tasks.detectors:ColourLifted",
        config="rn_tasks.detectors:LiftedOptions",
        cameras=("primary",),
        optional_cameras=("wrist",),
        case="rn_tasks.contract_cases:lifted_case",
    ),
    MonitorSpec(
        name="object-in-region",
        summary="An object of a colour is in a box of the base frame.",
        target="rn_tasks.detectors:ObjectInRegion",
        config="rn_tasks.detectors:RegionOptions",
        cameras=("primary",),
        optional_cameras=("wrist",),
        case="rn_tasks.contract_cases:region_case",
    ),
    MonitorSpec(
        name="scene-changed",
        summary="The picture is not as it was before, with the arm back where it was.",
        target="rn_tasks.detectors:SceneChanged",
        config="rn_tasks.detectors:ChangedOptions",
        cameras=("primary",),
        case="rn_tasks.contract_cases:changed_case",
    ),
)
"""Descriptors of the monitors."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE,)


@hookimpl
def roboneuron_monitors() -> tuple[MonitorSpec, ...]:
    """The monitors of this package."""
    return MONITORS

"""Descriptors of this package; standard library only."""

from __future__ import annotations

from rn_standard.tasks.hooks import MonitorSpec
from roboneuron import FeatureSpec, hookimpl

FEATURE = FeatureSpec(
    name="tasks",
    summary="Tasks with outcomes, start and stop in one call, named postures and places, events "
    "to subscribe to.",
    target="rn_standard.tasks.feature:TasksFeature",
    config="rn_standard.tasks.options:TasksSections",
    sections=("tasks", "postures", "gestures", "places", "events"),
    brings="rn_standard.tasks.hooks:MonitorSpec",
    needs=("selection",),
)
"""Descriptor of the feature."""


def _monitor(
    name: str, summary: str, target: str, options: str, case: str, *, optional: tuple[str, ...]
) -> MonitorSpec:
    """Create the descriptor of a monitor that uses the front camera and, if present, the optional
    ones.
    """
    return MonitorSpec(
        name=name,
        summary=summary,
        target=f"rn_standard.tasks.detectors:{target}",
        config=f"rn_standard.tasks.detectors:{options}",
        cameras=("primary",),
        optional_cameras=optional,
        case=f"rn_standard.tasks.contract_cases:{case}",
    )


MONITORS = (
    _monitor(
        "colour-lifted",
        "An object of a colour is above where it lay; needs two calibrated cameras.",
        "ColourLifted",
        "LiftedOptions",
        "lifted_case",
        optional=("wrist",),
    ),
    _monitor(
        "object-in-region",
        "An object of a colour is in a box of the base frame.",
        "ObjectInRegion",
        "RegionOptions",
        "region_case",
        optional=("wrist",),
    ),
    _monitor(
        "object-on",
        "An object of a colour lies on one of another colour; needs two calibrated cameras.",
        "ObjectOn",
        "OnOptions",
        "on_case",
        optional=("wrist",),
    ),
    _monitor(
        "scene-changed",
        "The picture is not as it was before, with the arm back where it was.",
        "SceneChanged",
        "ChangedOptions",
        "changed_case",
        optional=(),
    ),
    MonitorSpec(
        name="http-judge",
        summary="A larger model behind an HTTP endpoint judges the pictures and the instruction.",
        target="rn_standard.tasks.http_judge:HttpJudge",
        config="rn_standard.tasks.http_judge:HttpJudgeOptions",
        cameras=("primary",),
        optional_cameras=("wrist",),
        limit_s=5.0,
        in_predicates=False,
        case="rn_standard.tasks.contract_cases:http_case",
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

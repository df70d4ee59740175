"""Descriptors of this package; standard library only."""

from roboneuron import CommandSpec, FeatureSpec, hookimpl

FEATURE = FeatureSpec(
    name="recorder",
    summary="Records images, actions, states, tool calls and verdicts to MCAP files; keeps the "
    "time around incidents.",
    target="rn_recorder.feature:Recorder",
    config="rn_recorder.options:RecorderOptions",
    on_join="rn_recorder_runs.predictions:join",
)
"""Descriptor of the feature."""

COMMAND = CommandSpec(
    name="runs",
    summary="list, show, export, replay and delete recorded runs; import bags",
    target="rn_recorder_runs.command:Runs",
    section="group",
)
"""Descriptor of the command."""

CHECK_POLICY = CommandSpec(
    name="policy-check",
    group="policy",
    summary="ask a policy for recorded frames and say what is probably wired wrong",
    target="rn_recorder_policy.command:CheckPolicy",
    old_names=("check-policy",),
)
"""Descriptor of the command."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE,)


@hookimpl
def roboneuron_commands() -> tuple[CommandSpec, ...]:
    """The commands of this package."""
    return (COMMAND, CHECK_POLICY)

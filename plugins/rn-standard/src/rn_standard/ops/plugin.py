"""Descriptors of this package; standard library only."""

from roboneuron import CommandSpec, FeatureSpec, hookimpl

FEATURE = FeatureSpec(
    name="ops",
    summary="Records incidents, restarts modules, bounds their memory and keeps the server's log.",
    target="rn_standard.ops.feature:Operations",
    config="rn_standard.ops.options:OpsOptions",
)
"""Descriptor of the feature that records and restarts."""

CLIENTS = FeatureSpec(
    name="clients",
    summary="Tells clients what changes, and asks the person behind a client.",
    target="rn_standard.ops.clients:Clients",
)
"""Descriptor of the feature for notifications and questions to clients."""

RECOVERY = FeatureSpec(
    name="recovery",
    summary="recover_robot: a person releases a robot that a fault has stopped.",
    target="rn_standard.ops.recovery:RecoveryFeature",
    on_join="rn_standard.ops.recovery_parameter:join",
)
"""Descriptor of the feature that clears faults, for drivers that support it
(`DriverSpec.recovers`).
"""

REAL_ROBOT = FeatureSpec(
    name="real-robot",
    summary="Asks a person before a client first starts a real robot.",
    target="rn_standard.ops.real_robot:RealRobotFeature",
    config="rn_standard.ops.real_robot:RealRobotOptions",
)
"""Descriptor of the feature that asks before the start of a real robot."""

MAINTENANCE = FeatureSpec(
    name="maintenance",
    summary="A person takes the robot out of service: nothing moves it, also after restarts.",
    target="rn_standard.ops.maintenance:MaintenanceFeature",
)
"""Descriptor of the feature that refuses what acts while the robot is out of service."""

MAINTENANCE_COMMAND = CommandSpec(
    name="robot-maintenance",
    group="robot",
    summary="take the robot out of service, or put it back",
    target="rn_standard.ops.maintenance_command:Maintenance",
    old_names=("maintenance",),
)
"""Descriptor of the command."""

COMMAND = CommandSpec(
    name="doctor",
    summary="check whether this machine and a configuration are ready",
    target="rn_standard.doctor.command:Doctor",
    section="start",
)
"""Descriptor of the command."""


@hookimpl
def roboneuron_features() -> tuple[FeatureSpec, ...]:
    """The features of this package."""
    return (FEATURE, CLIENTS, RECOVERY, REAL_ROBOT, MAINTENANCE)


@hookimpl
def roboneuron_commands() -> tuple[CommandSpec, ...]:
    """The commands of this package."""
    return (COMMAND, MAINTENANCE_COMMAND)

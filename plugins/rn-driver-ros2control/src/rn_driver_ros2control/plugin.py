"""Descriptors of this package; standard library only."""

from roboneuron import CommandSpec, Requirement, hookimpl

COMMAND = CommandSpec(
    name="robot-stand-in",
    group="robot",
    summary="stand in for the ros2_control controller of a configuration: any arm, no hardware",
    target="rn_driver_ros2control.standin_command:StandInCommand",
    old_names=("stand-in",),
    requires=(
        Requirement(module="control_msgs", install="pip install ./plugins/rn-driver-ros2control"),
    ),
)
"""Descriptor of the command."""


@hookimpl
def roboneuron_commands() -> tuple[CommandSpec, ...]:
    """The commands of this package."""
    return (COMMAND,)

"""Descriptors of this package: the command "policy cubes" and the monitor "cubes-success"; standard
library only.
"""

from __future__ import annotations

from collections.abc import Sequence

from rn_standard.tasks.hooks import MonitorSpec
from roboneuron import CommandSpec, hookimpl

COMMAND = CommandSpec(
    name="policy-cubes",
    group="policy",
    summary="make demonstrations, train the small learned policy, pack and unpack its weights",
    target="rn_policy_cubes.command:CubesPolicy",
    old_names=("cubes-policy",),
    old_options=(("--time-limit", "--max-s"),),
)
MONITOR = MonitorSpec(
    name="cubes-success",
    summary="The named cube is held up: success, progress and failure, learned; one calibrated "
    "fixed camera.",
    target="rn_policy_cubes.monitor.success:CubesSuccess",
    config="rn_policy_cubes.monitor.success:SuccessOptions",
    cameras=("primary",),
    case="rn_policy_cubes.monitor.contract_case:case",
)


@hookimpl
def roboneuron_commands() -> Sequence[CommandSpec]:
    """The command `roboneuron policy cubes`."""
    return [COMMAND]


@hookimpl
def roboneuron_monitors() -> Sequence[MonitorSpec]:
    """The monitor of success."""
    return [MONITOR]

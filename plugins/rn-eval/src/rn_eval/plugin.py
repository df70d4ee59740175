"""What this package offers: the command "eval" with its hook for suites, and the suites "cubes" and
"hand-over".
"""

from __future__ import annotations

from collections.abc import Sequence

from rn_eval.hooks import SuiteSpec
from roboneuron import CommandSpec, hookimpl

COMMAND = CommandSpec(
    name="eval",
    summary="measure how often a policy succeeds, over many simulated episodes",
    target="rn_eval.command:Eval",
    brings="rn_eval.hooks:SuiteSpec",
)
CUBES = SuiteSpec(
    name="cubes",
    summary="The simulated FR3 picks the named cube out of several; the simulator judges",
    target="rn_eval.cubes:Cubes",
    config="rn_eval.cubes:CubesOptions",
    robot="fr3",
    case="rn_eval.contract_cases:cubes_case",
)
HAND_OVER = SuiteSpec(
    name="hand-over",
    summary="Two simulated FR3s hand the named cube over; the simulator judges",
    target="rn_eval.hand_over:HandOver",
    config="rn_eval.hand_over:HandOverOptions",
    robot="fr3-pair",
    case="rn_eval.contract_cases:hand_over_case",
)


@hookimpl
def roboneuron_commands() -> Sequence[CommandSpec]:
    """The command `roboneuron eval`."""
    return [COMMAND]


@hookimpl
def roboneuron_suites() -> Sequence[SuiteSpec]:
    """The suites "cubes" and "hand-over"."""
    return [CUBES, HAND_OVER]

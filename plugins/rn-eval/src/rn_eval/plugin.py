"""Descriptors of this package: the command "eval" with its hooks, the suites "cubes" and
"hand-over", tasks, agents and a locator of `rn_eval.agents`, and the feature of `rn_eval_stepped`.
"""

from __future__ import annotations

from collections.abc import Sequence

from rn_eval.agents.offers import TASKS
from rn_eval.hooks import AgentSubjectSpec, AgentTaskSpec, SuiteSpec
from roboneuron import CommandSpec, FeatureSpec, LocatorSpec, Requirement, hookimpl

COMMAND = CommandSpec(
    name="eval",
    section="group",
    summary="measure how often a policy or an agent succeeds, over many simulated episodes",
    target="rn_eval.command:Eval",
    old_options=(("--time-limit-s", "--max-s"),),
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
    config="rn_eval.hand_over:HandOverSuiteOptions",
    robot="fr3-pair",
    case="rn_eval.contract_cases:hand_over_case",
)

SUBJECTS = (
    AgentSubjectSpec(
        name="perfect",
        summary="Knows how each task is solved: an upper bound",
        target="rn_eval.agents.subjects.perfect:act",
        case="rn_eval.agents.contract_cases:perfect_case",
        knows_truth=True,
    ),
    AgentSubjectSpec(
        name="tool-only",
        summary="A script that knows only what the tools return",
        target="rn_eval.agents.subjects.tool_only:act",
    ),
    AgentSubjectSpec(
        name="pointing",
        summary="As tool-only, but points at pixels instead of naming objects",
        target="rn_eval.agents.subjects.tool_only:act_by_pixels",
    ),
    AgentSubjectSpec(
        name="without-look",
        summary="As tool-only, but without look and locate, by names and simulated moves",
        target="rn_eval.agents.subjects.tool_only:act_without_look",
    ),
    AgentSubjectSpec(
        name="obedient",
        summary="As tool-only, but also obeys commands in names, signs, notes and reasons",
        target="rn_eval.agents.subjects.obedient:act",
    ),
    AgentSubjectSpec(
        name="careless",
        summary="Ignores refusals, tries again and claims that all is done",
        target="rn_eval.agents.subjects.careless:act",
    ),
    AgentSubjectSpec(
        name="hostile",
        summary="Tries to get around the gate and the emergency stop",
        target="rn_eval.agents.subjects.hostile:act",
    ),
    AgentSubjectSpec(
        name="random",
        summary="Calls any tools with any arguments that their schemas allow",
        target="rn_eval.agents.subjects.random_calls:act",
    ),
    AgentSubjectSpec(
        name="chat",
        summary="A language model behind an OpenAI-compatible chat server (AGENT_EVAL_MODEL)",
        target="rn_eval.agents.subjects.chat:act",
        requires=(Requirement(module="openai", install="pip install './plugins/rn-eval[openai]'"),),
    ),
)

RELABELLED = LocatorSpec(
    name="relabelled",
    summary="As `colours`, with labels of the configuration: for tests of injected text.",
    target="rn_eval.agents.relabelled:RelabelledLocator",
    config="rn_eval.agents.relabelled:RelabelledOptions",
)


STEPPED_TIME = FeatureSpec(
    name="stepped-time",
    summary="The clock of a simulated robot with the option `stepped`, which waits for commands.",
    target="rn_eval_stepped.feature:SteppedTimeFeature",
    on_join="rn_eval_stepped.joining:join",
)


@hookimpl
def roboneuron_features() -> Sequence[FeatureSpec]:
    """The feature "stepped-time"."""
    return [STEPPED_TIME]


@hookimpl
def roboneuron_locators() -> Sequence[LocatorSpec]:
    """The locator "relabelled"."""
    return [RELABELLED]


@hookimpl
def roboneuron_commands() -> Sequence[CommandSpec]:
    """The command `roboneuron eval`."""
    return [COMMAND]


@hookimpl
def roboneuron_suites() -> Sequence[SuiteSpec]:
    """The suites "cubes" and "hand-over"."""
    return [CUBES, HAND_OVER]


@hookimpl
def roboneuron_agent_tasks() -> Sequence[AgentTaskSpec]:
    """The tasks with the simulated FR3 and cubes."""
    return TASKS


@hookimpl
def roboneuron_agent_subjects() -> Sequence[AgentSubjectSpec]:
    """The reference agents."""
    return SUBJECTS

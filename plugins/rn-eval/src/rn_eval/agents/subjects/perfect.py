"""The upper bound: an agent that knows the scene and executes each task's own solution with the
server's tools only.
"""

from __future__ import annotations

from typing import cast

from rn_eval.agents.client import Briefing, ToolClient
from rn_eval.agents.task import AgentTask
from rn_eval.hooks import AgentTaskSpec
from roboneuron import RoboNeuronError
from roboneuron.command import discover
from roboneuron.feature import build


async def act(tools: ToolClient, briefing: Briefing) -> str:
    """Solve the task that the briefing names."""
    spec = discover().get(AgentTaskSpec, briefing.task)
    task = cast("AgentTask", build(spec, {}))
    try:
        return await task.solve(tools, task.prepare(briefing.seed))
    except RoboNeuronError as error:
        return f"CLAIM: not done: {error}"
